"""Looking at the cells of a field that trains: samples are drawn in occupied cells alone, so that others must be looked at for
space to come back, and occupied ones for haze to go.

Every random number after step k comes from (seed, k).
"""

from __future__ import annotations

import math

import numpy as np

from nerfvol.errors import EmptyModel
from nerfvol.kernels import field_ops
from nerfvol.kernels.field_ops import FieldState, Occupancy

SWEEPS = (32, 64, 128)
"""After so many steps the whole region is looked at, one point a block of 2**3 cells ..."""
THINNED = (160, 240, 320, 440, 600, 850, 1300, 2000, 3000, 5000)
THIN_DECAY = 0.5
"""... after so many, every occupied cell, and what was seen of it before counts by this factor: haze of the first steps would
stay occupied for thousands of steps, and be half of the samples; ..."""
MOST_LOOKED = 1 << 18
"""... but so many of them at most, evenly chosen: those of photographs' haze would take seconds; ..."""
PROBE_EVERY, PROBES = 128, 32768
"""... and from the sweeps on, each so many steps, so many cells, half of them among the occupied ones."""


def look(state: FieldState, grid: Occupancy, seed: int, step: int) -> None:
    """After ``step`` steps: look at what is due, if anything, and derive anew which cells are occupied.

    Raises:
        EmptyModel: nothing is left.
    """
    probes = step > SWEEPS[-1] and step % PROBE_EVERY == 0
    if not (probes or step in SWEEPS or step in THINNED):
        return  # before the random numbers: beginning a sequence takes as long as a twentieth of a step
    rng = np.random.Generator(np.random.Philox(key=[seed, 1 + step]))

    def seen(cells: np.ndarray, size: int) -> np.ndarray:
        positions = grid.positions(cells, rng.random((len(cells), 3), np.float32), size)
        return field_ops.evaluate(state, positions, values=False)[0]

    if step in SWEEPS:
        grid.note_blocks(seen(grid.blocks(), 2))
    elif step in THINNED:
        held = grid.held()
        apart = -(-len(held) // MOST_LOOKED)
        held = held[rng.integers(apart) :: apart]
        grid.note(held, seen(held, 1), THIN_DECAY)
    else:
        held = grid.held()
        anywhere = rng.integers(len(grid.sigmas), size=PROBES // 2)
        cells = np.concatenate([anywhere, held[rng.integers(len(held), size=PROBES // 2)]])
        grid.note(cells, seen(cells, 1))
    grid.refresh()
    if grid.thickest() < 1 / (255 * math.sqrt(3) * grid.resolution):  # a whole ray would not change an 8-bit colour
        raise EmptyModel(
            "the field collapsed to empty space: no cell of the scene holds anything; check that --background is "
            "the images' background and that the scene bounds contain the object, lower field.rate, or start with "
            "--init direct"
        )
