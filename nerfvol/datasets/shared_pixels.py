"""A decoded Pillow image's pixels as numpy sees them, not copied: numpy's own way copies twice, a fifth of what a PNG takes.

Pillow (11.3 and later) lends its memory by the Arrow C data interface (https://arrow.apache.org/docs/format/CDataInterface.html),
whose structures are laid out below; where it does not (older, or pictures of several blocks of memory) pixels are copied.
"""

from __future__ import annotations

import ctypes

import numpy as np
from numpy.typing import NDArray
from PIL import Image


class _Array(ctypes.Structure):
    """``struct ArrowArray``."""


_Array._fields_ = [
    ("length", ctypes.c_int64), ("null_count", ctypes.c_int64), ("offset", ctypes.c_int64),
    ("n_buffers", ctypes.c_int64), ("n_children", ctypes.c_int64), ("buffers", ctypes.POINTER(ctypes.c_void_p)),
    ("children", ctypes.POINTER(ctypes.POINTER(_Array))), ("dictionary", ctypes.c_void_p),
    ("release", ctypes.c_void_p), ("private_data", ctypes.c_void_p),
]  # fmt: skip

_pointer = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.py_object, ctypes.c_char_p)(
    ("PyCapsule_GetPointer", ctypes.pythonapi)
)


def pixels_of(image: Image.Image) -> NDArray[np.uint8]:
    """(h, w, channels) or (h, w), as np.asarray(image) has them; RGBA in the image's own memory, which refuses writing."""
    lent = _lent(image) if image.mode == "RGBA" else None
    return np.asarray(image) if lent is None else lent


def _lent(image: Image.Image) -> NDArray[np.uint8] | None:
    """The pixels (h, w, 4) of an RGBA image in its own memory, which lives as long as they do; None where it is not lent."""
    image.load()
    try:
        capsule = image.__arrow_c_array__()[1]
    except (AttributeError, ValueError, MemoryError):  # an older Pillow; several blocks of memory
        return None
    size = 4 * image.width * image.height
    pixels = ctypes.cast(_pointer(capsule, b"arrow_array"), ctypes.POINTER(_Array)).contents
    if pixels.n_children != 1 or pixels.offset or pixels.length * 4 != size:
        return None
    channels = pixels.children[0].contents
    if channels.length != size or channels.n_buffers != 2 or channels.offset or not channels.buffers[1]:
        return None
    memory = (ctypes.c_uint8 * size).from_address(channels.buffers[1])
    memory.owner = capsule  # type: ignore[attr-defined]  # gives the memory back when the last array on it is gone
    out = np.ctypeslib.as_array(memory).reshape(image.height, image.width, 4)
    out.flags.writeable = False
    return out
