"""Points from poses alone: for each photograph the depth at which others look the same around every pixel.

Per reference, at a quarter of the size: 64 planes, uniform in inverse depth; four neighbours seen through each plane; the
zero-mean normalised cross-correlation (ZNCC) of 7x7 greys,
    (S ab - S a S b / n) / sqrt((v_a + 4e-5)(v_b + 4e-5)),   S: sums over a window's n pixels, v: S aa - (S a)^2 / n,
and of a plane's neighbours the mean of the best two that see the pixel, so that what is hidden from one side does not
count. The best plane wins, refined by a parabola. A pixel becomes a point where its score is above 0.85, no plane that moves
it by 2 pixels or more does nearly as well (a wall without texture looks the same at every depth, a fence at several), and
another reference's depth map agrees within 4.5 %. Some points are added in the rest of each picture at the inverse depth of
the nearest such pixel, so that nothing begins empty.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.native import native
from nerfvol.splats.neighbours import nearest
from nerfvol.splats.points import PointCloud
from nerfvol.starts import sweep_reference
from nerfvol.starts.sweep_reference import SweepTask

Float = NDArray[np.float32]
UInt8 = NDArray[np.uint8]

PLANES = 64
MOST_REFERENCES = 64
NEIGHBOURS = 4
CONFIDENT = 0.85
CONTRAST = 0.05
"""The least by which a point's score is above that of its best rival."""
RIVAL = 2.0
"""Pixels: what moves a pixel by so much in the other pictures is another place."""
AGREEMENT = 0.045
POINTS = 20_000
FILL = 0.15
"""Points in the rest of the pictures, as a share of the others."""
FEWEST = 100
"""Confident pixels in all pictures, below which there is nothing to begin from."""
_BASELINE = 0.1  # of the depth: the best distance between two cameras
_WIDEST = np.cos(np.radians(60))
_MAPS = 4  # other references that are asked whether they agree
_GREY = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, eq=False)
class SweepView:
    """A pinhole picture: ``image`` (h, w, 4) uint8, the fourth channel 0 where it shows nothing and colours go on smoothly,
    since an edge there would be found in all pictures; ``camera`` of its size."""

    image: UInt8
    camera: Camera


@dataclass(frozen=True, eq=False)
class DepthMap:
    """What the sweep finds for view ``view``: ``inverse_depth`` (h, w) along its axis, per scene unit; ``score`` (h, w) in
    [-1, 1]; ``confident`` (h, w) bool: another reference agrees."""

    view: int
    inverse_depth: Float
    score: Float
    confident: NDArray[np.bool_]


def sweep_factor(width: int, height: int) -> int:
    """The reduction at which a photograph is swept: a power of two that leaves 9,000 pixels or more, at most 16."""
    factor = 1
    while factor < 16 and (width // (2 * factor)) * (height // (2 * factor)) >= 9_000:
        factor *= 2
    return factor


def plane_sweep(
    views: Sequence[SweepView], near: float, far: float, points: int = POINTS, seed: int = 0
) -> tuple[PointCloud, str]:
    """Points of a scene between the depths ``near`` and ``far``, and a sentence on what was found.

    The cloud is empty where nothing stands out (the sentence says why); what to do then is the caller's. The same result
    for any number of threads.
    """
    if len(views) < 2:
        return PointCloud.empty(), "a plane sweep needs two photographs or more"
    maps = depth_maps(views, near, far)
    found = sum(int(m.confident.sum()) for m in maps)
    if found < FEWEST:
        return PointCloud.empty(), (
            f"the plane sweep found only {found} places in {len(maps)} photographs at which several of them agree: "
            "too little texture, or poses that do not fit"
        )
    rng = np.random.default_rng(seed)
    share = min(1.0, points / found)
    clouds = [_points_of(views[m.view], m, share, rng) for m in maps]
    cloud = PointCloud(np.concatenate([c.positions for c in clouds]), np.concatenate([c.colours for c in clouds]))
    return cloud, f"{len(cloud)} points from a plane sweep over {len(maps)} of {len(views)} photographs"


def depth_maps(views: Sequence[SweepView], near: float, far: float) -> list[DepthMap]:
    """Depth maps of at most 64 views, evenly chosen, between the depths ``near`` and ``far`` along their axes.

    Depths in scene units. Raises ValueError unless 0 < near < far.
    """
    if not 0 < near < far:
        raise ValueError(f"expected depths with 0 < near < far, got {near} and {far}")
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), MOST_REFERENCES)).round().astype(int))
    cameras = [view.camera for view in views]
    typical = 2 / (1 / near + 1 / far)
    others = np.stack([neighbours_of(cameras, int(i), typical) for i in chosen])
    greys = [(view.image[..., :3] @ _GREY * np.float32(1 / 255)).astype(np.float32) for view in views]
    masks = [None if view.image[..., 3].all() else (view.image[..., 3] > 127).astype(np.uint8) for view in views]
    maps = np.zeros((*others.shape, 12))
    for k, n in np.argwhere(others >= 0):
        maps[k, n] = _map(cameras[chosen[k]], cameras[others[k, n]])
    first, step = 1 / far, (1 / near - 1 / far) / (PLANES - 1)
    outputs = [[np.empty(greys[i].shape, np.float32) for i in chosen] for _ in range(3)]
    apart = _apart(maps, others, step)
    task = SweepTask(
        greys,
        masks,
        chosen.astype(np.int32),
        others.astype(np.int32),
        maps.astype(np.float32),
        apart,
        PLANES,
        first,
        step,
    )
    compiled = native()
    if compiled is not None:
        compiled.plane_sweep(*(getattr(task, field.name) for field in fields(task)), *outputs)
    else:
        sweep_reference.plane_sweep(task, *outputs)
    # A pixel whose rivals all lie beyond the other pictures' edges (-1) has not been compared with anything.
    sure = [
        (score > CONFIDENT) & (score - rival > CONTRAST) & (rival > -1)
        for score, rival in zip(outputs[1], outputs[2], strict=True)
    ]
    agreed = [_agreeing(cameras, chosen, k, outputs[0], sure) for k in range(len(chosen))]
    found = zip(chosen, outputs[0], outputs[1], agreed, strict=True)
    return [DepthMap(int(i), inverse_depth, score, confident) for i, inverse_depth, score, confident in found]


