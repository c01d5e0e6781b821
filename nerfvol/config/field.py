"""Settings of a field, a small network, and of its way into an octree."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from nerfvol.config.octree import BOUNDED, PHOTOGRAPHS, Degree, Downscale, Level
from nerfvol.config.values import (
    Checked,
    Count,
    Decay,
    Share,
    Weight,
    above,
    at_least,
    filled,
    increasing_to_one,
    same_length,
    within,
)
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.region import SceneBounds

LOG2_TABLE, FINEST = 17, 256
"""Of a hash grid whose tables nobody chose: what an octree begins with has to learn and to be distilled in seconds."""


@dataclass(frozen=True)
class FieldShape(Checked):
    """What a network looks like."""

    section: ClassVar[str] = "field.shape"

    encoding: Literal["hash", "frequency"] = "hash"
    """Of positions: a hash grid [Mueller et al. 2022] or sines and cosines [Mildenhall et al. 2020]."""
    n_frequencies: Annotated[int, at_least(0)] = 10
    """L of the frequency encoding of positions."""
    n_frequencies_dir: Annotated[int, at_least(0)] = 4
    """L of the frequency encoding of directions, with the rgb head."""
    hash_levels: Count = 8
    """Grids of the hash encoding."""
    hash_features: Count = 2
    """Numbers an entry of the hash encoding's tables holds."""
    hash_log2_table: Annotated[int, within(4, 24)] | None = None
    """Entries of a table of the hash encoding, as a power of two. None: 17, and with ``hash_max`` 19 where a field of an object
    is the product, many views show it and there is time for it (``Config.for_field``)."""
    hash_min: Count = 16
    """Cells along an edge of the coarsest grid."""
    hash_max: Count | None = None
    """Cells along an edge of the finest grid. None: 256, and with ``hash_log2_table`` 512."""
    width: Count = 32
    """Neurons of a hidden layer; at least 64 where few views train by the compiled kernels."""
    depth: Count = 1
    """Hidden layers of the trunk."""
    skip: Annotated[int, at_least(0)] = 0
    """Index of the hidden layer that sees the encoded position again (0: none); the paper's is 5 of 8."""
    head: Literal["sh", "rgb"] = "sh"
    """Colours as spherical harmonics, or by a network of the direction."""
    sh_degree: Degree = 1
    """Of the SH head's spherical harmonics."""
    density: Literal["exp", "softplus"] = "exp"
    """Activation of sigma: a truncated exponential or softplus."""
    density_bias: float = -1.0
    """Added to the raw density; negative: the field starts as thin haze."""

    @property
    def log2_table(self) -> int:
        """``hash_log2_table``, or what it is where nobody chose it."""
        return LOG2_TABLE if self.hash_log2_table is None else self.hash_log2_table

    @property
    def finest(self) -> int:
        """``hash_max``, or what it is where nobody chose it."""
        return FINEST if self.hash_max is None else self.hash_max

    def settled(self) -> FieldShape:
        """The same with a number for each None."""
        return dataclasses.replace(self, hash_log2_table=self.log2_table, hash_max=self.finest)

    def check(self) -> None:
        if self.skip >= self.depth:
            raise InputError(f"field.shape.skip must be below field.shape.depth ({self.depth}), got {self.skip}")
        if self.finest < self.hash_min:
            raise InputError(
                f"field.shape.hash_max must be at least field.shape.hash_min ({self.hash_min}), got {self.finest}"
            )


