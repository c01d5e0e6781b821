"""How far the kernels may be from the float64 reference: a running error analysis in first order.

u = 2**-24 is the unit roundoff of float32. The kernels work in the unit cube, o' = (o - origin) / size:

- o' is off by 3 u |o'| (a difference, a quotient, the size as float32) and by the rounding of the octree's origin; it
  is exact where the size is a power of two and the result a float32 number;
- a slab distance t = (lo - o') (1/d) is off by (error of o') / |d| + 4 u |t|; if d = 0 or 1 and all is exact, nothing;
- a segment's ends are the largest and smallest of three such distances, off by no more than the largest error among
  the slabs that may be the binding one; its length and its middle follow;
- the place in the leaf is off by (error of the middle) |d| / side plus rounding; raw density and colour by the spread
  of the leaf's corners times that, plus 24 u of the largest corner (3 for weights, 8 + 8 for products and sums, slack);
- an optical depth tau is off by its slopes in raw density and length plus 8 u tau (exp16 is good to 2 ulp);
- transmittance is a product: after i segments it is off by the sum of the errors of tau, plus 6 u a segment, relative.

A leaf whose segment is no longer than its error may be hit by one side and missed by the other: a "ghost". All leaves
are tried against all rays for them. The gradient's bound scatters these errors to the vertices, without cancellation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from nerfvol.kernels import reference
from nerfvol.octree.rows import DENSITY_SLOT, explin, sh_slots
from nerfvol.octree.topology import OFFSETS
from nerfvol.octree.tree import Octree
from nerfvol.sh import eval_basis

U = 2.0**-24


def slope(raw: np.ndarray) -> np.ndarray:
    return np.where(raw < 1, np.exp(np.minimum(raw, 1) - 1), 1.0)


@dataclass
class Trace:
    """The float64 reference's segments with the error of each quantity (names in ``d_``), all in scene units.

    place, d_place (n, 3); corner_weights (n, 8); tau, tau_slope (d tau / d raw); colour (n, 3); basis (n_rays, row) in
    the places of a vertex row; behind: sum of the errors of tau of the whole ray (n_rays,); hits (n_rays,).
    """

    ray: np.ndarray
    leaf: np.ndarray
    near: np.ndarray
    far: np.ndarray
    middle: np.ndarray
    weight: np.ndarray
    before: np.ndarray
    after: np.ndarray
    tau: np.ndarray
    tau_slope: np.ndarray
    raw: np.ndarray
    colour: np.ndarray
    corner_weights: np.ndarray
    basis: np.ndarray
    hits: np.ndarray
    d_near: np.ndarray
    d_length: np.ndarray
    d_middle: np.ndarray
    d_place: np.ndarray
    d_raw: np.ndarray
    d_colour: np.ndarray
    d_tau: np.ndarray
    d_tau_slope: np.ndarray
    d_before: np.ndarray
    d_total: np.ndarray
    ghost: np.ndarray
    ghost_ray: np.ndarray
    ghost_leaf: np.ndarray
    ghost_tau: np.ndarray
    ghost_length: np.ndarray


def _slabs(octree: Octree, o: np.ndarray, d: np.ndarray, leaf: np.ndarray):
    """Ends of the segments in the unit cube and their errors."""
    exact_frame = np.log2(octree.size) % 1 == 0
    unit_o = (o - octree.origin) / octree.size
    exact = exact_frame & (unit_o.astype(np.float32) == unit_o)
    cast = np.abs(octree.origin.astype(np.float32) - octree.origin) / octree.size
    d_o = np.where(exact, 0.0, 3 * U * np.abs(unit_o) + cast)
    relative = np.where(exact & np.isin(np.abs(d), (0.0, 1.0)), 0.0, 4 * U)
    side = 1 / 2.0 ** octree.leaf_level[leaf, None]
    inverse = np.where(np.abs(d) < 1e-20, 1e20, 1 / np.where(d == 0, 1, d))
    a = (octree.leaf_ijk[leaf] * side - unit_o) * inverse
    b = ((octree.leaf_ijk[leaf] + 1) * side - unit_o) * inverse
    lower, upper = np.minimum(a, b), np.maximum(a, b)
    d_lower, d_upper = (d_o * np.abs(inverse) + relative * np.abs(t) for t in (lower, upper))
    near, far = np.maximum(lower.max(1), 0), upper.min(1)
    may_bind = lower + d_lower >= (lower - d_lower).max(1, keepdims=True)
    d_near = np.where(may_bind & (lower + d_lower >= 0), d_lower, 0).max(1)
    may_bind = upper - d_upper <= (upper + d_upper).min(1, keepdims=True)
    d_far = np.where(may_bind, d_upper, 0).max(1)
    return near, far, d_near, d_far, d_o, unit_o, side


def _ghosts(octree: Octree, o: np.ndarray, d: np.ndarray):
    """Pairs of rays and leaves whose meeting is a matter of rounding, the largest optical depth and length it could have."""
    ray, leaf = np.repeat(np.arange(len(o)), octree.n_leaves), np.tile(np.arange(octree.n_leaves), len(o))
    near, far, d_near, d_far, *_ = _slabs(octree, o[ray], d[ray], leaf)
    error = d_near + d_far
    unsure = (np.abs(far - near) <= error) & (error > 0)
    densest = explin(octree.density.astype(np.float64))[octree.corners].max(1) * octree.density_scale
    length = 2 * error[unsure] * octree.size
    return ray[unsure], leaf[unsure], length * densest[leaf[unsure]], length


def trace(octree: Octree, rays_o: np.ndarray, rays_d: np.ndarray, early_stop_eps: float = 0.0) -> Trace:
    """One origin and one direction a ray, as float32 numbers."""
    o, d = rays_o.astype(np.float64), rays_d.astype(np.float64)
    values = torch.from_numpy(octree.values).double()
    s = reference.sample(octree, values, torch.from_numpy(o), torch.from_numpy(d), early_stop_eps)
    ray, leaf = s.segments.ray.numpy(), s.segments.leaf.numpy()
    n_rays, size = len(o), octree.size
    near, far, d_near, d_far, d_o, unit_o, side = _slabs(octree, o[ray], d[ray], leaf)
    middle, d_middle = (near + far) / 2, (d_near + d_far) / 2 + 2 * U * (near + far)
    d_length = d_near + d_far + U * far

    travelled = middle[:, None] * d[ray] + unit_o - octree.leaf_ijk[leaf] * side
    place = np.clip(travelled / side, 0, 1)
    reach = np.abs(middle[:, None] * d[ray]) + np.abs(octree.leaf_ijk[leaf] * side - unit_o)
    d_place = np.minimum((d_middle[:, None] * np.abs(d[ray]) + d_o + 4 * U * reach) / side, 1)
    shift = d_place.sum(1)

    rows = octree.values.astype(np.float64)[octree.corners[leaf]]
    largest, spread = np.abs(rows).max(1), rows.max(1) - rows.min(1)
    d_rows = spread * shift[:, None] + 24 * U * largest
    raw, d_raw = s.raw.numpy(), d_rows[:, DENSITY_SLOT]
    basis = np.zeros((n_rays, rows.shape[2]))
    slots = sh_slots(octree.sh_degree)
    basis[:, slots] = eval_basis(octree.sh_degree, torch.from_numpy(d)).numpy()[:, None]
    terms = d_rows[:, slots] * np.abs(basis[ray][:, slots]) + 16 * U * 3 * largest[:, slots]
    colour, d_colour = s.rgb.numpy(), terms.sum(-1) + U

    length = (far - near) * size
    tau = octree.density_scale * explin(raw) * length
    tau_slope = octree.density_scale * slope(raw) * length
    relative = np.where(length > 0, d_length * size / np.maximum(length, 1e-300), 0)
    d_tau = 1.01 * tau_slope * d_raw + tau * (relative + 8 * U)
    d_tau_slope = 1.01 * tau_slope * (np.where(raw - d_raw < 1, d_raw, 0) + relative + 8 * U)

    # Exclusive and inclusive sums along each ray.
    first = np.searchsorted(ray, np.arange(n_rays))
    hits = np.bincount(ray, minlength=n_rays)

    def running(x):
        total = np.concatenate([[0.0], np.cumsum(x)])
        return total[:-1] - total[first[ray]], np.bincount(ray, x, n_rays)

    depth, _ = running(tau)
    behind, total = running(d_tau + 6 * U)
    before = np.exp(-depth)
    d_before = before * np.minimum(behind, 1)
    ghost_ray, ghost_leaf, ghost_tau, ghost_length = _ghosts(octree, o, d)
    ghost = np.bincount(ghost_ray, ghost_tau, n_rays)
    return Trace(
        ray, leaf, near * size, far * size, middle * size, s.weights.numpy(), before, before * np.exp(-tau), tau,
        tau_slope, raw, colour, np.where(OFFSETS == 1, place[:, None], 1 - place[:, None]).prod(-1), basis, hits,
        d_near * size, d_length * size, d_middle * size, d_place, d_raw, d_colour, d_tau, d_tau_slope, d_before,
        np.minimum(total + ghost, 1), ghost, ghost_ray, ghost_leaf, ghost_tau, ghost_length,
    )  # fmt: skip


def per_ray(t: Trace, x: np.ndarray) -> np.ndarray:
    """Sums of (n_segments, ...) over each ray."""
    out = np.zeros((len(t.hits), *x.shape[1:]))
    np.add.at(out, t.ray, x)
    return out


def weight_bounds(t: Trace) -> np.ndarray:
    """Largest allowed differences of the segments' weights: (n_segments,)."""
    alpha = -np.expm1(-t.tau)
    return t.d_before * alpha + t.before * (np.exp(-t.tau) * np.minimum(t.d_tau, 1) + 6 * U * alpha)


