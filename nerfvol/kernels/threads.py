"""How many threads the kernels use, and which build of them runs."""

from __future__ import annotations

import os
import sys

from nerfvol.native import native


def set_threads(n: int) -> None:
    """Threads of the kernels, and of torch where it is loaded or stands in for them."""
    if n < 1:
        raise ValueError(f"threads must be at least 1, got {n}")
    if (compiled := native()) is not None:
        compiled.set_threads(n)
    if compiled is None or sys.modules.get("torch") is not None:
        import torch

        torch.set_num_threads(n)


def get_threads() -> int:
    compiled = native()
    if compiled is not None:
        return compiled.get_threads()
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
    """Chooses a build: "auto" or one of :func:`available_isas`."""
    compiled = native()
    if compiled is None or not compiled.set_isa(name):
        raise ValueError(f"instruction set {name!r} is not available here, choose from {available_isas()}")


if native() is not None and "NERFVOL_ISA" in os.environ:
    set_isa(os.environ["NERFVOL_ISA"])
