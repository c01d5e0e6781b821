"""What tests of training share."""

from tests.fixtures.kernels import compiled, threads  # noqa: F401  (fixtures)