def image_bounds(t: Trace, octree: Octree, background) -> dict[str, np.ndarray]:
    """Largest allowed differences of rgb (n, 3), trans, depth (n,) and normal (n, 3)."""
    d_weight = weight_bounds(t)
    sums = 2 * U * (t.hits + 2)
    final = np.exp(-per_ray(t, t.tau))
    d_trans = final * (np.expm1(t.d_total) + sums) + t.ghost + 2 * U
    top = np.abs(t.colour).max(initial=1) + np.abs(np.asarray(background)).max()
    rgb = per_ray(t, d_weight[:, None] * np.abs(t.colour) + t.weight[:, None] * t.d_colour)
    rgb += (sums[:, None] * per_ray(t, t.weight[:, None] * np.abs(t.colour))) + (t.ghost * top)[:, None]
    rgb += d_trans[:, None] * np.abs(np.asarray(background)) + 2 * U * top
    depth = per_ray(t, d_weight * t.middle + t.weight * t.d_middle) + sums * per_ray(t, t.weight * t.middle)
    depth += t.ghost * (np.abs(t.far).max(initial=0) + octree.size)
    # A unit normal g / |g| turns by at most 2 (error of g) / |g|; g is bilinear in the corners' differences.
    raw = octree.values[octree.corners[t.leaf], DENSITY_SLOT].astype(np.float64)
    g = corner_gradient(t, raw)
    norm = np.linalg.norm(g, axis=1)
    d_g = 4 * (raw.max(1) - raw.min(1)) * t.d_place.sum(1) + 24 * U * np.abs(raw).max(1)
    turn = np.minimum(2 * d_g / np.maximum(norm, 1e-300), 2) + 4 * U
    normal = per_ray(t, d_weight + t.weight * turn) + sums + t.ghost
    return {"rgb": rgb, "trans": d_trans, "depth": depth, "normal": np.repeat(normal[:, None], 3, 1)}


