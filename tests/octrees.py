"""Octrees that hypothesis invents, in a frame whose lattice points are exact."""

import numpy as np
from hypothesis import given as hypothesis_given
from hypothesis import settings
from hypothesis import strategies as st

from nerfvol.octree.topology import OFFSETS
from nerfvol.octree.tree import Octree

# Dyadic, so that positions of lattice points are exact and can be compared with ==.
ORIGIN, SIZE = (-1.5, 0.25, -4.0), 2.0
DEEPEST = 6

indices = st.integers(0, 1 << 20)


def given(*strategies, examples: int = 50):
    """hypothesis.given without a deadline: a busy machine is not a failure."""
    return lambda test: settings(deadline=None, max_examples=examples)(hypothesis_given(*strategies)(test))


@st.composite
def leaf_sets(draw) -> tuple[np.ndarray, np.ndarray]:
    """Leaves of several levels that do not overlap, with holes: split some cells, then drop some."""
    leaves = [(1, *OFFSETS[o]) for o in range(8)]
    for choice in draw(st.lists(indices, max_size=9)):
        level, i, j, k = leaves.pop(choice % len(leaves))
        if level < DEEPEST:
            leaves += [(level + 1, 2 * i + a, 2 * j + b, 2 * k + c) for a, b, c in OFFSETS]
        else:
            leaves.append((level, i, j, k))
    for choice in draw(st.lists(indices, max_size=20)):
        if len(leaves) > 1:
            leaves.pop(choice % len(leaves))
    table = np.array(leaves, dtype=np.int64)
    return table[:, 0], table[:, 1:]


@st.composite
def octrees(draw) -> Octree:
    level, ijk = draw(leaf_sets())
    return filled(Octree.from_leaves(level, ijk, ORIGIN, SIZE, draw(st.integers(0, 3)), 3.0), draw(indices))


def filled(octree: Octree, seed: int) -> Octree:
    octree.values[:] = np.random.default_rng(seed).standard_normal(octree.values.shape)
    return octree