def matched_pixels(
    views: Sequence[SweepView], maps: Sequence[DepthMap], near: float, far: float
) -> Iterator[tuple[int, int, NDArray[np.int64], NDArray[np.int64]]]:
    """For each map and each view that it was compared with: both views, and flat pixel numbers (m,) of what they share."""
    cameras = [view.camera for view in views]
    for found in maps:
        rows, columns = np.nonzero(found.confident)
        pixel = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
        here = rows * found.confident.shape[1] + columns
        for j in neighbours_of(cameras, found.view, 2 / (1 / near + 1 / far)):
            if j < 0 or not len(rows):
                continue
            m = _map(cameras[found.view], cameras[j])
            x, y, z = m[:9].reshape(3, 3) @ pixel + m[9:, None] * found.inverse_depth[rows, columns].astype(np.float64)
            height, width = views[j].image.shape[:2]
            z = np.where(z > 0, z, np.nan)
            u, v = x / z, y / z
            seen = (u >= 0) & (u < width) & (v >= 0) & (v < height)
            yield found.view, int(j), here[seen], v[seen].astype(np.int64) * width + u[seen].astype(np.int64)


def neighbours_of(cameras: Sequence[Camera], i: int, depth: float) -> NDArray[np.int64]:
    """The views (4,) that view i is compared with, -1 where there are fewer.

    The smallest |ln(baseline / 0.1 depth)| + 2 x the angle between axes; one that stands nearer to an earlier choice than
    half its own baseline comes last, so that they see the scene from several sides.
    """
    centres = np.stack([camera.position for camera in cameras])
    axes = np.stack([camera.forward for camera in cameras])
    baseline = np.linalg.norm(centres - centres[i], axis=1)
    cosine = np.clip(axes @ axes[i], -1, 1)
    cost = np.abs(np.log(np.maximum(baseline, 1e-12) / (_BASELINE * depth))) + 2 * np.arccos(cosine)
    usable = (baseline > 1e-4 * depth) & (cosine > _WIDEST)
    ranked = [int(j) for j in np.argsort(cost, kind="stable") if usable[j]]
    spread: list[int] = []
    for j in ranked:
        if len(spread) < NEIGHBOURS and all(
            np.linalg.norm(centres[j] - centres[k]) > 0.5 * baseline[j] for k in spread
        ):
            spread.append(j)
    chosen = (spread + [j for j in ranked if j not in spread])[:NEIGHBOURS]
    return np.array(chosen + [-1] * (NEIGHBOURS - len(chosen)), np.int64)


_FLIP = np.diag([1.0, -1.0, -1.0])  # OpenGL axes to x right, y down, z forward


