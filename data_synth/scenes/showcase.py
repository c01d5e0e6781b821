"""The showcase: glossy solids on a checker base, wrapped in a ring of glowing haze, on a transparent background.

The truth is the emission-absorption integral (PHYSICS 1) in float64,
    C = sum_i T_i alpha_i c_i + T(hit) c_surface,   alpha = 1 - T(end),
with an exact surface hit and midpoint quadrature of the haze up to it. Surfaces show a sun with soft shadows, ambient
light with occlusion, a Blinn-Phong highlight and a Fresnel reflection of the sky: the last two depend on the view.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_synth import checks
from data_synth.cameras import Camera, Viewpoints, pixel_ray
from data_synth.files import replacing
from data_synth.image import Picture
from data_synth.jit import in_bands, jit, kernel
from data_synth.scenes import showcase_sdf as sdf
from data_synth.scenes.showcase_sdf import FLOOR
from data_synth.vec import slab

SUN = (0.48507125, -0.36380344, 0.79592021)  # unit, towards the sun
FAR = 1e9


class Haze(NamedTuple):
    """The hazy ring. sigma: 1/u at its core. steps: quadrature segments across the ring's bounding box."""

    sigma: float
    radius: float
    width: float
    height: float
    steps: int


@jit
def sky(dz):
    """Linear sky colour by elevation, dz = sine; dim below the horizon."""
    t = 0.5 + 0.5 * dz
    low = min(max(3.0 * dz + 1.0, 0.0), 1.0)
    low = 0.25 + 0.75 * low * low * (3.0 - 2.0 * low)
    return low * (0.55 + 0.05 * t), low * (0.52 + 0.28 * t), low * (0.50 + 0.70 * t)


@jit
def sphere_trace(ox, oy, oz, dx, dy, dz):
    """(t, object) of the first surface, t = FAR if there is none; |distance| at t is below 1e-8."""
    lo, hi = (-1.31, -1.31, FLOOR - 0.11), (1.31, 1.31, FLOOR + 0.9)
    t, t1 = slab(((ox, oy, oz), (dx, dy, dz)), lo, hi, 0.0, math.inf)
    for _ in range(256):
        if t >= t1:
            break
        d, which = sdf.nearest(ox + t * dx, oy + t * dy, oz + t * dz)
        if d < 1e-8:
            return t, which
        t += d
    return FAR, -1


@jit
def sunlight(x, y, z):
    """Fraction of the sun seen from a point, in [0, 1]: the narrowest relative clearance on the way (soft shadow)."""
    t, clear = 0.02, 1.0
    for _ in range(48):
        pz = z + t * SUN[2]
        if t > 2.2 or pz > FLOOR + 0.9:
            break
        d = sdf.distance(x + t * SUN[0], y + t * SUN[1], pz)
        clear = min(clear, 11.0 * d / t)
        if clear < 0.002:
            return 0.0
        t += max(d, 0.008)
    return clear * clear * (3.0 - 2.0 * clear)


@jit
def openness(x, y, z, nx, ny, nz):
    """Ambient occlusion: how far the distance along the normal falls behind the step, in (0, 1]."""
    lost, weight = 0.0, 1.0
    for k in range(1, 5):
        step = 0.055 * k
        lost += weight * max(step - sdf.distance(x + nx * step, y + ny * step, z + nz * step), 0.0)
        weight *= 0.75
    return math.exp(-2.6 * lost)


@jit
def surface_radiance(which, x, y, z, dx, dy, dz):
    """Linear radiance r, g, b that leaves a surface point against the unit ray direction d."""
    r, g, b, gloss, exponent = sdf.material(which, x, y, z)
    nx, ny, nz = sdf.normal(x, y, z)
    lift = 1e-3
    px, py, pz = x + lift * nx, y + lift * ny, z + lift * nz
    n_sun = nx * SUN[0] + ny * SUN[1] + nz * SUN[2]
    sun = sunlight(px, py, pz) * n_sun if n_sun > 0.0 else 0.0
    ambient = openness(px, py, pz, nx, ny, nz)
    sr, sg, sb = sky(max(nz, 0.0))
    up = 0.55 + 0.45 * nz  # a horizontal plane sees the whole sky, a ceiling the dim floor
    shade = 0.6 * ambient * up
    lr, lg, lb = 1.25 * sun + shade * sr, 1.15 * sun + shade * sg, 0.98 * sun + shade * sb
    cosine = max(-(dx * nx + dy * ny + dz * nz), 0.0)
    hx, hy, hz = SUN[0] - dx, SUN[1] - dy, SUN[2] - dz
    n_half = (nx * hx + ny * hy + nz * hz) / math.sqrt(hx * hx + hy * hy + hz * hz)
    spark = gloss * 0.9 * max(n_half, 0.0) ** exponent * min(4.0 * sun, 1.0)
    fresnel = gloss * (0.06 + 0.5 * (1.0 - cosine) ** 4) * ambient
    sr, sg, sb = sky(dz + 2.0 * cosine * nz)
    return r * lr + fresnel * sr + spark, g * lg + fresnel * sg + spark, b * lb + fresnel * sb + 0.9 * spark


