"""A scene as Gaussian splats: plain numpy arrays.

A splat is an ellipsoidal Gaussian: mean, scales along its own axes, their rotation, opacity, and spherical harmonics of its
colour, which is 1/2 + sum_k k Y(d), clamped at 0 from below, d the direction from the camera to the mean. How a camera sees it:
``nerfvol.kernels.splat_reference``. The mode is part of the scene: "mip" opacities are meant for a low-pass filter that keeps
the light of what is smaller than a pixel, "plain" ones for a filter that does not; drawing one as the other is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.errors import InputError

MODES = ("mip", "plain")
MAX_DEGREE = 3
REACH = 3.0
"""Standard deviations of a splat that count as its extent."""

Floats = NDArray[np.float32]


@dataclass
class Splats:
    """n splats.

    means: (n, 3) float32, scene units relative to ``origin``; log_scales: (n, 3) float32, natural logarithms of standard
    deviations in scene units; quats: (n, 4) float32 (w, x, y, z), of any length but zero; logits: (n,) float32, opacity =
    sigmoid(logit); sh: (n, 3, K) float32, K = (degree + 1)**2; origin: (3,) float64 scene units; mode: "mip" or "plain".
    """

    means: Floats
    log_scales: Floats
    quats: Floats
    logits: Floats
    sh: Floats
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    mode: str = "mip"

    def __post_init__(self) -> None:
        for name in ("means", "log_scales", "quats", "logits", "sh"):
            setattr(self, name, np.ascontiguousarray(getattr(self, name), dtype=np.float32))
        self.origin = np.asarray(self.origin, dtype=np.float64)

    @property
    def n(self) -> int:
        """Number of splats."""
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Degree of the colours' spherical harmonics."""
        return math.isqrt(self.sh.shape[-1]) - 1

    def validate(self) -> Splats:
        """Itself; InputError that names what is wrong."""
        n = self.n
        shapes = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "logits": (n,), "origin": (3,)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"splats: {name} must have shape {shape}, got {getattr(self, name).shape}")
        allowed = [(k + 1) ** 2 for k in range(MAX_DEGREE + 1)]
        if self.sh.ndim != 3 or self.sh.shape[:2] != (n, 3) or self.sh.shape[2] not in allowed:
            raise InputError(f"splats: sh must have shape ({n}, 3, K) with K among {allowed}, got {self.sh.shape}")
        if self.mode not in MODES:
            raise InputError(f"splats: mode must be among {MODES}, got {self.mode!r}")
        for name in ("means", "log_scales", "quats", "logits", "sh", "origin"):
            if not np.isfinite(values := getattr(self, name)).all():
                rows = int((~np.isfinite(values.reshape(len(values), -1))).any(1).sum())
                raise InputError(f"splats: {name} must be finite, {rows} rows are not")
        if zero := int((np.abs(self.quats).max(1, initial=0) < 1e-12).sum()):
            raise InputError(f"splats: quats must not be zero, {zero} of {n} are")
        return self

    def with_sh_degree(self, degree: int) -> Splats:
        """The same splats with more bands (zero) or fewer; InputError where splats have no such degree."""
        if not 0 <= degree <= MAX_DEGREE:
            raise InputError(f"splats have harmonics of degree 0 to {MAX_DEGREE}, got {degree}")
        coefficients = (degree + 1) ** 2
        sh = np.zeros((self.n, 3, coefficients), np.float32)
        kept = min(coefficients, self.sh.shape[2])
        sh[..., :kept] = self.sh[..., :kept]
        return replace(self, sh=sh)

    def aabb(self) -> NDArray[np.float64]:
        """(2, 3) float64 corners, scene units, of the box that holds every splat to three standard deviations."""
        if not self.n:
            return np.stack([self.origin, self.origin])
        scales = np.exp(2 * self.log_scales.astype(np.float64))
        half = REACH * np.sqrt((rotations(self.quats) ** 2 * scales[:, None, :]).sum(-1))
        return np.stack([(self.means - half).min(0), (self.means + half).max(0)]) + self.origin

    def select(self, indices: ArrayLike) -> Splats:
        """The splats at ``indices``, or where a mask (n,) is true."""
        i = np.asarray(indices)
        if not len(i):
            i = i.astype(np.int64)  # numpy takes an empty list for numbers
        return replace(
            self,
            means=self.means[i],
            log_scales=self.log_scales[i],
            quats=self.quats[i],
            logits=self.logits[i],
            sh=self.sh[i],
        )

    def concatenate(self, *others: Splats) -> Splats:
        """These splats and those of ``others``, see :func:`concatenate`."""
        return concatenate([self, *others])


def concatenate(parts: Sequence[Splats]) -> Splats:
    """All splats of ``parts`` about the first one's origin, with as many bands as the part that has most.

    Raises:
        InputError: there are no parts, or they differ in mode.
    """
    if not parts:
        raise InputError("there are no splats to concatenate")
    modes = sorted({part.mode for part in parts})
    if len(modes) > 1:
        raise InputError(f"splats of different modes cannot be concatenated, got {' and '.join(modes)}")
    degree, origin = max(part.sh_degree for part in parts), parts[0].origin
    moved = [replace(p.with_sh_degree(degree), means=p.means + (p.origin - origin), origin=origin) for p in parts]
    names = ("means", "log_scales", "quats", "logits", "sh")
    return replace(parts[0], **{name: np.concatenate([getattr(p, name) for p in moved]) for name in names})


def rotations(quats: ArrayLike) -> NDArray[np.float64]:
    """Matrices (n, 3, 3) float64 of quaternions (n, 4) of any length, columns being the splats' axes."""
    q = np.asarray(quats, np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def turning_z_to(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions (n, 4), w first, of rotations that turn the z axis to unit vectors (n, 3).

    Half the sum of z and the normal is the axis of the half turn; for normals that point down another one serves as well,
    since a disc has two sides.
    """
    n = np.where(normals[:, 2:] < 0, -normals, normals)
    q = np.stack([1 + n[:, 2], -n[:, 1], n[:, 0], np.zeros(len(n))], axis=1)
    return q / np.linalg.norm(q, axis=1, keepdims=True)