def corner_gradient(t: Trace, raw: np.ndarray) -> np.ndarray:
    """d(raw)/d(place) of each segment from the corners' raw densities (n, 8): (n, 3)."""
    place = np.stack([t.corner_weights[:, OFFSETS[:, k] == 1].sum(1) for k in range(3)], 1)
    out = np.zeros((len(place), 3))
    for o in range(8):
        w = np.where(OFFSETS[o] == 1, place, 1 - place)
        sign = np.where(OFFSETS[o] == 1, 1.0, -1.0)
        for k in range(3):
            out[:, k] += sign[k] * raw[:, o] * np.delete(w, k, 1).prod(1)
    return out


def undecided(t: Trace, threshold: float) -> np.ndarray:
    """Rays whose transmittance passes so near to the threshold that rounding decides on which side: (n_rays,) bool."""
    margin = 2 * np.expm1(np.minimum(t.d_total[t.ray], 1)) * t.after + 4 * U
    near = (threshold > 0) & (np.abs(t.after - threshold) <= margin)
    return np.bincount(t.ray, near, len(t.hits)) > 0


def median_bound(t: Trace, median: np.ndarray) -> np.ndarray:
    """The crossing of T = 1/2 inside segment i lies at near + (log 2 - tau in front) / sigma: (n_rays,)."""
    out = np.full(len(median), 4 * U)
    crossing = (t.before > 0.5) & (t.after <= 0.5)
    length = np.maximum(t.far - t.near, 1e-300)
    missing = t.d_total[t.ray] + np.minimum(t.d_tau, 1) + 16 * U
    error = t.d_near + t.d_length + t.d_middle + missing * length / np.maximum(t.tau, 1e-300)
    out[t.ray[crossing]] += error[crossing]
    return out


