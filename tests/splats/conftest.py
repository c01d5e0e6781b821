"""What tests of splats share."""

from tests.fixtures.kernels import compiled, isa, threads  # noqa: F401  (fixtures)
