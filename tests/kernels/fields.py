"""Small fields, rays and occupancy for tests of the compiled field."""

import numpy as np

from nerfvol.config.field import FieldShape
from nerfvol.field.layout import Domain
from nerfvol.kernels.field_ops import FieldBatch, FieldLoss, FieldState, March, Occupancy

INSIDE = Domain((0.2, -0.1, 0.3), 1.5)
OUTSIDE = Domain((0.2, -0.1, 0.3), 1.5, outer=6.0)
HASHED = FieldShape(width=16, hash_levels=4, hash_log2_table=9, hash_min=4, hash_max=20)
SHAPES = {
    "default": FieldShape(hash_levels=8, hash_log2_table=9, hash_min=4, hash_max=32),
    "degree 0": FieldShape(**{**vars(HASHED), "sh_degree": 0}),
    "degree 2": FieldShape(**{**vars(HASHED), "sh_degree": 2, "hash_features": 4}),
    "degree 3": FieldShape(**{**vars(HASHED), "sh_degree": 3, "hash_features": 1, "hash_levels": 5}),
    "softplus, eight features": FieldShape(**{**vars(HASHED), "density": "softplus", "hash_features": 8}),
    "rgb": FieldShape(**{**vars(HASHED), "head": "rgb", "n_frequencies_dir": 2}),
    "deep with skip": FieldShape(**{**vars(HASHED), "width": 24, "depth": 4, "skip": 2}),
    "narrow": FieldShape(**{**vars(HASHED), "width": 5, "depth": 2}),
    "wide": FieldShape(**{**vars(HASHED), "width": 256, "depth": 2}),
    "frequencies": FieldShape(encoding="frequency", n_frequencies=3, width=20, depth=2),
    "paper": FieldShape(
        encoding="frequency", n_frequencies=4, n_frequencies_dir=2, width=32, depth=8, skip=5, head="rgb", density="softplus"
    ),
}  # fmt: skip
"""Every encoding, head and activation, and widths that fill no vector."""
ALL_TERMS = FieldLoss((0.2, 0.5, 0.9), colour=0.3, distortion=0.2, entropy=0.1, early_stop_eps=1e-3)


def field(shape: FieldShape, domain: Domain = INSIDE, seed: int = 0) -> FieldState:
    """A state whose values are large enough that every part of it matters."""
    state = FieldState(domain, shape, seed)
    rng = np.random.default_rng(seed)
    state.table[...] = rng.normal(size=state.table.shape)
    state.network += 0.3 * rng.normal(size=state.network.shape).astype(np.float32)
    return state


def rays(n: int, domain: Domain = INSIDE, seed: int = 0) -> FieldBatch:
    """From around the inner cube (or inside it, where it has a background) through it; one misses everything."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    middle = np.asarray(domain.center) + rng.uniform(-0.5, 0.5, (n, 3)) * domain.half
    o = middle - d * domain.half * (3 if domain.outer == 1 else 0.5)
    if n > 3:
        o[2] += 100 * domain.half * domain.outer
    return FieldBatch(*(a.astype(np.float32) for a in (o, d, rng.random((n, 3)), rng.random(n))))


def everywhere(domain: Domain = INSIDE, n_steps: int = 24, resolution: int = 16) -> March:
    """Nothing is skipped."""
    return March(Occupancy(domain, resolution), n_steps, near_plane=0.0 if domain.outer == 1 else 0.05)


def scattered(domain: Domain = INSIDE, n_steps: int = 48, share: float = 0.01, resolution: int = 32) -> March:
    """Isolated occupied cells: the hardest case for skipping in groups."""
    grid = Occupancy(domain, resolution)
    grid.sigmas[...] = (np.random.default_rng(2).random(len(grid.sigmas)) < share) * np.float32(1e6)
    grid.refresh()
    return March(grid, n_steps, near_plane=0.0 if domain.outer == 1 else 0.05)
