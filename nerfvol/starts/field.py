"""Distillation: a radiance field becomes a sparse octree of several leaf sizes, and what that costs is measured.

1. Candidates: the field is looked at in coarse cells; only cells that hold something, and their neighbours, are looked
   at again at half the size, down to twice the finest size (outside the inner cube: the coarser the farther out).
2. Values: coefficient and spherical harmonics at the leaves' vertices, averaged around the vertex.
3. Visibility: leaves that ENOUGH_VIEWS views have in their picture and no ray needs are removed (starts/visible.py) [after
   PlenOctrees, section 4, which asks all views: what few views do not need is often needed by another]. They are judged as
   they would be merged: thin haze has weight in large leaves only.
4. What is left is split and filled again: before, a haze of the finest leaves would fit nowhere.
5. Merging: eight leaves whose values the parent's own corners reproduce become one.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.config.field import DistillConfig
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import EmptyModel
from nerfvol.field.layout import Domain, PointField
from nerfvol.machine import return_free_memory
from nerfvol.measure.scores import evaluate, score_views
from nerfvol.octree.merge import merge_smooth
from nerfvol.octree.rows import DENSITY_SCALE
from nerfvol.octree.tree import Octree
from nerfvol.starts.cells import Frame, candidate_cells, finer_cells
from nerfvol.starts.values import REACH, WIDE_REACH, write_values
from nerfvol.starts.visible import judged_downscale, needed
from nerfvol.views import OctreeModel

COMPARED_VIEWS = 2
"""Training views on which field and octree are compared."""


@dataclasses.dataclass
class DistillReport:
    """What came out and what was lost; PSNR in dB over the same views of the dataset.

    candidates: the most cells that were leaves at one time; pruned: of the coarse ones, not seen; merged: of the fine ones.
    """

    leaves: int
    vertices: int
    leaves_per_level: dict[int, int]
    bytes: int
    candidates: int
    merged: int
    pruned: int
    field_psnr: float
    octree_psnr: float
    messages: list[str]

    @property
    def lost_db(self) -> float:
        """PSNR of the field minus PSNR of the octree."""
        return self.field_psnr - self.octree_psnr

    def __str__(self) -> str:
        levels = ", ".join(f"{n} at level {level}" for level, n in self.leaves_per_level.items())
        return (
            f"distilled {self.leaves} leaves ({levels}), {self.vertices} vertices, {self.bytes / 1e6:.1f} MB; "
            f"field {self.field_psnr:.2f} dB, octree {self.octree_psnr:.2f} dB on the same views: "
            f"{self.lost_db:.2f} dB lost"
        )


def distill(
    field: PointField,
    domain: Domain,
    dataset: Dataset,
    background: Sequence[float],
    config: DistillConfig,
    render_field: Callable[[Camera], np.ndarray] | None = None,
) -> tuple[Octree, DistillReport]:
    """Octree of a field.

    Args:
        field: with an SH head (``field.sh``), or any field, whose colour is then projected on SH by quadrature.
        domain: the field's region.
        dataset: the training views: they decide what is visible, and some serve for the comparison.
        background: RGB behind the scene.
        render_field: camera -> (h, w, 3) image of the field; None: no comparison is made (PSNRs are NaN).

    Raises:
        EmptyModel: the field is empty: nothing in it is as opaque as ``empty_opacity``.
    """
    config = config.for_scene(dataset.scene)
    level, messages = cast(int, config.level), []
    coarse = dataclasses.replace(config, level=max(min(config.coarse_level, level), level - 1))
    goal = Frame.of(domain, level)
    frame, *cells = candidate_cells(field, goal.finer(cast(int, coarse.level) - level), coarse, messages)
    sieve, whole = _Sieve(field, dataset, background, config), 0
    octree = sieve.seen(sieve.octree(frame, *cells, reach=REACH if frame == goal else WIDE_REACH))
    while frame.finest < goal.finest and not whole:
        *cells, whole = finer_cells(field, octree, frame, config)
        frame = frame.finer(1)
        octree = sieve.octree(frame, *cells, reach=REACH)
    octree = sieve.merged_octree(octree)
    if whole:
        messages.append(
            f"the field is hazy: {whole:,} leaves of its thinnest parts were not split, for it would not fit into "
            f"{config.max_leaves:,} leaves"
        )
    field_psnr = octree_psnr = math.nan
    if render_field is not None:
        few = dataset.evenly(COMPARED_VIEWS).smaller(judged_downscale(dataset), background)
        field_psnr = score_views(render_field, few, background)["psnr"]
        octree_psnr = evaluate(OctreeModel(octree), few, background)["psnr"]
    levels, counts = np.unique(octree.leaf_level, return_counts=True)
    report = DistillReport(
        leaves=octree.n_leaves, vertices=octree.n_vertices,
        leaves_per_level=dict(zip(levels.tolist(), counts.tolist(), strict=True)),
        bytes=octree.values.nbytes + octree.corners.nbytes, candidates=sieve.candidates, merged=sieve.merged,
        pruned=sieve.pruned, field_psnr=field_psnr, octree_psnr=octree_psnr, messages=messages,
    )  # fmt: skip
    return octree, report


class _Sieve:
    """Makes leaves of cells and takes away what is not worth having; counts what came in and went."""

    def __init__(self, field: PointField, dataset: Dataset, background: Sequence[float], config: DistillConfig) -> None:
        self.field, self.dataset, self.background, self.config = field, dataset, background, config
        self.candidates = self.merged = self.pruned = 0

    def octree(self, frame: Frame, level: np.ndarray, ijk: np.ndarray, reach: float) -> Octree:
        """The octree of these cells with the field's values (write_values)."""
        if self.dataset.scene.is_unbounded:
            kept = ~self.dataset.before_a_lens(frame.origin + (ijk + 0.5) * (frame.size / 2.0**level)[:, None])
            level, ijk = level[kept], ijk[kept]
        return_free_memory()
        scale, degree = DENSITY_SCALE / (2 * frame.half), cast(int, self.config.sh_degree)
        octree = Octree.from_leaves(level, ijk, frame.origin.tolist(), frame.size, degree, scale)
        write_values(octree, self.field, reach)
        self.candidates = max(self.candidates, octree.n_leaves)
        return octree

    def merged_octree(self, octree: Octree) -> Octree:
        """The octree with larger leaves where it is smooth."""
        merged = merge_smooth(octree, self.config.coarse_level, self.config.merge_tolerance)
        self.merged = octree.n_leaves - merged.n_leaves
        return merged

    def seen(self, octree: Octree) -> Octree:
        """The octree without what no view needs, judged by the larger leaves that it would merge to; EmptyModel where nothing
        is left."""
        judged = merge_smooth(octree, self.config.coarse_level, self.config.merge_tolerance)
        keep = needed(judged, self.dataset, self.background, self.config.prune_weight)
        if not keep.any():
            raise EmptyModel(
                "the field holds nothing that the training views can see; train it longer or use --init direct"
            )
        if keep.all():
            return octree
        octree = octree.prune(keep[judged.query(octree.leaf_centers())])[0]
        self.pruned = self.candidates - octree.n_leaves
        return octree
