"""Octrees and rays for the tests of the kernels: random ones, and the awkward ones."""

from __future__ import annotations

import numpy as np

from nerfvol.octree.topology import OFFSETS
from nerfvol.octree.tree import Octree

DYADIC = {"origin": (-1.0, -1.0, -1.0), "size": 2.0}
ODD = {"origin": (0.37, -1.21, 0.93), "size": 1.7}


def leaves(kind: str, rng: np.random.Generator, deepest: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Leaf sets: "mixed" levels with holes, "full" (every cell of level 2), "single", "sparse" (a few tiny ones)."""
    if kind == "single":
        return np.array([1]), np.array([[1, 0, 1]])
    if kind == "sparse":
        n = 1 << deepest
        ijk = np.unique(rng.integers(0, n, (12, 3)), axis=0)
        return np.full(len(ijk), deepest), ijk
    cells = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    if kind == "full":
        return np.full(64, 2), cells
    level, ijk, current = [], [], cells
    for depth in range(2, deepest + 1):
        split = rng.random(len(current)) < (0.35 if depth < deepest else 0)
        kept = current[~split & (rng.random(len(current)) < 0.75)]
        level.append(np.full(len(kept), depth))
        ijk.append(kept)
        current = (2 * current[split][:, None] + OFFSETS).reshape(-1, 3)
    return np.concatenate(level), np.concatenate(ijk)


def random_octree(
    kind: str, degree: int, rng: np.random.Generator, frame: dict = DYADIC, strength: float = 3.0
) -> Octree:
    """Random values; ``strength`` scales the optical depth across the root cube."""
    level, ijk = leaves(kind, rng)
    octree = Octree.from_leaves(level, ijk, frame["origin"], frame["size"], degree, strength / frame["size"])
    octree.density = rng.uniform(-3.0, 3.0, octree.n_vertices)
    octree.sh = rng.standard_normal(octree.sh.shape) * 0.6
    return octree


def unit(v: np.ndarray) -> np.ndarray:
    """Directions as float32, unit to rounding."""
    v = np.asarray(v, np.float64)
    return (v / np.linalg.norm(v, axis=-1, keepdims=True)).astype(np.float32)


def camera_tiles(octree: Octree, rng: np.random.Generator, n_tiles: int, distance: tuple[float, float] = (0.8, 2.5)):
    """8x8 tiles of pinhole cameras around the cube that look at a leaf, every fourth one inside the cube.

    rays_o (n_tiles, 3), rays_d (64 n_tiles, 3), float32.
    """
    center = octree.origin + octree.size / 2
    origins, directions = [], []
    for tile in range(n_tiles):
        away = unit(rng.standard_normal(3))
        o = center + away * octree.size * (rng.uniform(*distance) if tile % 4 else rng.uniform(0.0, 0.3))
        leaf = rng.integers(octree.n_leaves)
        target = octree.leaf_centers()[leaf] + rng.uniform(-0.3, 0.3, 3) * octree.leaf_sizes()[leaf]
        forward = unit(target - o)
        side = unit(np.cross(forward, rng.standard_normal(3)))
        up = np.cross(side, forward)
        step = rng.choice([0.002, 0.02, 0.1])
        grid = (np.arange(8) - 3.5) * step
        u, v = np.meshgrid(grid, grid)
        directions.append(unit(forward + u[..., None] * side + v[..., None] * up).reshape(64, 3))
        origins.append(o)
    return np.array(origins, np.float32), np.concatenate(directions)


def scattered_rays(octree: Octree, rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays that each have an origin and a direction of their own: (n, 3) both."""
    o = octree.origin + octree.size * rng.uniform(-0.8, 1.8, (n, 3))
    target = octree.origin + octree.size * rng.random((n, 3))
    return o.astype(np.float32), unit(target - o)


def lattice_rays(octree: Octree, rng: np.random.Generator, n: int, level: int) -> tuple[np.ndarray, np.ndarray]:
    """Axis-parallel rays whose lines run exactly along faces, edges and through the middle of cells of ``level``."""
    spacing = octree.size / 2.0**level / 2
    reach = 2 << level
    o = octree.origin + rng.integers(-2, reach + 3, (n, 3)) * spacing
    axis = rng.integers(0, 3, n)
    sign = rng.choice([-1.0, 1.0], n)
    o[np.arange(n), axis] = octree.origin[axis] + np.where(sign > 0, -0.5, 1.5) * octree.size
    inside = rng.random(n) < 0.25  # start on a lattice plane inside the cube
    o[inside, axis[inside]] = (octree.origin[axis] + rng.integers(0, reach + 1, n) * spacing)[inside]
    d = np.zeros((n, 3))
    d[np.arange(n), axis] = sign
    return o.astype(np.float32), d.astype(np.float32)
