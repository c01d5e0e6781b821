"""The path tracer's core in C++: ``path.py`` for one medium in a box, without surfaces. It starts at once and is faster.

The extension holds other kernels too, but this is all of it that the ground truth uses, and it shares none of their code
but threads and vectors. ``path.py`` is the textbook it is tested against. Both draw other random numbers: pictures of one
seed differ by their noise.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from data_synth import lights, phase
from data_synth.media import BRICK, FUNCTION, GRID, Medium
from data_synth.parts import BLOCK
from data_synth.world import has_boundaries, has_surfaces

if TYPE_CHECKING:
    from data_synth.cameras import CameraData
    from data_synth.path import Settings
    from data_synth.world import World

PHASES = (phase.ISOTROPIC, phase.RAYLEIGH, phase.HG)
LIGHTS = (lights.POINT, lights.DIRECTIONAL, lights.SKY)
MOST_FORWARD = 0.99  # |g| above which single precision would lose the lobe
PATHS_AT_ONCE = 1 << 20  # of a call, so that Ctrl-C is heard


@functools.cache
def core() -> Callable[..., None] | None:
    """The extension's function, None where it was not built or ``NERFVOL_REFERENCE=1`` asks for the textbook version."""
    if os.environ.get("NERFVOL_REFERENCE"):
        return None
    try:
        import _nerfvol_kernels  # pyright: ignore[reportMissingImports]  # the extension, where it was built
    except ImportError:
        return None
    return getattr(_nerfvol_kernels, "trace_paths", None)


def unknown(w: World) -> str:
    """What of a scene the core does not know, '' if it knows all of it."""
    m = w.medium
    if has_surfaces(w):
        return "surfaces"
    if has_boundaries(w) or w.ambient != 0:
        return "boundaries"
    if m.kind == FUNCTION:
        return "a density function"
    if m.columns.width:
        return "grids of albedo, Le, g or S"
    if m.detail.octaves > 0:
        return "detail below the grid"
    if m.phase.kind not in PHASES:
        return "microflakes"
    if max(abs(m.phase.g1), abs(m.phase.g2)) > MOST_FORWARD:
        return f"a mean cosine beyond {MOST_FORWARD}"
    if not set(w.lights[:, 0]) <= set(LIGHTS):
        return "area lights"
    return ""


def trace(w: World, camera: CameraData, settings: Settings, size: tuple[int, int], top: int = 0) -> np.ndarray:
    """Sums (H, W, 8) as ``path.render_rows`` makes them, of the rows from ``top`` on of a picture, for a world of which
    ``unknown`` knows nothing. ``size``: (H, W), the rows and the picture's width. Uses all cores."""
    function = core()
    if function is None:
        raise RuntimeError("the extension was not built")
    arguments = _arrays(w.medium) | {
        "lights": np.ascontiguousarray(w.lights),
        "camera": np.array([*camera.c2w.ravel(), camera.fx, camera.fy, camera.cx, camera.cy]),
        "spp": settings.spp, "max_depth": settings.max_depth, "jitter": settings.jitter,
        "opaque_sky": settings.opaque_sky, "seed": settings.seed % 2**64, "blocks": (settings.first, settings.last),
    }  # fmt: skip
    out = np.empty((*size, 8))
    rows = max(PATHS_AT_ONCE // (size[1] * BLOCK * (settings.last - settings.first)), 8)
    for first in range(0, size[0], rows):
        function(**arguments, first=top + first, out=out[first : first + rows])
    return out


def _arrays(m: Medium) -> dict[str, Any]:
    edge = BRICK if m.kind == GRID else 1
    size = (
        [edge * c for c in m.cell]
        if m.kind == GRID
        else [(b - a) / n for a, b, n in zip(m.lo, m.hi, m.bricks, strict=True)]
    )
    numbers = [*m.lo, *m.hi, *size, *m.sigma_t, m.falloff, m.phase.g1, m.phase.g2, m.phase.mix]
    return {
        "numbers": np.array(numbers, float),
        "whole": np.array([m.kind, m.phase.kind, *m.bricks], np.int64),
        "offsets": m.offsets, "samples": m.samples, "attributes": m.attributes if m.attributes.size > 1 else None,
        "brick_max": m.brick_max, "albedo": np.ascontiguousarray(m.albedo), "Le": np.ascontiguousarray(m.Le),
    }  # fmt: skip
