"""How many threads the kernels use, which build of them runs, and the memory that they keep between calls."""

from __future__ import annotations

import os
import sys

from nerfvol.errors import InputError
from nerfvol.native import native, need_torch

WITHOUT_KERNELS = "drawing and training without compiled kernels"


def set_threads(n: int) -> None:
    """Threads of the kernels, and of torch where it is loaded or does their work; ValueError below 1."""
    if n < 1:
        raise ValueError(f"threads must be at least 1, got {n}")
    if (compiled := native()) is not None:
        compiled.set_threads(n)
    if compiled is None:
        need_torch(WITHOUT_KERNELS)
    if compiled is None or sys.modules.get("torch") is not None:
        import torch

        torch.set_num_threads(n)


def get_threads() -> int:
    """Threads of the kernels, or of torch where it does their work."""
    compiled = native()
    if compiled is not None:
        return compiled.get_threads()
    need_torch(WITHOUT_KERNELS)
    import torch

    return torch.get_num_threads()


def available_isas() -> list[str]:
    """Builds of the kernels that this CPU can run, best first; ["reference"] without compiled kernels."""
    compiled = native()
    return compiled.available_isas() if compiled is not None else ["reference"]


def isa() -> str:
    """The build in use."""
    compiled = native()
    return compiled.isa() if compiled is not None else "reference"


def set_isa(name: str) -> None:
    """Chooses a build: "auto" or one of :func:`available_isas`; ValueError for another."""
    compiled = native()
    if compiled is None or not compiled.set_isa(name):
        raise ValueError(f"instruction set {name!r} is not available here, choose from {available_isas()}")


def arena_bytes() -> int:
    """Bytes that the kernels keep between training steps: as much as the largest step left to its second phase."""
    compiled = native()
    return compiled.arena_bytes() if compiled is not None else 0


def release_arenas() -> None:
    """Gives back what :func:`arena_bytes` counts; the next step takes what it needs."""
    if (compiled := native()) is not None:
        compiled.release_arenas()


if native() is not None and "NERFVOL_ISA" in os.environ:
    try:
        set_isa(os.environ["NERFVOL_ISA"] or "auto")
    except ValueError as error:
        raise InputError(f"the environment's NERFVOL_ISA cannot be used: {error}") from None
