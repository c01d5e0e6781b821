"""The compiled module, where there is one.

The extension is installed at top level (``_nerfvol_kernels``), so that a checkout's Python and an installed package find
the same build. Without it everything runs on the torch reference, slowly; that is said once.
"""

from __future__ import annotations

import functools
import os
import warnings
from types import ModuleType


class ReferencePathWarning(UserWarning):
    """The compiled kernels are missing; the torch reference is used."""


@functools.cache
def native() -> ModuleType | None:
    """The compiled module or None. ``NERFVOL_REFERENCE=1`` asks for the reference path."""
    if os.environ.get("NERFVOL_REFERENCE"):
        return None
    try:
        import _nerfvol_kernels
    except ImportError as e:
        warnings.warn(
            f"nerfvol's compiled kernels are not available ({e}): running on the torch reference, which is far slower; "
            "reinstall with a C++17 compiler at hand to get them",
            ReferencePathWarning,
            stacklevel=2,
        )
        return None
    return _nerfvol_kernels
