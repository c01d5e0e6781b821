"""Training rays in 8x8 tiles: what the octree's kernels eat, drawn in a fixed, resumable order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from nerfvol.cameras.camera import Intrinsics, tile_pixels, tile_rays
from nerfvol.datasets.averages import plain_colour
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError, shown
from nerfvol.kernels.state import TILE_RAYS, Batch
from nerfvol.native import native


@dataclass
class Cursor:
    """How far one of the two shuffled queues is: position inside an epoch's permutation."""

    epoch: int = 0
    position: int = 0

    @classmethod
    def of(cls, state: Mapping[str, int]) -> Cursor:
        """From what ``dataclasses.asdict`` made of one; ValueError where it holds no counts."""
        epoch, position = state["epoch"], state["position"]
        if type(epoch) is not int or type(position) is not int or min(epoch, position) < 0:
            raise ValueError(f"a queue's place must be counts, got {shown(epoch)} and {shown(position)}")
        return cls(epoch, position)


@dataclass
class Cursors:
    """How far both queues are: all that drawing remembers."""

    foreground: Cursor = field(default_factory=Cursor)
    background: Cursor = field(default_factory=Cursor)

    @classmethod
    def of(cls, state: Mapping[str, Mapping[str, int]]) -> Cursors:
        """From what ``dataclasses.asdict`` made of them."""
        return cls(Cursor.of(state["foreground"]), Cursor.of(state["background"]))


class TileBank:
    """All training pixels of one pyramid level as tiles.

    A *background tile* is one whose pixels all have the background's colour; the others are *foreground tiles*. Background
    tiles teach little but are many: they are drawn less often and weigh more, so that the expected loss stays the mean over
    all pixels. Those of a picture share one tile of pixels: where much is background, the bank is a fraction of the pictures.

    ``second``: another background; the same tiles can be drawn before it, and a background tile is plain before both.
    """

    def __init__(
        self, dataset: Dataset, background: Sequence[float], k: int, second: Sequence[float] | None = None
    ) -> None:
        backgrounds = [background] if second is None else [background, second]
        sorted_out = dataset.before_each(
            backgrounds, k, lambda pictures: _sort_out([_tiled(picture) for picture in pictures], backgrounds)
        )
        self.pixels = [pixels[0] for pixels, _ in sorted_out]
        self.second_pixels = [pixels[-1] for pixels, _ in sorted_out]
        self.row = np.concatenate([row for _, row in sorted_out])
        cameras = [c.scaled(k) for c in dataset.cameras]
        self.origins = np.stack([c.c2w[:3, 3] for c in cameras]).astype(np.float32)
        self.rotations = np.stack([c.c2w[:3, :3] for c in cameras]).astype(np.float32)
        self.pixel_angle = float(np.median([1 / max(c.intrinsics.fx, c.intrinsics.fy) for c in cameras]))
        masks = dataset.weights(k)
        tables: dict[Intrinsics, np.ndarray] = {}  # camera-space directions in tile order, per distinct intrinsics
        self._directions: list[np.ndarray] = []
        insides, image_of, tile_of = [], [], []
        for i, camera in enumerate(cameras):
            intrinsics = camera.intrinsics
            flat = tile_pixels(intrinsics.width, intrinsics.height)
            if intrinsics not in tables:
                rays = tile_rays(intrinsics.width, intrinsics.height)
                tables[intrinsics] = intrinsics.directions().reshape(-1, 3)[rays]
            self._directions.append(tables[intrinsics])
            insides.append(_counting(flat, None if masks is None else masks[i]))
            image_of.append(np.full(len(flat), i, np.int32))
            tile_of.append(np.arange(len(flat), dtype=np.int32))
        self.is_background = self.row == 0
        self.image = np.concatenate(image_of)
        self.tile = np.concatenate(tile_of)
        self._inside = insides
        self._padded = any(inside is not None for inside in insides)
        counts = np.concatenate([
            np.ones(len(directions), bool) if inside is None else inside.any(axis=1)
            for inside, directions in zip(insides, self._directions, strict=True)
        ])  # fmt: skip
        self.foreground_tiles, self.background_tiles = (
            np.flatnonzero(chosen & counts).astype(np.int32) for chosen in (~self.is_background, self.is_background)
        )
        if not counts.any():
            raise InputError(f"{dataset.source}: masks leave nothing of the images averaged by {k}")

    @property
    def _n_counting(self) -> int:
        """Tiles of which anything counts: a mask may leave out whole ones."""
        return len(self.foreground_tiles) + len(self.background_tiles)

    @property
    def n_tiles(self) -> int:
        """Tiles of all images."""
        return len(self.image)

    @property
    def n_rays(self) -> int:
        """Rays of all tiles, padding included."""
        return self.n_tiles * TILE_RAYS

    def draw(self, n: int, foreground_share: float, seed: int, cursors: Cursors, second: bool = False) -> Batch:
        """The next n tiles: a share of ``foreground_share`` from the foreground's queue, the rest from the background's.
        ``second``: before the second background."""
        n_foreground = n if not len(self.background_tiles) else min(n, round(n * foreground_share))
        if not len(self.foreground_tiles):
            n_foreground = 0
        parts, weights = [], []
        for tiles, cursor, count, stream in (
            (self.foreground_tiles, cursors.foreground, n_foreground, 0),
            (self.background_tiles, cursors.background, n - n_foreground, 1),
        ):
            if count:
                parts.append(_next(tiles, cursor, count, [seed, stream]))
                weights.append(np.full(count, len(tiles) / self._n_counting * n / count, np.float32))
        return self.batch(np.concatenate(parts), np.concatenate(weights), second)

    def batch(self, tiles: np.ndarray, tile_weights: np.ndarray, second: bool = False) -> Batch:
        """Rays and colours of the ``tiles`` (n,) int, in rising order; padding weighs 0, every other ray its tile's weight
        times its mask's. ``second``: before the second background.

        tile_weights: (n,) float32. The batch's arrays are float32: rays_o (n, 3), rays_d and target (64 n, 3), weight (64 n,).
        """
        order = np.argsort(tiles, kind="stable")  # neighbours in one image share the cache
        tiles, tile_weights = tiles[order], tile_weights[order]
        image, tile, row = self.image[tiles], self.tile[tiles], self.row[tiles]
        directions = np.empty((len(tiles), TILE_RAYS, 3), np.float32)
        target = np.empty((len(tiles), TILE_RAYS, 3), np.float32)
        weight = np.repeat(tile_weights[:, None], TILE_RAYS, 1)
        pixels = self.second_pixels if second else self.pixels
        if (compiled := native()) is not None:
            compiled.gather_tiles(self._directions, pixels, self.rotations, image, tile, row, directions, target)
        else:
            for i, (m, t, r) in enumerate(zip(image, tile, row, strict=True)):
                np.matmul(self._directions[m][t], self.rotations[m].T, out=directions[i])
                target[i] = pixels[m][r]
            target *= np.float32(1 / 255)
        if self._padded:
            for i, (m, t) in enumerate(zip(image, tile, strict=True)):
                if self._inside[m] is not None:
                    weight[i] *= self._inside[m][t] * np.float32(1 / 255)
        return Batch(self.origins[image], directions.reshape(-1, 3), target.reshape(-1, 3), weight.reshape(-1))


