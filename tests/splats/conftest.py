"""Every test leaves the threads and the instruction set as it found them."""

import pytest

from nerfvol.kernels import ops
from nerfvol.native import native


@pytest.fixture(params=ops.available_isas())
def isa(request):
    """Each build of the kernels that this CPU can run, in turn."""
    if native() is None:
        pytest.skip("no compiled kernels")
    ops.set_isa(request.param)
    yield request.param
    ops.set_isa("auto")


@pytest.fixture
def compiled():
    if native() is None:
        pytest.skip("no compiled kernels")


@pytest.fixture
def threads():
    """ops.set_threads, undone afterwards."""
    if native() is None:
        pytest.skip("no compiled kernels")
    before = ops.get_threads()
    yield ops.set_threads
    ops.set_threads(before)