def _calibration(camera: Camera) -> NDArray[np.float64]:
    i = camera.intrinsics
    return np.array([[i.fx, 0, i.cx], [0, i.fy, i.cy], [0, 0, 1]])


def _map(reference: Camera, other: Camera) -> NDArray[np.float64]:
    """(12,) A and b: the reference's pixel p at inverse depth w is A (p, 1) + w b in the other picture, homogeneous."""
    rotation = _FLIP @ other.c2w[:3, :3].T @ reference.c2w[:3, :3] @ _FLIP
    translation = _FLIP @ other.c2w[:3, :3].T @ (reference.position - other.position)
    k = _calibration(other)
    return np.concatenate([(k @ rotation @ np.linalg.inv(_calibration(reference))).ravel(), k @ translation])


def _apart(maps: NDArray[np.float64], others: NDArray[np.int64], step: float) -> NDArray[np.int32]:
    """(m,) how many planes move a pixel by 2 pixels, at most half of them; in the middle between a reference's others."""
    # The plane at infinity maps a pixel with homogeneous weight 1 for cameras that look the same way; the shift is about b.
    shift = np.hypot(maps[..., 9], maps[..., 10]) * step
    shift = np.where(others >= 0, shift, np.nan)
    middle = np.array(
        [np.nanmedian(row) if (views >= 0).any() else 1.0 for row, views in zip(shift, others, strict=True)]
    )
    return np.clip(np.ceil(RIVAL / np.maximum(middle, 1e-12)), 2, PLANES // 2).astype(np.int32)


def _agreeing(
    cameras: Sequence[Camera], chosen: NDArray[np.int64], k: int, depths: list[Float], sure: list[NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    """Which pixels of reference k are sure, and where a sure pixel of another reference has their inverse depth to 4.5 %."""
    here = cameras[chosen[k]]
    centres = np.stack([cameras[j].position for j in chosen])
    order = [int(j) for j in np.argsort(np.linalg.norm(centres - here.position, axis=1), kind="stable")]
    facing = [j for j in order if j != k and cameras[chosen[j]].forward @ here.forward > _WIDEST][:_MAPS]
    rows, columns = np.nonzero(sure[k])
    pixel = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))])
    agreed = np.zeros(len(rows), dtype=bool)
    for j in facing:
        m = _map(here, cameras[chosen[j]])
        x, y, z = m[:9].reshape(3, 3) @ pixel + m[9:, None] * depths[k][rows, columns].astype(np.float64)
        height, width = depths[j].shape
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v, there = x / z, y / z, depths[k][rows, columns] / z
            seen = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        u, v = (np.where(seen, a, 0).astype(np.int64) for a in (u, v))
        found = depths[j][v, u]
        agreed |= seen & sure[j][v, u] & (np.abs(found - there) <= AGREEMENT * there)
    out = np.zeros(sure[k].shape, dtype=bool)
    out[rows[agreed], columns[agreed]] = True
    return out


def _points_of(view: SweepView, found: DepthMap, share: float, rng: np.random.Generator) -> PointCloud:
    """A random share of the map's confident pixels as points, and 15 % more in the rest of the picture."""
    confident = np.flatnonzero(found.confident)
    if not len(confident):
        return PointCloud.empty()
    taken = np.sort(rng.permutation(confident)[: int(np.ceil(share * len(confident)))])
    rest = np.flatnonzero(~found.confident & (view.image[..., 3] > 127))
    filled = np.sort(rng.permutation(rest)[: int(round(FILL * len(taken)))])
    source = np.concatenate([taken, _nearest_pixels(confident, filled, found.score.shape)])
    pixels = np.concatenate([taken, filled])
    rows, columns = np.unravel_index(pixels, found.score.shape)
    camera = view.camera
    origin, directions = camera.rays_at(np.stack([columns + 0.5, rows + 0.5], axis=1))
    depth = 1 / found.inverse_depth.ravel()[source].astype(np.float64)
    positions = origin + directions * (depth / (directions @ camera.forward))[:, None]
    return PointCloud(positions, np.divide(view.image[rows, columns, :3], 255, dtype=np.float32))


def _nearest_pixels(known: NDArray[np.int64], asked: NDArray[np.int64], shape: tuple[int, int]) -> NDArray[np.int64]:
    """For each asked flat pixel number the known one that is nearest to it."""

    def places(flat: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.stack([*np.unravel_index(flat, shape), np.zeros(len(flat))], axis=1).astype(np.float64)

    return known[nearest(places(known), 1, places(asked))[1][:, 0]]