@dataclass
class FieldConfig(Checked):
    """How a field is trained; the defaults are the best measured for a minute on two cores."""

    section: ClassVar[str] = "field"
    former: ClassVar[Mapping[str, str]] = {
        "learning_rate": "rate",
        "final_learning_rate": "rate_decay",
        "max_rays": "a step has at most 8192 rays, and samples_per_step decides where they are fewer",
        "near_fraction": "it is always 0.05",
    }

    shape: FieldShape = dataclasses.field(default_factory=FieldShape)
    """Section: the network."""
    steps: Count = 4000
    """Length of the schedule (images, learning rate) where nobody says how far the run has come."""
    time_budget: Annotated[float, above(0)] = 15.0
    """Seconds of wall clock the field gets when it only prepares the octree."""
    downscales: tuple[Downscale, ...] = (1,)
    """Images are area-averaged by these factors, one a stage, coarse ones first."""
    stage_ends: tuple[Share, ...] = (1.0,)
    """Share of progress at which each stage ends."""
    samples_per_step: Count = 8192
    """Samples of one step: the number of rays follows from how many samples a ray has just now."""
    march_steps: tuple[Annotated[int, at_least(8)], ...] = (384,)
    """Marching steps along the diagonal of the inner cube, one a stage."""
    sampler: Literal["occupancy", "importance"] = "occupancy"
    """Skip empty space, or stratified coarse samples and inverse-CDF fine samples as the paper does."""
    n_coarse: Count = 64
    """Stratified samples of a ray with the importance sampler."""
    n_fine: Count = 128
    """Inverse-CDF samples of a ray with the importance sampler."""
    grid_resolution: Annotated[int, within(8, 512)] = 128
    """Cells along an edge of the occupancy grid, a multiple of 4."""
    rate: Annotated[float, above(0, 1e3)] = 0.02
    """Adam's learning rate at the start."""
    rate_decay: Decay = 0.05
    """The rate shrinks exponentially to this factor at the end, from a third of the run on."""
    colour_weight: Weight = 0.05
    """Weight of the loss of each sample's own colour, (sum w |c - target|^2 + T |background - target|^2), at the start; it
    shrinks exponentially to a tenth."""
    distortion_weight: Weight = 0.0
    """Weight of the distortion loss of Mip-NeRF 360 at the start, distances in edges of the inner cube; it shrinks alike."""
    entropy_weight: Weight = 0.0
    """Weight of the entropy of a ray's opacity."""
    table_decay: Weight = 1e-6
    """Times an entry of the hash grid, added to its gradient where it has one: what few rays saw falls back to what coarser
    levels say ..."""
    few_views: Annotated[int, at_least(0)] = 16
    """... and with so many training pictures or fewer that is what matters most: then it is ..."""
    few_decay: Weight = 3e-5
    """... this, colours do not depend on the direction, the coarsest grid has at most 8 cells along an edge, ..."""
    few_entropy: Weight = 0.01
    """... and the entropy of a ray's opacity has this weight."""
    sparsity_weight: Weight = 0.0
    """Weight of mean(1 - exp(-sigma * step)) at random points: clears space that nothing constrains. Trains in torch."""
    bfloat16: bool = True
    """Where the field trains in torch: network arithmetic in bfloat16 (2 to 3 times as fast where the processor has it)."""
    trainer: Literal["auto", "torch"] = "auto"
    """By the compiled kernels where they can hold the network (auto), or always in torch, which is far slower."""

    def check(self) -> None:
        same_length(self, "downscales", "stage_ends", "march_steps")
        increasing_to_one(self, "stage_ends")
        if self.grid_resolution % 4:
            raise InputError(f"field.grid_resolution must be a multiple of 4, got {self.grid_resolution}")

    def stage_at(self, progress: float) -> int:
        """The stage at ``progress`` in [0, 1], from 0."""
        return next((stage for stage, end in enumerate(self.stage_ends) if progress < end), len(self.stage_ends) - 1)


FEW_VIEWS_DISTILLED = {"level": 7}
"""Settings of distilling a field of an object that few views show: an octree that begins with larger leaves and smaller
pictures is smoother where nothing was seen (docs/experiments.md)."""


@dataclass
class DistillConfig(Checked):
    """How a field is made into an octree."""

    section: ClassVar[str] = "distill"
    former: ClassVar[Mapping[str, str]] = {
        "density_scale": "it is always 300, as in octrees that start from low density",
        "samples_per_vertex": "it is always 4",
        "visibility_downscale": "images are made so small that about 200 pixels are left along them, at most by 4",
        "compare_downscale": "images are made so small that about 200 pixels are left along them, at most by 4",
        "compare_views": "it is always 2",
    }

    level: Level | None = None
    """Finest leaves: 2**level along an edge of the inner cube. None: 8, 7 where few views show an object, and 6 in photographs,
    whose fields are hazy."""
    coarse_level: Level = 5
    """Where the search begins; also the coarsest leaves that merging makes in the inner cube."""
    sh_degree: Degree | None = None
    """Spherical harmonics of the colours. None: as many as in the octree's section."""
    empty_opacity: Annotated[float, within(0, 0.999)] = 5e-4
    """A cell is empty where a finest leaf of its largest coefficient would be less opaque than this."""
    merge_tolerance: Weight = 0.01
    """Largest error, in opacity of a leaf and in its colour, that merging may cause; 0 keeps all leaves at one size."""
    prune_weight: Weight = 0.005
    """Leaves whose largest rendering weight over the training rays is below are removed; 0 keeps all."""
    max_leaves: Count = 2_000_000
    """Most candidates: where the finest leaves of all that views need do not fit, the thinnest parts have leaves of twice the
    size; where those do not fit either, ``empty_opacity`` is raised."""

    def for_scene(self, scene: SceneBounds) -> DistillConfig:
        """The same with a number for each None; photographs are scenes with background shells."""
        kind = BOUNDED if not scene.is_unbounded else PHOTOGRAPHS
        return filled(self, {"level": 8 if not scene.is_unbounded else 6, "sh_degree": kind["sh_degree"]})
