"""Gaussians in the PLY layout of 3D Gaussian splatting (Kerbl et al. 2023), which every splat viewer reads.

Columns: x y z; nx ny nz (unused zeros); f_dc_0..2; f_rest_0..3(K - 1) - 1 channel by channel (all red, then green, then
blue); opacity (a logit); scale_0..2 (natural logarithms); rot_0..3 (a quaternion, w first, of any length). float32,
little-endian. Readers differ in what they tolerate, so no other column is written, and any order is read.
What the layout does not say is the footprint's low-pass: ``comment SplatRenderMode: mip`` says it as Brush, gsplat and
splat-transform do (``default`` is plain); Postshot's ``comment antialiased 1`` is read as well.
"""

from __future__ import annotations

import math
import os
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.splats.foreign import LARGEST, checked
from nerfvol.splats.near import relative
from nerfvol.splats.packed import is_packed, unpacked
from nerfvol.splats.plyfile import PlyFile, write_ply
from nerfvol.splats.splats import Splats

Mode = Literal["mip", "plain"]
MAX_DEGREE = 3
_ORIGIN = "nerfvol origin"
_WRITTEN = {"mip": "mip", "plain": "default"}


def save_ply(path: str | os.PathLike[str], splats: Splats) -> int:
    """Write ``splats`` to the PLY file ``path`` atomically and return its size in bytes.

    Positions are float32, absolute or, where map coordinates would lose their digits so, relative to the point of a comment
    ``nerfvol origin: X Y Z``. Quaternions are written as they are, so that a file that is read and written again has
    the same bytes.

    Raises:
        InputError: the path cannot be written, or a value is not finite.
    """
    try:
        splats.validate()
    except InputError as error:
        raise InputError(f"cannot write {path}: {error}") from error
    columns: dict[str, NDArray[np.float32]] = {}
    means, offset = relative(splats) if np.any(splats.origin) else (splats.means, np.zeros(3))
    if not np.isfinite(means).all():
        raise InputError(f"cannot write {path}: positions are too large for the format's float32")
    columns |= {name: means[:, k] for k, name in enumerate("xyz")}
    columns |= {name: np.zeros(splats.n, np.float32) for name in ("nx", "ny", "nz")}
    columns |= {f"f_dc_{k}": splats.sh[:, k, 0] for k in range(3)}
    rest = splats.sh[:, :, 1:].reshape(splats.n, 3 * (splats.sh.shape[2] - 1))  # channel by channel
    columns |= {f"f_rest_{k}": rest[:, k] for k in range(rest.shape[1])}
    columns["opacity"] = splats.logits
    columns |= {f"scale_{k}": splats.log_scales[:, k] for k in range(3)}
    columns |= {f"rot_{k}": splats.quats[:, k] for k in range(4)}
    comments = [f"SplatRenderMode: {_WRITTEN[splats.mode]}"]
    if offset.any():
        comments.append(f"{_ORIGIN}: {' '.join(repr(float(v)) for v in offset)}")
    return write_ply(path, comments, columns)


def is_splat_ply(path: str | os.PathLike[str]) -> bool:
    """Whether the PLY file holds Gaussians (its vertices have scales), not mere points.

    Raises:
        InputError: it is no PLY file.
    """
    with PlyFile(path) as file:
        return "scale_0" in file.dtypes or is_packed(file)


def load_ply(path: str | os.PathLike[str], mode: Mode = "plain") -> Splats:
    """The Gaussians of a PLY file; ``mode`` is what they are taken for where the file does not say.

    Binary of either byte order and ascii; columns in any order; others are ignored; or packed as SuperSplat does
    (splats/packed.py). The origin is that of a comment (see save_ply), else 0.

    Raises:
        InputError: one sentence that names the file and what is wrong with it.
    """
    with PlyFile(path) as file:
        stated = _mode(file)
        if is_packed(file):
            return checked(file.fault, **unpacked(file), origin=_origin(file), mode=stated or mode)
        degree = _check_columns(file)
        table = file.read()

        def columns(*names: str) -> NDArray[np.float32]:
            with np.errstate(over="ignore"):  # a double too large becomes infinite, and is refused below
                return np.stack([table[name].astype(np.float32) for name in names], axis=1)

        names = [f"f_rest_{k}" for k in range(3 * ((degree + 1) ** 2 - 1))]
        sh = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, :, None]
        if names:
            sh = np.concatenate([sh, columns(*names).reshape(len(sh), 3, len(names) // 3)], axis=2)
        return checked(
            file.fault, means=columns("x", "y", "z"), log_scales=columns("scale_0", "scale_1", "scale_2"),
            quats=columns(*(f"rot_{k}" for k in range(4))), logits=columns("opacity")[:, 0], sh=sh,
            origin=_origin(file), mode=stated or mode,
        )  # fmt: skip


def _mode(file: PlyFile) -> Mode | None:
    """What the comments say of the footprint."""
    for comment in file.comments:
        key, _, value = comment.partition(":")
        if key.strip().lower() == "splatrendermode":
            known: dict[str, Mode] = {"mip": "mip", "default": "plain"}
            if value.strip().lower() not in known:
                raise file.fault(f"its SplatRenderMode is {value.strip()[:40]!r}, expected mip or default")
            return known[value.strip().lower()]
        words = comment.lower().split()
        if words[:1] == ["antialiased"] and len(words) == 2:
            if words[1] not in ("0", "1"):
                raise file.fault(f"its comment 'antialiased' says {words[1][:40]!r}, expected 0 or 1")
            return "mip" if words[1] == "1" else "plain"
    return None


def _origin(file: PlyFile) -> NDArray[np.float64]:
    """(3,) what positions are relative to, as a comment says."""
    for comment in file.comments:
        key, _, value = comment.partition(":")
        if key.strip().lower() == _ORIGIN:
            try:
                origin = np.array([float(word) for word in value.split()])
            except ValueError:
                origin = np.zeros(0)
            if origin.shape != (3,) or not (np.abs(origin) < LARGEST).all():
                raise file.fault(f"its comment {_ORIGIN!r} says {value.strip()[:40]!r}, expected three finite numbers")
            return origin
    return np.zeros(3)


def _check_columns(file: PlyFile) -> int:
    """The SH degree; refuses a file without the columns of Gaussians."""
    wanted = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    wanted += [f"scale_{k}" for k in range(3)] + [f"rot_{k}" for k in range(4)]
    missing = [name for name in wanted if name not in file.dtypes]
    if missing:
        what = "these are points, not Gaussians" if "scale_0" in missing else "it holds no Gaussians of this layout"
        raise file.fault(f"its vertices have no property {missing[0]!r} ({what})")
    integers = [name for name in wanted if file.dtypes[name].kind != "f"]
    if integers:
        raise file.fault(
            f"its property {integers[0]!r} should be float or double, it is {file.dtypes[integers[0]].name}"
        )
    rest = sum(name.startswith("f_rest_") for name in file.dtypes)
    degree = math.isqrt(rest // 3 + 1) - 1
    if rest != 3 * ((degree + 1) ** 2 - 1) or degree > MAX_DEGREE:
        raise file.fault(f"it has {rest} columns f_rest_*, expected 0, 9, 24 or 45 (SH degree 0 to {MAX_DEGREE})")
    for k in range(rest):
        if f"f_rest_{k}" not in file.dtypes:
            raise file.fault(f"its vertices have no property 'f_rest_{k}'")
    return degree
