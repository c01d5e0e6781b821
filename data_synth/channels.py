"""Media whose coefficients are RGB grids of their own: three grey media, one a channel, each rendered alone.

The equation of transfer knows no exchange between wavelengths, so that a channel is an ordinary grey medium: every estimator,
majorant, deep map and the core in C++ serve it as they are, without weights that differ by channel (which explode where one
channel's extinction is much larger than another's), at the price of three pictures. Alpha and distance are the channels' means.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from data_synth import media
from data_synth import phase as phases
from data_synth.errors import InputError
from data_synth.media import Medium, Point, rgb

if TYPE_CHECKING:
    from data_synth.scene import Scene


class Channels(NamedTuple):
    """The media of red, green and blue, on grids of one shape in one box."""

    red: Medium
    green: Medium
    blue: Medium

    @property
    def lo(self) -> tuple[float, float, float]:
        """Lower corner of the box."""
        return self.red.lo

    @property
    def hi(self) -> tuple[float, float, float]:
        """Upper corner of the box."""
        return self.red.hi

    @property
    def phase(self) -> phases.Phase:
        """Of all channels."""
        return self.red.phase

    @property
    def Le(self) -> np.ndarray:
        """(1, 3) what it emits where that is the same everywhere."""
        return np.array([[m.Le[0, c] for c, m in enumerate(self)]])

    def with_step(self, step: float) -> Channels:
        """With another length of marching steps, u."""
        return Channels(*(m._replace(step=step) for m in self))


def rgb_grid(
    sigma_t: ArrayLike, lo: Point, hi: Point, albedo: ArrayLike = 0.0, Le: ArrayLike = 0.0,
    phase: phases.Phase | None = None, g: ArrayLike | None = None, S: ArrayLike | None = None,
) -> Channels:  # fmt: skip
    """Extinction (nx, ny, nz, 3) in 1/u, albedo and Le, each of the same shape or one RGB, at the vertices of a grid from lo to
    hi; each channel of all is trilinear in between. g, S: as those of ``media.grid``, the same for all channels."""
    sigma_t = np.asarray(sigma_t, float)
    if sigma_t.ndim != 4 or sigma_t.shape[3] != 3:
        raise InputError(f"rgb_grid: sigma_t must have the shape (nx, ny, nz, 3), got {sigma_t.shape}")
    albedo = np.asarray(albedo, float)
    if albedo.shape not in ((), (3,), sigma_t.shape):
        raise InputError(f"rgb_grid: albedo must have the shape of sigma_t or be one colour, got {albedo.shape}")
    if not (np.isfinite(albedo).all() and albedo.min() >= 0 and albedo.max() <= 1):
        raise InputError("rgb_grid: albedo must be in [0, 1]")
    if np.ndim(Le) > 1 and np.shape(Le) != sigma_t.shape:
        raise InputError(f"rgb_grid: Le must have the shape of sigma_t or be one colour, got {np.shape(Le)}")
    glow = np.asarray(Le, float) if np.ndim(Le) > 1 else np.array(rgb(Le, "Le"))
    whole = albedo if albedo.shape == sigma_t.shape else np.broadcast_to(albedo, sigma_t.shape)
    table = np.array([[0.0] * 3, [1.0] * 3])  # the attribute of a channel's medium is its albedo

    def channel(c: int) -> Medium:
        m = media.grid(
            sigma_t[..., c],
            lo,
            hi,
            1.0,
            0.0,
            glow[..., c] if glow.ndim > 1 else glow[c],
            phase,
            attribute=whole[..., c],
            g=g,
            S=S,
        )
        return m._replace(albedo=table)

    return Channels(channel(0), channel(1), channel(2))


def rgb_coefficients(
    sigma_a: ArrayLike, sigma_s: ArrayLike, lo: Point, hi: Point, Le: ArrayLike = 0.0, phase: phases.Phase | None = None,
    g: ArrayLike | None = None, S: ArrayLike | None = None,
) -> Channels:  # fmt: skip
    """As ``rgb_grid``, of absorption and scattering (nx, ny, nz, 3) in 1/u; extinction and albedo are interpolated."""
    absorbed, scattered = np.asarray(sigma_a, float), np.asarray(sigma_s, float)
    if absorbed.shape != scattered.shape:
        raise InputError(f"rgb_coefficients: expected one shape, got {absorbed.shape} and {scattered.shape}")
    if absorbed.size and min(absorbed.min(), scattered.min()) < 0:
        raise InputError("rgb_coefficients: expected coefficients from 0 on")
    total = absorbed + scattered
    albedo = np.divide(scattered, total, out=np.zeros_like(total), where=total > 0)
    return rgb_grid(total, lo, hi, albedo, Le, phase, g, S)


def split(scene: Scene) -> list[Scene] | None:
    """The scene in red, green and blue where one of its media has channels, else None."""
    every = (scene.medium, *scene.media)
    if not any(isinstance(m, Channels) for m in every):
        return None

    def one(m: Medium | Channels | None, c: int) -> Medium | None:
        return m[c] if isinstance(m, Channels) else m

    return [replace(scene, medium=one(scene.medium, c), media=[one(m, c) for m in scene.media]) for c in range(3)]


def rendered(scenes: list[Scene], seed: int, sums: Callable[[Scene, int], np.ndarray]) -> np.ndarray:
    """The sums (integrators.py) of a picture whose channels are those of three scenes, with random numbers of their own."""
    found = [sums(scene, (3 * seed + c) % 2**63) for c, scene in enumerate(scenes)]
    out = sum(found[1:], found[0].copy()) / 3.0  # alpha and distance
    for c in range(3):
        for first in (0, 5) if out.shape[2] == 8 else (0,):
            out[..., first + c] = found[c][..., first + c]
    return out