@jit
def haze_density(haze, x, y, z):
    """Extinction of the ring, 1/u: a Gaussian tube around the column, rippled along its length, zero at 3 widths."""
    r2 = x * x + y * y
    rho = math.sqrt(r2) - haze.radius
    h = z - haze.height - 0.20 * x * y / (r2 + 1e-9)  # a ring that waves twice per turn: sin(2 azimuth)
    q = (rho * rho + h * h) / (haze.width * haze.width)
    if q > 9.0:
        return 0.0
    ripple = 1.0 + 0.6 * math.sin(9.0 * x + 3.0 * z) * math.sin(8.0 * y - 4.0 * z)
    return haze.sigma * ripple * (math.exp(-q) - math.exp(-9.0))


@jit
def haze_colour(x, y, z):
    """Linear colour of the ring around the wheel, from rose over violet to cyan."""
    t = 0.5 + 0.5 * (0.825 * y + 0.565 * x) / (math.sqrt(x * x + y * y) + 1e-9)  # sin(azimuth + 0.6)
    return 0.95 * t + 0.12 * (1.0 - t), 0.30 * t + 0.75 * (1.0 - t), 0.62 * t + 0.95 * (1.0 - t)


@jit
def radiance(haze, ox, oy, oz, dx, dy, dz):
    """The emission-absorption integral along one ray: premultiplied r, g, b, then alpha and sum_i w_i t_i."""
    t_hit, which = sphere_trace(ox, oy, oz, dx, dy, dz)
    reach, half = haze.radius + 3.0 * haze.width, 3.0 * haze.width + 0.10
    lo, hi = (-reach, -reach, haze.height - half), (reach, reach, haze.height + half)
    t0, t1 = slab(((ox, oy, oz), (dx, dy, dz)), lo, hi, 0.0, math.inf)
    t1 = min(t1, t_hit)
    r, g, b, far, trans = 0.0, 0.0, 0.0, 0.0, 1.0
    if t1 > t0:
        delta = (t1 - t0) / math.ceil((t1 - t0) / (2.0 * reach) * haze.steps)
        t = t0 + 0.5 * delta
        while t < t1:
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            sigma = haze_density(haze, x, y, z)
            if sigma > 0.0:
                weight = -trans * math.expm1(-sigma * delta)  # T_i alpha_i with T_i *before* the segment
                cr, cg, cb = haze_colour(x, y, z)
                r, g, b, far = r + weight * cr, g + weight * cg, b + weight * cb, far + weight * t
                trans -= weight
            t += delta
    if which >= 0:
        cr, cg, cb = surface_radiance(which, ox + t_hit * dx, oy + t_hit * dy, oz + t_hit * dz, dx, dy, dz)
        r, g, b, far = r + trans * cr, g + trans * cg, b + trans * cb, far + trans * t_hit
        trans = 0.0
    return r, g, b, 1.0 - trans, far


@kernel
def sample_haze(haze, x, y, z, out):
    for i in range(x.size):
        for j in range(y.size):
            for k in range(z.size):
                out[i, j, k] = haze_density(haze, x[i], y[j], z[k])


@kernel
def render_rows(haze, camera, out, first, last):
    """Rows first..last of out (H, W, 5), one ray through each pixel's centre."""
    ox, oy, oz = camera.c2w[0, 3], camera.c2w[1, 3], camera.c2w[2, 3]
    for j in range(first, last):
        for i in range(out.shape[1]):
            dx, dy, dz = pixel_ray(camera, i + 0.5, j + 0.5)
            r, g, b, a, f = radiance(haze, ox, oy, oz, dx, dy, dz)
            out[j, i, 0], out[j, i, 1], out[j, i, 2], out[j, i, 3], out[j, i, 4] = r, g, b, a, f


