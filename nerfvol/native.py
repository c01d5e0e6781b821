"""The compiled module, where there is one.

The extension is installed at top level (``_nerfvol_kernels``), so that a checkout's Python and an installed package find
the same build. Without it everything runs on the torch reference, slowly; that is said once. Arrays whose rows the
kernels load as vectors begin on a cache line: :func:`aligned_empty`.
"""

from __future__ import annotations

import functools
import os
import warnings
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from nerfvol.errors import InputError

CACHE_LINE = 64
"""Bytes; also the width of the widest vector."""


class ReferencePathWarning(UserWarning):
    """The compiled kernels are missing; the torch reference is used."""


@functools.cache
def native() -> ModuleType | None:
    """The compiled module or None. ``NERFVOL_REFERENCE=1`` asks for the reference path."""
    if os.environ.get("NERFVOL_REFERENCE"):
        return None
    try:
        import _nerfvol_kernels  # pyright: ignore[reportMissingImports]  # the extension, where it was built
    except ImportError as e:
        warnings.warn(
            f"nerfvol's compiled kernels are not available ({e}): running on the torch reference, which is far slower "
            "and needs nerfvol[mlp]; reinstall with a C++17 compiler at hand to get them",
            ReferencePathWarning,
            stacklevel=2,
        )
        return None
    return _nerfvol_kernels


def need_torch(what: str) -> None:
    """Everything that imports torch asks here first: the package runs without it where the kernels are compiled.

    Raises:
        InputError: torch is not installed; ``what`` is what needs it, the beginning of the sentence.
    """
    try:
        import torch  # noqa: F401
    except ImportError as error:
        raise InputError(f"{what} needs torch ({error}): pip install 'nerfvol[mlp]'") from error


def aligned_empty(shape: int | tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """An uninitialised C-contiguous array of this shape, any, that begins on a cache line.

    numpy's own begin 16 bytes past one once they are large, so that every row of 64 bytes lies on two lines and each
    load of it costs two. The memory is numpy's all the same, with the large pages it asks the system for.
    """
    size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    memory = np.empty(size + CACHE_LINE, np.uint8)
    start = -memory.ctypes.data % CACHE_LINE
    return memory[start : start + size].view(dtype).reshape(shape)


def aligned(array: NDArray[Any], dtype: DTypeLike) -> NDArray[Any]:
    """``array`` itself where it has the dtype, is C-contiguous and begins on a cache line; else such a copy. Any shape."""
    if array.dtype == dtype and array.flags.c_contiguous and array.ctypes.data % CACHE_LINE == 0:
        return array
    copy = aligned_empty(array.shape, dtype)
    copy[...] = array
    return copy
