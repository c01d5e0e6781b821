"""Points composited surface by surface, in numpy and float64: what the kernels compute (csrc/point_render.h).

Splats of points are footprints w = o rho exp(-d^T S^-1 d / 2) as in splat_reference. Per pixel [Zwicker et al. 2001]:

- the distance of a disc is that of its plane at the pixel, 1/z being affine in pixels, but no more than 3 s from its
  mean's, where the disc ends; a ball's is its mean's;
- contributions no farther than 3 s behind the nearest one, s the point's deviation in space with the pixel's low pass, are
  one surface: its colour is sum w c / sum w, its opacity min(1, sum w);
- the next surface begins with the nearest of the rest, and gets the transmittance that is left.

So a closed surface is neither thinned nor mixed with what is behind it, however many points a pixel holds.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from nerfvol.kernels.splat_reference import LOW_PASS, Footprints, Parameters, project
from nerfvol.kernels.splat_state import SplatView
from nerfvol.rotations import rotations
from nerfvol.splats.splats import Splats

TILE = 16
REACH = 3.0
"""Standard deviations of a footprint that are drawn."""
DEPTH = 3.0
"""Deviations in space behind the nearest contribution that are one surface."""
DISC = 0.05
"""A splat whose thinnest scale is a smaller share of its widest has a plane."""
MOST_SURFACES = 64
Floats = NDArray[np.floating]


@dataclass(frozen=True)
class _Points:
    """Of the m points in view: centre (m, 2), conic (m, 3), half-extents (m, 2) in pixels; weight, depth, slab (m,); colour,
    normal (m, 3); plane (m, 3): 1/z at a pixel (x, y) is plane . (x, y, 1), zero for balls."""

    centre: Floats
    conic: Floats
    half: Floats
    weight: Floats
    depth: Floats
    slab: Floats
    colour: Floats
    normal: Floats
    plane: Floats


def render_surfaces(
    splats: Splats, view: SplatView, background: Sequence[float], early_stop_eps: float = 1e-4
) -> dict[str, NDArray[np.float32]]:
    """All outputs of splat_ops.render_splats, float32 (height, width[, 3]), of splats that are points of surfaces."""
    points = _points(splats, view)
    shapes = {"rgb": (3,), "opacity": (), "depth": (), "median_depth": (), "normal": (3,)}
    out = {name: np.zeros((view.height, view.width, *shape), np.float32) for name, shape in shapes.items()}
    out["rgb"][:] = background
    low, high = points.centre - points.half, points.centre + points.half
    for top in range(0, view.height, TILE):
        rows = np.flatnonzero((high[:, 1] >= top) & (low[:, 1] <= top + TILE))
        for left in range(0, view.width, TILE):
            near = rows[(high[rows, 0] >= left) & (low[rows, 0] <= left + TILE)]
            if not len(near):
                continue
            height, width = min(TILE, view.height - top), min(TILE, view.width - left)
            y, x = np.meshgrid(np.arange(height) + top + 0.5, np.arange(width) + left + 0.5, indexing="ij")
            drawn = _pixels(points, near, x.ravel(), y.ravel(), view, early_stop_eps)
            passed = 1 - drawn["opacity"]
            drawn["rgb"] += passed[:, None] * np.asarray(background, np.float64)
            for name, values in drawn.items():
                place = out[name][top : top + height, left : left + width]
                place[...] = values.reshape(place.shape)
    return out


def _points(splats: Splats, view: SplatView) -> _Points:
    with torch.no_grad():
        f: Footprints = project(Parameters.of(splats), view, "mip")
    chosen = f.order.numpy()
    centre, covariance, weight, colour, z, normal = (
        t.numpy()[chosen] for t in (f.centre, f.covariance, f.opacity, f.colour, f.depth, f.normal)
    )
    inverse = np.linalg.inv(covariance)
    scales = np.exp(splats.log_scales[chosen].astype(np.float64))
    widest = scales.max(axis=1)
    slab = DEPTH * np.sqrt(widest**2 + LOW_PASS * (z / math.sqrt(view.fx * view.fy)) ** 2)
    return _Points(
        centre, np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1),
        REACH * np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), weight, z, slab, colour, normal,
        _planes(splats.select(chosen), scales, view),
    )  # fmt: skip


def _planes(splats: Splats, scales: Floats, view: SplatView) -> Floats:
    """1/z of a plane n . t = h at slopes (u, v) is n . (u, v, 1) / h; as a function of pixels."""
    disc = scales.min(axis=1) < DISC * scales.max(axis=1)
    thin = scales.argmin(axis=1)
    n = rotations(splats.quats)[np.arange(splats.n), :, thin] @ view.rotation.T
    t = splats.means.astype(np.float64) @ view.rotation.T + view.translation
    h = (n * t).sum(axis=1)
    usable = disc & (np.abs(h) > 1e-6 * np.linalg.norm(t, axis=1))  # else it is seen edge on
    n = n / np.where(usable, h, 1.0)[:, None]
    plane = np.stack(
        [n[:, 0] / view.fx, n[:, 1] / view.fy, n[:, 2] - n[:, 0] * view.cx / view.fx - n[:, 1] * view.cy / view.fy], 1
    )
    return np.where(usable[:, None], plane, 0.0)


def _pixels(p: _Points, near: NDArray, x: Floats, y: Floats, view: SplatView, eps: float) -> dict[str, Floats]:
    """The outputs at pixels (k,), over black."""
    dx, dy = (a[:, None] - p.centre[near, i] for i, a in enumerate((x, y)))
    a, b, c = p.conic[near].T
    square = a * dx * dx + 2 * b * dx * dy + c * dy * dy
    w = np.where(square <= REACH**2, p.weight[near] * np.exp(-0.5 * square), 0.0)
    inverse = p.plane[near, 0] * x[:, None] + p.plane[near, 1] * y[:, None] + p.plane[near, 2]
    z = p.depth[near]
    slab = p.slab[near]
    # A plane seen edge on may be anywhere within a pixel; the disc ends a slab from its mean.
    depth = np.where(p.plane[near].any(axis=1), np.clip(1 / np.maximum(inverse, 1e-30), z - slab, z + slab), z)
    rest = w > 0
    passed = np.ones(len(x))
    out = {name: np.zeros((len(x), k)) for name, k in (("rgb", 3), ("normal", 3), ("depth", 1), ("median_depth", 1))}
    for _ in range(MOST_SURFACES):
        rest &= (passed >= max(eps, 1e-9))[:, None]
        seen = rest.any(axis=1)
        if not seen.any():
            break
        apart = np.where(rest, depth, np.inf)
        first = apart.argmin(axis=1)
        limit = apart[np.arange(len(x)), first] + slab[first]
        one = rest & (depth <= np.where(seen, limit, -np.inf)[:, None])
        share = np.where(one, w, 0.0)
        total = share.sum(axis=1)
        cover = np.minimum(total, 1.0)
        weight = share * (passed * cover / np.where(total > 0, total, 1.0))[:, None]
        distance = (share * depth).sum(axis=1) / np.where(total > 0, total, 1.0)
        out["rgb"] += weight @ p.colour[near]
        out["normal"] += weight @ p.normal[near]
        out["depth"][:, 0] += passed * cover * distance
        after = passed * (1 - cover)
        out["median_depth"][:, 0] += np.where((passed > 0.5) & (after <= 0.5), distance, 0.0)
        passed, rest = after, rest & ~one
    ray = np.sqrt(1 + ((x - view.cx) / view.fx) ** 2 + ((y - view.cy) / view.fy) ** 2)[:, None]
    out["depth"], out["median_depth"] = out["depth"] * ray, out["median_depth"] * ray
    return {"opacity": 1 - passed, **{name: a if a.shape[1] == 3 else a[:, 0] for name, a in out.items()}}
