"""What tests of the kernels share."""

from tests.fixtures.kernels import compiled, isa, threads  # noqa: F401  (fixtures)
