"""A folder with a COLMAP model in text, ``cameras.txt``, ``images.txt`` and ``points3D.txt`` (without points), of the cameras.

Poses are world-to-camera, OpenCV axes (x right, y down, z forward), quaternions w first. Cameras of the same intrinsics are
one.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from nerfvol.cameras.camera import Intrinsics
from nerfvol.cameras.further_lenses import FieldOfView, Rational
from nerfvol.errors import InputError
from nerfvol.export.surface import Cameras
from nerfvol.export.transforms import require_cameras
from nerfvol.files.atomic import ensure_writable_folder, write_text
from nerfvol.models import Model
from nerfvol.rotations import quaternion


def memory(model: Model, cameras: Cameras | None = None) -> int:
    """Bytes that writing takes."""
    return 1 << 14 if cameras is None else 2000 * len(cameras.cameras)


def write(model: Model, path: str | os.PathLike[str], cameras: Cameras | None = None) -> int:
    """The three files in the folder ``path``; their bytes. InputError where there are no cameras."""
    given = require_cameras(cameras, "colmap")
    lenses = list(dict.fromkeys(camera.intrinsics for camera in given.cameras))
    lines = [f"{number} {_camera(lens)}" for number, lens in enumerate(lenses, 1)]
    images = []
    for number, (camera, name) in enumerate(zip(given.cameras, given.names, strict=True), 1):
        rotation = (camera.c2w[:3, :3] * (1, -1, -1)).T
        pose = [*quaternion(rotation), *(-rotation @ camera.position)]
        file = Path(name).name.replace(" ", "_")  # the format has no quotes
        images += [f"{number} {_numbers(pose)} {1 + lenses.index(camera.intrinsics)} {file}", ""]
    folder = ensure_writable_folder(path)
    files = {
        "cameras.txt": "\n".join(["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", *lines, ""]),
        "images.txt": "\n".join(
            ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME; then a line of points", *images, ""]
        ),
        "points3D.txt": "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]\n",
    }
    for name, text in files.items():
        write_text(folder / name, text)
    return sum((folder / name).stat().st_size for name in files)


def _camera(lens: Intrinsics) -> str:
    size, focal = f"{lens.width} {lens.height}", (lens.fx, lens.fy, lens.cx, lens.cy)
    if not any(lens.distortion):
        return f"PINHOLE {size} {_numbers(focal)}"
    k = lens.lens.coefficients
    if lens.fisheye:
        return f"OPENCV_FISHEYE {size} {_numbers([*focal, *(k.get(f'k{i}', 0.0) for i in (1, 2, 3, 4))])}"
    if isinstance(lens.lens, Rational):
        order = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        return f"FULL_OPENCV {size} {_numbers([*focal, *(k[name] for name in order)])}"
    if isinstance(lens.lens, FieldOfView):
        return f"FOV {size} {_numbers([*focal, k['omega']])}"
    if set(k) - {"k1", "k2", "k3", "k4", "p1", "p2"}:
        raise InputError(f"COLMAP has no lens of the kind {type(lens.lens).__name__}")
    four = [k.get(name, 0.0) for name in ("k1", "k2", "p1", "p2")]
    if not (k.get("k3") or k.get("k4")):
        return f"OPENCV {size} {_numbers([*focal, *four])}"
    if k.get("k4"):  # a polynomial of the fourth order, which FULL_OPENCV's k4 (below the line) is not
        raise InputError("COLMAP has no lens with a fourth radial coefficient k4")
    return f"FULL_OPENCV {size} {_numbers([*focal, *four, k['k3'], 0, 0, 0])}"


def _numbers(values: object) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))  # type: ignore[arg-type]
