"""Surfels of an octree: Gaussians that lie flat on what its views see, for a training of splats to begin with. To be drawn as
they are its leaves do better (starts/gaussians.py).

A visible leaf becomes a disc: across the gradient of the density, as wide as the leaf, of its colour's spherical harmonics as
they are. Eight cells whose colours and normals agree become one disc of twice the width, again and again, so that plain
surfaces take few. [Surfels: Pfister et al. 2000.]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.octree.rows import explin
from nerfvol.octree.topology import OFFSETS, morton
from nerfvol.octree.tree import Octree
from nerfvol.rotations import turning_z_to
from nerfvol.splats.points import Y00
from nerfvol.splats.splats import Splats

WIDTH, THICKNESS = 0.5, 0.12
"""Standard deviations of a disc in units of its cell's side: a plane of them is even to 1.5 %."""
SEEN = 0.05
"""Largest rendering weight from which a leaf is visible."""
COLOUR, AGREEMENT = 0.06, 0.95
"""Deviation of colours, and length of the mean unit normal, up to and from which the cells of a larger one are one disc."""
MOST_OPAQUE = 0.95
"""Opacity of a disc: at more no gradient passes what is behind."""
LARGEST = 2
"""Levels above the finest leaf at which discs stop to grow."""

Float = NDArray[np.float64]


@dataclass
class _Cells:
    """n cells of one level: Morton codes, rising; ``mass`` (n,) the integral of the density over them; means by mass of
    position (n, 3), normal (n, 3) and colour rows (n, 3 K), and ``square`` (n, 3) of the squared colour from all sides."""

    code: NDArray[np.int64]
    mass: Float
    position: Float
    normal: Float
    rows: Float
    square: Float

    def __getitem__(self, chosen: NDArray[np.bool_]) -> _Cells:
        return _Cells(*(column[chosen] for column in vars(self).values()))

    @staticmethod
    def joined(a: _Cells, b: _Cells) -> _Cells:
        order = np.argsort(np.concatenate([a.code, b.code]), kind="stable")
        return _Cells(*(np.concatenate([x, y])[order] for x, y in zip(vars(a).values(), vars(b).values(), strict=True)))

    def parents(self) -> tuple[_Cells, NDArray[np.int64]]:
        """The cells twice as large that these lie in, and the number of each one's parent (n,)."""
        above = self.code >> 3
        first = np.flatnonzero(np.concatenate([[True], above[1:] != above[:-1]]))
        number = np.cumsum(np.concatenate([[True], above[1:] != above[:-1]])) - 1
        mass = np.add.reduceat(self.mass, first)

        def mean(column: Float) -> Float:
            return np.add.reduceat(column * self.mass[:, None], first) / mass[:, None]

        columns = (mean(column) for column in (self.position, self.normal, self.rows, self.square))
        return _Cells(above[first], mass, *columns), number