def _counting(flat: np.ndarray, mask: np.ndarray | None) -> np.ndarray | None:
    """How much the pixels ``flat`` (n, 64) of an image's tiles count, uint8: 0 for padding, else the mask's; None: all."""
    padding = flat < 0
    if mask is None:
        return np.where(padding, 0, 255).astype(np.uint8) if padding.any() else None
    return np.where(padding, 0, mask.reshape(-1)[np.maximum(flat, 0)]).astype(np.uint8)


def _tiled(image: np.ndarray) -> np.ndarray:
    """An image (h, w, 3) as tiles (n_tiles, 64, 3) in tile_pixels' order; padding repeats the border."""
    h, w = image.shape[:2]
    padded = np.pad(image, ((0, -h % 8), (0, -w % 8), (0, 0)), mode="edge") if h % 8 or w % 8 else image
    rows, cols = padded.shape[0] // 8, padded.shape[1] // 8
    return padded.reshape(rows, 8, cols, 8, 3).transpose(0, 2, 1, 3, 4).reshape(-1, TILE_RAYS, 3)


def _sort_out(
    tiles: Sequence[np.ndarray], backgrounds: Sequence[Sequence[float]]
) -> tuple[list[np.ndarray], np.ndarray]:
    """Of an image's ``tiles`` (n, 64, 3) before each of the ``backgrounds``: pixels (1 + foreground tiles, 64, 3), a background
    tile first; and which of these each tile is, (n,)."""
    plain = [np.tile(plain_colour(background), (1, TILE_RAYS, 1)) for background in backgrounds]
    foreground = np.any([(t != p).any((1, 2)) for t, p in zip(tiles, plain, strict=True)], axis=0)
    pixels = [np.concatenate([p, t[foreground]]) for t, p in zip(tiles, plain, strict=True)]
    return pixels, np.where(foreground, np.cumsum(foreground), 0).astype(np.int32)


def foreground_share(dataset: Dataset, background: Sequence[float], views: int = 4) -> float:
    """Share of foreground tiles in a few of the dataset's views: how large a TileBank will be."""
    rows = dataset.evenly(views).pyramid(background, 1, lambda image: _sort_out([_tiled(image)], [background])[1])
    return float(np.mean(np.concatenate(rows) > 0))


def _next(tiles: np.ndarray, cursor: Cursor, count: int, seed: list[int]) -> np.ndarray:
    """The next ``count`` of an endless sequence of shuffled epochs."""
    out = []
    if cursor.position >= len(tiles):  # of a set that was larger
        cursor.epoch, cursor.position = cursor.epoch + 1, 0
    while count > 0:
        order = _permutation(len(tiles), (*seed, cursor.epoch))
        taken = order[cursor.position : cursor.position + count]
        out.append(tiles[taken])
        count -= len(taken)
        cursor.position += len(taken)
        if cursor.position == len(tiles):
            cursor.epoch, cursor.position = cursor.epoch + 1, 0
    return np.concatenate(out)


_cached: dict[tuple[int, ...], np.ndarray] = {}


def _permutation(n: int, seed: tuple[int, ...]) -> np.ndarray:
    key = (n, *seed)
    if key not in _cached:
        if len(_cached) > 4:
            _cached.clear()
        order = np.random.Generator(np.random.Philox(np.random.SeedSequence(seed))).permutation(n)
        _cached[key] = order.astype(np.int32)
    return _cached[key]
