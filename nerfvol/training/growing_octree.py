"""An octree in training: its optimiser's state, and what rays have said of its leaves since they last changed."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.octree.rows import convert_rows
from nerfvol.octree.topology import Transfer
from nerfvol.octree.tree import Octree
from nerfvol.training.memory import splits_within


class GrowingOctree:
    """``octree``, ``state`` of its optimiser and statistics of its leaves, and ``tiles_seen``: tiles that these come from.

    max_leaves: bound on splitting, where memory is short; None: none.
    """

    def __init__(self, octree: Octree, max_leaves: int | None = None) -> None:
        self.octree, self.state = octree, ops.TrainState(octree)
        self.max_leaves, self.tiles_seen = max_leaves, 0

    def change(self, octree: Octree, transfer: Transfer) -> Transfer:
        """Goes on with ``octree``, which ``transfer`` made of the present one; nothing is known of its leaves."""
        self.octree = octree  # the old values go before the moments follow
        self.state = ops.TrainState(octree, transfer.vertices(self.state.moments))
        self.tiles_seen = 0
        return transfer

    def split(self, wanted: NDArray[np.bool_], error: NDArray[np.floating], share: float) -> Transfer | None:
        """Splits the ``wanted`` leaves among those that hold ``share`` of ``error``; None: there are none.

        Both (n_leaves,). Where memory is short, those of the largest error.
        """
        wanted = splits_within(wanted & holds_share(error, share), error, self.max_leaves)
        return self.change(*self.octree.subdivide(wanted)) if wanted.any() else None

    def grow_sh(self, degree: int) -> None:
        """The same field with more bands, which begin at zero."""
        moments = convert_rows(self.state.moments, self.octree.sh_degree, degree)
        self.octree = self.octree.with_sh_degree(degree)
        self.state = ops.TrainState(self.octree, moments)

    def forget_statistics(self) -> None:
        """Forgets what rays needed so far."""
        self.tiles_seen = 0
        self.state.reset_statistics(self.octree.n_leaves)

    def leaves_saved(self) -> dict[str, Any]:
        """The part of a checkpoint that :meth:`load_leaves` reads."""
        t, s = self.octree, self.state
        return {
            "node_mask": t.node_mask, "leaf_mask": t.leaf_mask, "values": t.values, "moments": s.moments,
            "origin": t.origin, "size": t.size, "density_scale": t.density_scale, "sh_degree": t.sh_degree,
            "max_weight": s.max_weight, "error": s.error, "footprint": s.footprint, "tiles_seen": self.tiles_seen,
        }  # fmt: skip

    def load_leaves(self, state: dict[str, Any]) -> None:
        """Goes on where :meth:`leaves_saved` was called.

        Raises:
            InputError: the arrays do not fit each other.
        """
        octree = Octree(
            state["node_mask"], state["leaf_mask"], origin=state["origin"], size=state["size"],
            sh_degree=state["sh_degree"], density_scale=state["density_scale"],
        )  # fmt: skip
        if np.shape(state["values"]) != octree.values.shape or np.shape(state["moments"]) != octree.values.shape:
            raise InputError("checkpoint: values and moments do not fit the octree's topology")
        octree.values = np.array(state["values"], dtype=np.float32)
        self.octree = octree
        self.state = ops.TrainState(octree, np.array(state["moments"], dtype=np.float32))
        for name in ("max_weight", "error", "footprint"):
            if np.shape(state[name]) != (octree.n_leaves,):
                raise InputError(f"checkpoint: {name} does not fit the octree's {octree.n_leaves} leaves")
            setattr(self.state, name, np.array(state[name], dtype=np.float32))
        self.tiles_seen = int(state["tiles_seen"])


def holds_share(error: np.ndarray, share: float) -> np.ndarray:
    """The fewest entries of ``error`` (n,) that together hold ``share`` of its sum: (n,) bool."""
    order = np.argsort(-error, kind="stable")
    held = np.cumsum(error[order], dtype=np.float64)
    chosen = np.zeros(len(error), dtype=bool)
    chosen[order[: 1 + np.searchsorted(held, share * held[-1])]] = True
    return chosen