def surfels(
    octree: Octree, weights: NDArray[np.floating], most: int | None = None, mode: Literal["mip", "plain"] = "mip"
) -> Splats:
    """Discs on the leaves that are seen, at most ``most``.

    Args:
        weights: (n_leaves,) largest rendering weight of each leaf over the rays of some views (starts/visible.py).
        most: where there are more, cells are merged that agree less well; and of what is still too much the least massive goes.

    Raises:
        InputError: no leaf is seen.
    """
    seen = np.flatnonzero(weights >= SEEN)
    if not len(seen):
        raise InputError("no ray sees any of the octree's leaves, so there is no surface to put splats on")
    leaves = {int(level): _leaves(octree, seen[octree.leaf_level[seen] == level])
              for level in np.unique(octree.leaf_level[seen])}  # fmt: skip
    chosen = _merged(leaves, COLOUR, AGREEMENT)
    for loosened in range(1, 6):
        if most is None or sum(len(cells.mass) for cells in chosen.values()) <= most:
            break
        chosen = _merged(leaves, COLOUR * 1.5**loosened, AGREEMENT * 0.8**loosened, LARGEST + loosened // 3)
    splats = _discs(octree, chosen, mode)
    if most is not None and splats.n > most:
        mass = np.concatenate([cells.mass for cells in chosen.values()])
        splats = splats.select(np.sort(np.argsort(-mass, kind="stable")[:most]))
    return splats


def _leaves(octree: Octree, chosen: NDArray[np.int64]) -> _Cells:
    """These leaves, of one level, as cells."""
    codes = morton(octree.leaf_ijk[chosen])
    side = octree.leaf_sizes()[chosen[:1]]
    corners = octree.corners[chosen]
    raw = octree.density[corners].astype(np.float64)  # whose gradient is as steep before a surface as within it
    gradient = np.stack([raw @ (2.0 * OFFSETS[:, k] - 1) for k in range(3)], 1)
    sigma = octree.density_scale * explin(raw)
    normal = -gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-12)
    share = sigma + 1e-9
    share /= share.sum(1, keepdims=True)
    sh = octree.sh.reshape(octree.n_vertices, -1)
    rows = np.zeros((len(chosen), sh.shape[1]))
    for o in range(8):
        rows += share[:, o, None] * sh[corners[:, o]]
    position = octree.leaf_centers()[chosen] + (share @ (OFFSETS - 0.5)) * side
    dc = rows.reshape(len(chosen), 3, -1)[:, :, 0] * Y00
    return _Cells(codes, sigma.mean(1) * side**3, position, normal, rows, dc**2)


def _merged(leaves: dict[int, _Cells], tolerance: float, agreement: float, largest: int = LARGEST) -> dict[int, _Cells]:
    """Discs' cells by level: where a cell's children agree, the cell."""
    finest, done = max(leaves), {}
    none = _Cells(*(column[:0] for column in vars(leaves[finest]).values()))
    cells, apart = none, none.code  # of which something is a disc of its own, at the level at hand
    for level in range(finest, 0, -1):
        cells = _Cells.joined(leaves.get(level, none), cells)
        if not len(cells.code):
            apart = apart >> 3
            continue
        parents, number = cells.parents()
        dc = parents.rows.reshape(len(parents.code), 3, -1)[:, :, 0] * Y00
        deviation = np.sqrt(np.maximum(parents.square - dc**2, 0).max(1))
        one = (deviation < tolerance) & (np.linalg.norm(parents.normal, axis=1) > agreement)
        one &= level > finest - largest
        one &= ~np.isin(parents.code, apart >> 3)  # half a cell would be a disc twice its size
        apart = np.concatenate([apart >> 3, parents.code[~one]])
        if not one[number].all():
            done[level] = cells[~one[number]]
        cells = parents[one]
    return done


def _discs(octree: Octree, chosen: dict[int, _Cells], mode: Literal["mip", "plain"]) -> Splats:
    """A disc a cell: its opacity is that of its mass spread over its face, 1 - exp(-integral of sigma / side^2)."""
    sides = np.concatenate([np.full(len(c.mass), octree.size / 2.0**level) for level, c in chosen.items()])
    mass, position, normal, rows = (
        np.concatenate([getattr(c, name) for c in chosen.values()]) for name in ("mass", "position", "normal", "rows")
    )
    opacity = np.clip(-np.expm1(-mass / sides**2), 0.02, MOST_OPAQUE)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(length > 1e-9, normal / np.maximum(length, 1e-9), (0.0, 0.0, 1.0))
    origin = np.median(position, axis=0)
    scales = sides[:, None] * np.array([WIDTH, WIDTH, THICKNESS])
    return Splats(
        means=(position - origin).astype(np.float32), log_scales=np.log(scales).astype(np.float32),
        quats=turning_z_to(normal).astype(np.float32), logits=np.log(opacity / (1 - opacity)).astype(np.float32),
        sh=rows.reshape(len(rows), 3, -1).astype(np.float32), origin=origin, mode=mode,
    )  # fmt: skip
