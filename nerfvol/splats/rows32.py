"""``.splat`` files: rows of 32 bytes without a header, as the first viewers in browsers read them (antimatter15's splat).

Little-endian: position and scales, 3 float32 each, scales as they are and not their logarithms; red, green, blue and opacity, a
byte each of what is between 0 and 1; a quaternion, w first, a byte each: 128 (v + 1). No harmonics above degree 0.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from nerfvol.errors import InputError
from nerfvol.files.atomic import explain_os_error
from nerfvol.octree.points import Y00
from nerfvol.splats.foreign import checked, logits_of
from nerfvol.splats.splats import Splats

_ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def load_splat(path: str | os.PathLike[str]) -> Splats:
    """The Gaussians of a ``.splat`` file, of degree 0 and "plain", for nothing in it says otherwise.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    try:
        data = Path(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"no such .splat file: {path}") from error
    except OSError as error:
        raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error

    def fault(reason: str) -> InputError:
        return InputError(f"{path} is not a usable .splat file: {reason}")

    if len(data) % _ROW.itemsize:
        raise fault(f"its {len(data)} bytes are no multiple of the {_ROW.itemsize} of a Gaussian")
    rows = np.frombuffer(data, _ROW)
    if (negative := (rows["scales"] < 0).any(axis=1)).any():
        raise fault(f"a scale of vertex {int(negative.argmax())} is negative")
    quats = ((rows["quats"].astype(np.float32) - 128) / 128).astype(np.float32)
    quats[(rows["quats"] == 128).all(axis=1)] = (1, 0, 0, 0)  # programs write it for a ball, which no rotation turns
    rgba = rows["rgba"] / 255.0
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.log(rows["scales"])
    return checked(
        fault, means=rows["means"].astype(np.float32), log_scales=log_scales.astype(np.float32), quats=quats,
        logits=logits_of(rgba[:, 3]), sh=((rgba[:, :3] - 0.5) / Y00).astype(np.float32)[:, :, None], origin=np.zeros(3),
        mode="plain",
    )  # fmt: skip
