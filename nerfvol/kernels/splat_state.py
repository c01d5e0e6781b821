"""What goes into drawing and training splats, and what lives between two steps: plain data.

The kernels work on it; splat_ops.py checks it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.defaults import WHITE
from nerfvol.errors import InputError
from nerfvol.native import aligned, aligned_empty, native
from nerfvol.rotations import rotations
from nerfvol.splats import packing
from nerfvol.splats.packing import LANES, PackedSplats
from nerfvol.splats.splats import Splats

if TYPE_CHECKING:
    from nerfvol.cameras.camera import Camera


@dataclass(frozen=True)
class SplatView:
    """A pinhole camera; axes x right, y down, z forward; pixel centres end in 1/2.

    rotation (3, 3), translation (3,): t = rotation m + translation for a mean m relative to the splats' origin, float64, scene
    units; fx, fy, cx, cy: pixels; near: scene units, what is nearer along the axis is not seen.
    """

    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = 0.01

    def __post_init__(self) -> None:
        rotation, translation = (np.asarray(a, np.float64) for a in (self.rotation, self.translation))
        numbers = (self.fx, self.fy, self.cx, self.cy, self.near)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(
                f"a view needs a rotation (3, 3) and a translation (3,), got {rotation.shape}, {translation.shape}"
            )
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all() and np.isfinite(numbers).all()):
            raise InputError("a view's pose and intrinsics must be finite")
        if not (self.fx > 0 and self.fy > 0 and self.near > 0 and self.width > 0 and self.height > 0):
            raise InputError("a view's focal lengths, near plane and size must be positive")
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)

    @property
    def eye(self) -> NDArray[np.float64]:
        """(3,) the camera's centre relative to the splats' origin."""
        return -self.rotation.T @ self.translation


def view_of(camera: Camera, splats_origin: ArrayLike, near: float = 0.01) -> SplatView:
    """``camera`` as seen from splats about ``splats_origin`` (3,), scene units; InputError where its lens is no pinhole."""
    lens, c2w = camera.intrinsics, np.asarray(camera.c2w, np.float64)
    if lens.fisheye or any(lens.distortion):
        raise InputError("splats are drawn through a pinhole: undistort the photographs first")
    rotation = (c2w[:3, :3] * (1.0, -1.0, -1.0)).T  # OpenGL axes to x right, y down, z forward
    translation = -rotation @ (c2w[:3, 3] - np.asarray(splats_origin, np.float64))
    return SplatView(rotation, translation, lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height, near)


@dataclass(frozen=True)
class SplatOptions:
    """Weights of the loss's terms, see splat_reference.loss; each term is a mean over the picture's valid pixels.

    scale: weight of the mean over splats of the sum of their three scales, 1 / scene unit; opacity: of their mean opacity. Both
    act only on splats that a step hits. A tile in which a splat's weights stay below weight_threshold leaves it no gradient.
    """

    background: tuple[float, float, float] = WHITE
    l1: float = 0.0
    squared: float = 1.0
    ssim: float = 0.0
    scale: float = 0.0
    opacity: float = 0.0
    early_stop_eps: float = 3e-3
    weight_threshold: float = 4e-3


@dataclass(frozen=True)
class SplatRates:
    """Adam: value -= rate m / (1 - beta1^n) / (sqrt(v / (1 - beta2^n)) + eps), n the splat's own number of updates.

    means: as a factor of the splat's own size, the geometric mean of its scales. most_log_ratio: after a step a splat's longest
    scale is at most this above the second, as logarithms; 0: any.
    """

    means: float = 0.2
    log_scales: float = 0.12
    quats: float = 0.02
    logits: float = 0.08
    dc: float = 0.03
    sh: float = 0.005
    beta1: float = 0.9
    beta2: float = 0.98
    eps: float = 1e-12
    most_log_ratio: float = 0.0


@dataclass(frozen=True)
class SplatReport:
    """loss: the terms of pixels and of blocks; squared_error: mean over valid pixels and channels; visible: splats in the
    picture; entries: pairs of splat and tile; blocks: of 4x4 pixels that were drawn; motion: the loss's gradient in a motion
    of the camera (splat_reference.moved), where it was asked for."""

    loss: float
    squared_error: float
    visible: int
    entries: int
    blocks: int
    motion: tuple[float, ...] | None = None


class SplatState:
    """Splats in training: parameters, Adam's moments, each splat's number of updates, statistics.

    params, first, second: (n_blocks, 11 + 3 K, 16) float32, see splats.packing. updates, error (sum of weight times pixel
    error), max_weight, seen (views in which it was in the picture): (n_blocks, 16) float32; the last three since
    :meth:`reset_statistics`.
    """

    ARRAYS = ("params", "first", "second", "updates", "error", "max_weight", "seen")

    def __init__(self, splats: Splats | PackedSplats):
        packed = packing.pack(splats) if isinstance(splats, Splats) else splats
        self.n, self.origin, self.mode = packed.n, packed.origin, packed.mode
        self.params = aligned(packed.params, np.float32)
        self.first, self.second = self._zeros(self.params.shape), self._zeros(self.params.shape)
        self.updates = self._zeros((len(self.params), LANES))
        self.reset_statistics()

    @staticmethod
    def _zeros(shape: tuple[int, ...]) -> NDArray[np.float32]:
        out = aligned_empty(shape, np.float32)
        out[...] = 0
        return out

    @property
    def packed(self) -> PackedSplats:
        """The parameters, not copied."""
        return PackedSplats(self.params, self.n, self.origin, self.mode)

    def splats(self) -> Splats:
        """A copy as plain arrays."""
        return packing.unpack(self.packed)

    def reset_statistics(self) -> None:
        """Begins again: error, max_weight and seen (n_blocks, 16) are zero."""
        self.error, self.max_weight, self.seen = (self._zeros((len(self.params), LANES)) for _ in range(3))

    def arrays(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps: the class's arrays, not copied, and n (), origin (3,) and mip () as arrays.

        mip: whether the mode is "mip".
        """
        head = {"n": np.array(self.n), "origin": self.origin, "mip": np.array(self.mode == "mip")}
        return {name: getattr(self, name) for name in self.ARRAYS} | head

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> SplatState:
        """The inverse of :meth:`arrays`; copies only what is not float32 on a cache line.

        Raises:
            ValueError: they do not have the shapes that the class states.
            KeyError: one is missing.
        """
        state = cls.__new__(cls)
        state.n, state.origin = int(arrays["n"]), np.asarray(arrays["origin"], np.float64)
        state.mode = "mip" if bool(arrays["mip"]) else "plain"
        for name in cls.ARRAYS:
            setattr(state, name, aligned(np.asarray(arrays[name]), np.float32))
        state.check()
        return state

    def check(self) -> None:
        """ValueError unless every array fits: the kernels write to them without looking."""
        blocks = packing.n_blocks(self.n)
        if self.n < 0 or self.origin.shape != (3,) or not np.isfinite(self.origin).all():
            raise ValueError(f"splat state: expected splats about a place (3,), got {self.n} about {self.origin}")
        rows = self.params.shape[1] if self.params.ndim == 3 else 0
        if rows - packing.SH not in (3, 12, 27, 48):
            raise ValueError(f"splat state: params must be (n_blocks, 11 + 3 K, 16), got {self.params.shape}")
        for name in self.ARRAYS:
            a, shape = getattr(self, name), (blocks, rows, LANES) if name in self.ARRAYS[:3] else (blocks, LANES)
            if a.shape != shape or a.dtype != np.float32 or not a.flags.c_contiguous:
                raise ValueError(f"splat state: {name} must be float32 {shape}, got {a.dtype} {a.shape}")

    def per_splat(self, name: str) -> NDArray[np.float32]:
        """(n,) of "updates", "error", "max_weight" or "seen"; a view, not a copy."""
        return getattr(self, name).reshape(-1)[: self.n]

    def row(self, row: int) -> NDArray[np.float32]:
        """(n,) a copy of one row of the parameters."""
        return self.params[:, row].reshape(-1)[: self.n]

    # ------------------------------------------------------------------ which splats there are
    def gather(self, indices: ArrayLike) -> None:
        """Keeps the splats at ``indices`` (m,) int, in that order and as often as they are named.

        Raises ValueError where an index is outside [0, n), or they are not (m,).
        """
        index = np.ascontiguousarray(indices, dtype=np.int64)
        if index.ndim != 1 or (len(index) and not 0 <= index.min() <= index.max() < self.n):
            raise ValueError(f"indices must lie in [0, {self.n})")
        fill = packing.padding(self.params.shape[1])
        for name in self.ARRAYS:
            old = getattr(self, name)
            blocks = old if old.ndim == 3 else old[:, None, :]
            new = _gather(blocks, index, fill if name == "params" else np.zeros(blocks.shape[1], np.float32))
            setattr(self, name, new if old.ndim == 3 else new.reshape(-1, LANES))
        self.n = len(index)

    def prune(self, keep: ArrayLike) -> None:
        """Keeps the splats where ``keep`` (n,) is true; ValueError where it has another shape."""
        mask = np.asarray(keep, bool)
        if mask.shape != (self.n,):
            raise ValueError(f"keep must have shape ({self.n},), got {mask.shape}")
        self.gather(np.flatnonzero(mask))

    def split(self, indices: ArrayLike, shift: float = 0.6, shrink: float = 1.7) -> None:
        """Splits each splat at ``indices`` (m,) in two along its longest axis; the second one stands right behind the first.

        The halves move by ``shift`` of that axis' scale s, to either side, and s becomes s / ``shrink``. Second moments are
        halved, first ones zeroed.
        """
        chosen = np.zeros(self.n, bool)
        chosen[np.asarray(indices, np.int64)] = True
        copies = np.where(chosen, 2, 1)
        at = np.cumsum(copies)[chosen] - 2  # the first half of each
        self.gather(np.repeat(np.arange(self.n), copies))
        for place, sign in ((at, shift), (at + 1, -shift)):
            block, lane = place // LANES, place % LANES
            rows = self.params[block, :, lane]
            longest = np.argmax(rows[:, packing.LOG_SCALES], axis=1)
            pick = np.arange(len(rows))
            scale = np.exp(rows[pick, 3 + longest])
            axis = rotations(rows[:, packing.QUATS])[pick, :, longest].astype(np.float32)
            self.params[block, :3, lane] = rows[:, packing.MEANS] + (sign * scale)[:, None] * axis
            self.params[block, 3 + longest, lane] = rows[pick, 3 + longest] - np.float32(np.log(shrink))
            self.first[block, :, lane] = 0
            self.second[block, :, lane] *= 0.5

    def grow(self, count: int, rng: np.random.Generator, power: float = 0.7, fade: float = 0.3) -> int:
        """Splits ``count`` splats drawn with probability ~ error^power, or all that have an error; returns how many.

        Afterwards the errors are multiplied by ``fade``, so that a round of growth still knows a little of what went before.
        """
        chance = self.per_splat("error").astype(np.float64).clip(0) ** power
        count = min(count, int(np.count_nonzero(chance)))
        if count > 0:
            self.split(rng.choice(self.n, count, replace=False, p=chance / chance.sum()))
        self.error *= np.float32(fade)
        return max(count, 0)

    def reorder(self, middle: ArrayLike | None = None, size: float | None = None) -> None:
        """Sorts the splats along a Morton curve through space, contracted outside a box about ``middle`` (3,) of half side
        ``size`` (relative to the origin, scene units); without them the box holds the middle 80 % of the means on each axis."""
        if not self.n:
            return
        if middle is None or size is None:
            low, high = (np.array([np.quantile(self.row(k)[::7], q) for k in range(3)]) for q in (0.1, 0.9))
            middle, size = (low + high) / 2, float((high - low).max() / 2)
        codes = _morton(self.params, self.n, np.asarray(middle, np.float64), max(float(size), 1e-12))
        self.gather(np.argsort(codes, kind="stable"))


def _gather(blocks: np.ndarray, index: np.ndarray, fill: np.ndarray) -> np.ndarray:
    if (compiled := native()) is None:
        return packing.to_blocks(packing.from_blocks(blocks, blocks.shape[0] * LANES)[index], fill)
    out = aligned_empty((packing.n_blocks(len(index)), blocks.shape[1], LANES), np.float32)
    compiled.splat_gather(blocks, index, fill, out)
    return out


def _morton(params: np.ndarray, n: int, middle: np.ndarray, size: float) -> np.ndarray:
    """(n,) uint64 codes: 21 bits an axis, even in the box, 1/x outside."""
    if (compiled := native()) is not None:
        codes = np.empty(n, np.uint64)
        compiled.splat_morton(params, middle.tolist(), size, codes)
        return codes
    codes = np.zeros(n, np.uint64)
    for k in range(3):
        x = (params[:, k].reshape(-1)[:n] - middle[k]) / size
        far = np.copysign(2 - 1 / np.maximum(np.abs(x), 1), x)
        cell = np.clip((np.where(np.abs(x) <= 1, x, far) + 2) / 4 * 2**21, 0, 2**21 - 1).astype(np.uint64)
        for bit in range(21):
            codes |= (cell >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + k)
    return codes