@kernel
def refine_pixels(haze, camera, out, pixels, n, first, last):
    """Replace the pixels (row, column) first..last of the list by the mean of n x n rays on a regular grid."""
    ox, oy, oz = camera.c2w[0, 3], camera.c2w[1, 3], camera.c2w[2, 3]
    for k in range(first, last):
        j, i = pixels[k]
        r, g, b, a, f = 0.0, 0.0, 0.0, 0.0, 0.0
        for s in range(n * n):
            dx, dy, dz = pixel_ray(camera, i + (s % n + 0.5) / n, j + (s // n + 0.5) / n)
            cr, cg, cb, ca, cf = radiance(haze, ox, oy, oz, dx, dy, dz)
            r, g, b, a, f = r + cr, g + cg, b + cb, a + ca, f + cf
        s = 1.0 / (n * n)
        out[j, i, 0], out[j, i, 1], out[j, i, 2], out[j, i, 3], out[j, i, 4] = r * s, g * s, b * s, a * s, f * s


def edge_pixels(values: np.ndarray, threshold: float) -> np.ndarray:
    """(n, 2) rows and columns of pixels that differ from a neighbour by more than ``threshold`` in any channel."""
    edge = np.zeros(values.shape[:2], dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(values, axis=axis)).max(axis=-1) > threshold
        low, high = [slice(None)] * 2, [slice(None)] * 2
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        edge[tuple(low)] |= step
        edge[tuple(high)] |= step
    return np.argwhere(edge)


class Showcase:
    """Solids, gloss and haze. haze: extinction at the core of the ring in 1/u; smooth: edge rays per pixel side."""

    name = "showcase"
    summary = "glossy solids on a checker base inside a ring of glowing haze (emission-absorption truth)"
    viewpoints = Viewpoints(target=(0.0, 0.0, -0.2), radius=4.0, elevation=(8.0, 75.0), fov=40.0)
    aabb = np.array([[-1.35, -1.35, -0.7], [1.35, 1.35, 0.7]])
    integrators: tuple[str, ...] = ("emission",)
    exposure = 1.0

    def __init__(self, haze: float = 4.5, steps: int = 96, smooth: int = 2) -> None:
        for key, value in {"haze": haze, "steps": steps, "smooth": smooth}.items():
            checks.parameter("showcase", key, value, 4.5 if key == "haze" else 1)
        self.haze = Haze(sigma=float(haze), radius=0.62, width=0.13, height=0.28, steps=int(steps))
        self.smooth = int(smooth)
        self.parameters: dict = {}

    def render(self, camera: Camera, *, seed: int = 0) -> Picture:
        """One ray per pixel centre; pixels at an edge are the mean of a regular grid of rays. No chance: no use for a seed."""
        out = np.empty((camera.height, camera.width, 5))
        data = camera.data()
        in_bands(lambda first, last: render_rows(self.haze, data, out, first, last), camera.height)
        if self.smooth > 1:
            pixels = edge_pixels(out[..., :4], 0.1)
            in_bands(
                lambda first, last: refine_pixels(self.haze, data, out, pixels, self.smooth, first, last),
                len(pixels),
                512,
            )
        return Picture(out[..., :3], out[..., 3], out[..., 4], samples=self.smooth**2)

    def write_truth(self, out_dir: Path) -> None:
        """truth.npz: the extinction of the haze in 1/u at the vertices of a grid from lo to hi, 65 along the longest side."""
        reach, half = self.haze.radius + 3.0 * self.haze.width, 3.0 * self.haze.width + 0.10
        lo = np.array([-reach, -reach, self.haze.height - half])
        hi = np.array([reach, reach, self.haze.height + half])
        shape = np.rint((hi - lo) / (2 * reach) * 64).astype(int) + 1
        axes = [np.linspace(a, b, n) for a, b, n in zip(lo, hi, shape, strict=True)]
        density = np.empty(shape, np.float32)
        sample_haze(self.haze, *axes, density)
        with replacing(out_dir / "truth.npz") as temporary:
            np.savez_compressed(temporary, density=density, lo=lo, hi=hi, allow_pickle=False)