def output_gradient_bounds(t: Trace, octree: Octree, background, g_rgb, g_trans, g_depth) -> np.ndarray:
    """:func:`gradient_bounds` for cotangents (n, 3), (n,), (n,) of colour, transmittance and expected distance."""
    g = np.abs(g_rgb)[t.ray]
    share = (g * np.abs(t.colour)).sum(1) + np.abs(g_depth)[t.ray] * t.middle
    d_share = (g * t.d_colour).sum(1) + np.abs(g_depth)[t.ray] * t.d_middle
    q = np.abs(g_rgb @ np.asarray(background)) + np.abs(g_trans)
    d_q = 8 * U * q
    np.maximum.at(q, t.ray, share)
    np.maximum.at(d_q, t.ray, d_share)
    return gradient_bounds(t, octree, g, q, 4 * U * g, d_q)


def roughness_bounds(t: Trace, octree: Octree, weight: np.ndarray, density: float, colour: float) -> np.ndarray:
    """What the gradient of the roughness adds to :func:`gradient_bounds`: (n_vertices, row). weight: of the rays (n,).

    A corner has three edges; the slope d / (e + |d|) of each is below 1 and off by 5 u (a difference, a sum, a quotient, a
    product), the way through the leaf by its own error and a ghost's whole length; and the rows are summed in any order.
    """
    side = octree.leaf_sizes()
    row = np.full(octree.values.shape[1], colour)
    row[DENSITY_SLOT] = density
    terms = np.zeros(octree.n_vertices)
    np.add.at(terms, octree.corners[t.leaf].ravel(), 1)
    out = np.zeros(octree.values.shape)
    for o in range(8):
        vertex = octree.corners[t.leaf, o]
        order = U * (np.minimum(terms[vertex], 4096) + t.hits[t.ray] + 24)
        off = (t.d_length + (t.far - t.near) * order) / side[t.leaf]
        np.add.at(out, vertex, 3 * (weight[t.ray] * off)[:, None] * row)
    ghosts = 3 * weight[t.ghost_ray] * t.ghost_length / side[t.ghost_leaf]
    np.add.at(out, octree.corners[t.ghost_leaf], (ghosts[:, None] * row)[:, None])
    return out


def gradient_bounds(
    t: Trace, octree: Octree, g_rgb: np.ndarray, q: np.ndarray, d_g_rgb: np.ndarray, d_q: np.ndarray
) -> np.ndarray:
    """Largest allowed differences of the gradient (n_vertices, row).

    g_rgb, d_g_rgb (n_segments, 3): |dL/dc| / weight and its error; q (n_rays,): the largest |dL/dw| along the ray,
    background included, and its error d_q.
    """
    rounding = (t.d_total + 8 * U * (t.hits + 4) + t.ghost)[t.ray]
    front = t.before * np.exp(t.d_total[t.ray])
    m_raw = 2 * q[t.ray] * front * t.tau_slope
    e_raw = t.tau_slope * front * (4 * q[t.ray] * rounding + 2 * d_q[t.ray]) + 2 * q[t.ray] * front * t.d_tau_slope
    d_weight = t.weight * rounding + t.before * np.minimum(t.d_tau, 1)
    m_rgb = t.weight[:, None] * g_rgb
    e_rgb = d_weight[:, None] * g_rgb + t.weight[:, None] * d_g_rgb
    row = octree.values.shape[1]
    slots = sh_slots(octree.sh_degree)
    magnitude, error = np.zeros((len(t.ray), row)), np.zeros((len(t.ray), row))
    magnitude[:, DENSITY_SLOT], error[:, DENSITY_SLOT] = m_raw, e_raw
    for c in range(3):
        y = t.basis[t.ray][:, slots[c]]
        magnitude[:, slots[c]] = m_rgb[:, c : c + 1] * np.abs(y)
        error[:, slots[c]] = e_rgb[:, c : c + 1] * np.abs(y) + m_rgb[:, c : c + 1] * 48 * U
    out = np.zeros(octree.values.shape)
    g_norm = np.zeros(len(t.hits))
    np.maximum.at(g_norm, t.ray, g_rgb.max(1, initial=0))
    shift = t.d_place.sum(1)
    terms = np.zeros(octree.n_vertices)
    np.add.at(terms, octree.corners[t.leaf].ravel(), 1)
    for o in range(8):
        vertex = octree.corners[t.leaf, o]
        w = t.corner_weights[:, o]
        order = U * np.minimum(terms[vertex], 4096)
        np.add.at(out, vertex, (w + shift)[:, None] * error + magnitude * (shift + 8 * U + w * order)[:, None])
    ghosts = 3 * t.ghost_tau * (q + g_norm)[t.ghost_ray]  # |Y| < 3
    np.add.at(out, octree.corners[t.ghost_leaf], ghosts[:, None, None])
    return out
