"""Distillation: a radiance field becomes a sparse octree of several leaf sizes, and what that costs is measured.

1. Candidates: the field is looked at in coarse cells; only cells that hold something, and their neighbours, are looked
   at again at half the size, down to the finest level (outside the inner cube: the coarser the farther out).
2. Values: coefficient and spherical harmonics at the leaves' vertices, averaged around the vertex.
3. Merging: eight leaves whose values the parent's own corners reproduce become one. Done before pruning, so that thin
   haze is judged by large leaves, in which it has weight.
4. Visibility: leaves that ENOUGH_VIEWS views have in their picture and no ray needs are removed (starts/visible.py) [after
   PlenOctrees, section 4, which asks all views: what few views do not need is often needed by another].
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import cast

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.config.training import DistillConfig
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.field.layout import Domain, PointField
from nerfvol.machine import return_free_memory
from nerfvol.measure.scores import evaluate, score_views
from nerfvol.octree.merge import merge_smooth
from nerfvol.octree.rows import DENSITY_SCALE
from nerfvol.octree.tree import Octree
from nerfvol.starts.cells import Frame, candidate_cells
from nerfvol.starts.values import write_values
from nerfvol.starts.visible import judged_downscale, needed
from nerfvol.views import OctreeModel

COMPARED_VIEWS = 2
"""Training views on which field and octree are compared."""


@dataclasses.dataclass
class DistillReport:
    """What came out and what was lost; PSNR in dB over the same views of the dataset."""

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
        InputError: the field is empty: nothing in it is as opaque as ``empty_opacity``.
    """
    config = config.for_scene(dataset.scene)
    messages: list[str] = []
    frame = Frame.of(domain, cast(int, config.level))
    level, ijk = candidate_cells(field, frame, config, messages)
    if dataset.scene.is_unbounded:
        kept = ~dataset.before_a_lens(frame.origin + (ijk + 0.5) * (frame.size / 2.0**level)[:, None])
        level, ijk = level[kept], ijk[kept]
    return_free_memory()
    octree = Octree.from_leaves(
        level, ijk, frame.origin.tolist(), frame.size, cast(int, config.sh_degree), DENSITY_SCALE / (2 * domain.half)
    )
    write_values(octree, field)
    candidates = octree.n_leaves
    octree = merge_smooth(octree, config.coarse_level, config.merge_tolerance)
    merged = octree.n_leaves
    return_free_memory()
    keep = needed(octree, dataset, background, config.prune_weight)
    if not keep.any():
        raise InputError(
            "the field holds nothing that the training views can see; train it longer or use --init direct"
        )
    if not keep.all():
        octree, _ = octree.prune(keep)
    return_free_memory()
    field_psnr = octree_psnr = math.nan
    if render_field is not None:
        few = dataset.evenly(COMPARED_VIEWS).smaller(judged_downscale(dataset), background)
        field_psnr = score_views(render_field, few, background)["psnr"]
        octree_psnr = evaluate(OctreeModel(octree), few, background)["psnr"]
    levels, counts = np.unique(octree.leaf_level, return_counts=True)
    report = DistillReport(
        leaves=octree.n_leaves, vertices=octree.n_vertices,
        leaves_per_level=dict(zip(levels.tolist(), counts.tolist(), strict=True)),
        bytes=octree.values.nbytes + octree.corners.nbytes, candidates=candidates, merged=candidates - merged,
        pruned=merged - octree.n_leaves, field_psnr=field_psnr, octree_psnr=octree_psnr, messages=messages,
    )  # fmt: skip
    return octree, report
