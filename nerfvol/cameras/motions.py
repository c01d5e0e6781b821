"""Small motions of cameras, and steps on them along a loss's gradient: what refining poses takes.

A motion (w, v) of a camera, in its own axes x right, y down, z forward: what it saw at t it sees at exp([w]) t + v. Steps
are taken about a pivot p on the axis, at the subject's distance D: exp([w]) (t - p) + p + s. There s shifts the picture and
w shows as parallax alone, where about the camera's centre turning and shifting would look nearly the same. Units are such
that each number moves the picture by about a pixel: s by D / f, w about x and y by 2 / f (the scene is about as deep as it
is far), about z by 4 / width.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.rotations import rotation_of

Float = NDArray[np.float64]
BETA1, BETA2 = 0.8, 0.95
"""Memory, per visit of a camera, of Adam's moments: a camera is visited some dozen times."""
_FLIP = np.array([1.0, -1.0, -1.0])  # OpenGL axes to x right, y down, z forward


def moved(c2w: Float, motion: ArrayLike) -> Float:
    """The pose (4, 4) after a motion (6,) of its camera."""
    w, v = np.split(np.asarray(motion, np.float64), 2)
    axes = (c2w[:3, :3] * _FLIP) @ rotation_of(w).T
    out = c2w.copy()
    out[:3, :3], out[:3, 3] = axes * _FLIP, c2w[:3, 3] - axes @ v
    return out


class Motions:
    """Poses that follow a loss's gradient by Adam, each camera with its own moments.

    ``poses``: (n, 4, 4) camera to world, OpenGL axes; ``given``: those at the start. ``distance``: of the pivots, scene units.
    """

    def __init__(self, cameras: Sequence[Camera], distance: float) -> None:
        self.given: Float = np.stack([camera.c2w for camera in cameras]).astype(np.float64)
        self.poses, self.distance = self.given.copy(), distance
        n = len(self.poses)
        self.first, self.second, self.visits = np.zeros((n, 6)), np.zeros((n, 6)), np.zeros(n, np.int64)

    def camera(self, i: int, camera: Camera) -> Camera:
        """``camera`` at pose i."""
        return replace(camera, c2w=self.poses[i])

    def step(self, i: int, gradient: ArrayLike, lens: Intrinsics, pixels: float) -> None:
        """Moves camera i against the ``gradient`` (6,) in its motion, by about ``pixels`` of a picture of ``lens``."""
        w, v = np.split(np.asarray(gradient, np.float64), 2)
        pivot = np.array([0.0, 0.0, self.distance])
        g = np.concatenate([w - np.cross(pivot, v), v])
        self.visits[i] += 1
        self.first[i] += (1 - BETA1) * (g - self.first[i])
        self.second[i] += (1 - BETA2) * (g * g - self.second[i])
        n = int(self.visits[i])
        mean, size = self.first[i] / (1 - BETA1**n), np.sqrt(self.second[i] / (1 - BETA2**n))
        step = -pixels * _units(lens, self.distance) * mean / np.maximum(size, 1e-30)
        about_centre = step[3:] + pivot - rotation_of(step[:3]) @ pivot
        self.poses[i] = moved(self.poses[i], np.concatenate([step[:3], about_centre]))

    def back(self) -> tuple[float, Float, Float]:
        """Scale, rotation (3, 3) and shift (3,) that bring the refined cameras nearest to the given ones: scale R x + shift.

        Scene and cameras together may turn, shift and grow, and show the same: this is what of the motions was only that.
        Least squares of centres and, weighed by the distance, of axes [Umeyama 1991].
        """
        to, of = self.given[:, :3, 3], self.poses[:, :3, 3]
        a, b = to - to.mean(0), of - of.mean(0)
        axes = np.einsum("nij,nkj->ik", self.given[:, :3, :3], self.poses[:, :3, :3])
        u, _, vt = np.linalg.svd(np.einsum("ni,nj->ij", a, b) + self.distance**2 * axes)
        rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
        spread = float((b * b).sum())
        scale = float((a * (b @ rotation.T)).sum()) / spread if spread > 0 else 1.0
        scale = scale if scale > 0 else 1.0
        return scale, rotation, to.mean(0) - scale * rotation @ of.mean(0)

    def put_back(self) -> Float:
        """The refined poses (n, 4, 4) after :meth:`back`."""
        scale, rotation, shift = self.back()
        out = self.poses.copy()
        out[:, :3, :3] = rotation @ self.poses[:, :3, :3]
        out[:, :3, 3] = scale * self.poses[:, :3, 3] @ rotation.T + shift
        return out

    def pixels(self, lenses: Sequence[Intrinsics]) -> Float:
        """(n,) how far what lies around the pivot moved in each picture, after :meth:`back`: root mean square of the pivot's
        shift and of what turning does a quarter of the picture beside it."""
        after = self.put_back()
        out = np.empty(len(after))
        for i, (pose, lens) in enumerate(zip(after, lenses, strict=True)):
            # The motion from the given camera's axes to those of the refined one.
            axes, before = pose[:3, :3] * _FLIP, self.given[i, :3, :3] * _FLIP
            side = self.distance * min(lens.width / lens.fx, lens.height / lens.fy) / 4
            t = np.array([(x, y, self.distance) for x in (-side, side) for y in (-side, side)])
            seen = (t @ before.T + self.given[i, :3, 3] - pose[:3, 3]) @ axes
            shift = seen[:, :2] / seen[:, 2:] - t[:, :2] / t[:, 2:]
            out[i] = np.sqrt(((shift * (lens.fx, lens.fy)) ** 2).sum(1).mean())
        return out

    def state_dict(self) -> dict[str, Any]:
        """What a continuation needs."""
        return {"poses": self.poses, "first": self.first, "second": self.second, "visits": self.visits}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from :meth:`state_dict`; ValueError where it does not fit."""
        for name in ("poses", "first", "second", "visits"):
            before, value = getattr(self, name), np.array(state[name])
            if value.shape != before.shape or not np.isfinite(value).all():
                raise ValueError(f"refined poses: {name} is {value.shape}, expected {before.shape}")
            setattr(self, name, value.astype(before.dtype))


def _units(lens: Intrinsics, distance: float) -> Float:
    focal = (lens.fx + lens.fy) / 2
    return np.array([2 / focal, 2 / focal, 4 / lens.width, *[distance / focal] * 3])
