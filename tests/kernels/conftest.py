"""What tests of the kernels share."""

from tests.fixtures.kernels import isa, threads  # noqa: F401  (fixtures)
