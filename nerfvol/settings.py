"""Settings of the field, of its training and of its distillation, and constants that commands and operators share.

They stand apart from the modules that they steer because those import torch or numpy, which costs seconds: every command
reads the settings, few use a field.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeVar, cast

from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.datasets import SceneBounds

T = TypeVar("T")

WHITE = (1.0, 1.0, 1.0)
"""The background where nobody says another, RGB in [0, 1]."""
DEFAULT_EARLY_STOP = 1 / 255
"""Transmittance at which a rendered ray ends: what is behind moves an 8-bit colour by less than one step."""
DEFAULT_LOD = 0.8
"""Pixels: a part of the octree that is smaller is drawn as one cell. More costs sharpness (docs/performance.md)."""


@dataclasses.dataclass(frozen=True)
class FieldShape:
    """What a network looks like.

    encoding: "hash" or "frequency".
    n_frequencies, n_frequencies_dir: L of the frequency encoding, positions and (rgb head) directions.
    hash_levels, hash_features, hash_log2_table, hash_min, hash_max: see ``encodings.HashGrid``.
    width, depth: hidden layers of the trunk and their size.
    skip: index of the hidden layer that sees the encoded position again (0 = none); the paper's is 5 of 8.
    head: "sh" or "rgb".
    sh_degree: 0 to 3, for the SH head.
    density: activation of sigma, "exp" (truncated exponential) or "softplus".
    density_bias: added to the raw density; negative = the field starts as thin haze.
    """

    encoding: Literal["hash", "frequency"] = "hash"
    n_frequencies: int = 10
    n_frequencies_dir: int = 4
    hash_levels: int = 8
    hash_features: int = 2
    hash_log2_table: int = 17
    hash_min: int = 16
    hash_max: int = 256
    width: int = 64
    depth: int = 1
    skip: int = 0
    head: Literal["sh", "rgb"] = "sh"
    sh_degree: int = 1
    density: Literal["exp", "softplus"] = "exp"
    density_bias: float = -1.0

    def __post_init__(self) -> None:
        if min(self.width, self.depth) < 1 or not 0 <= self.skip < self.depth:
            sizes = f"{self.width}, {self.depth}, {self.skip}"
            raise InputError(f"a field needs width, depth >= 1 and 0 <= skip < depth, got {sizes}")
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"the sh_degree of a field must be 0 to 3, got {self.sh_degree}")
        if min(self.n_frequencies, self.n_frequencies_dir) < 0:
            raise InputError("the number of frequencies of an encoding must not be negative")
        if min(self.hash_levels, self.hash_features, self.hash_min) < 1 or self.hash_max < self.hash_min:
            raise InputError("a hash grid needs hash_levels, hash_features, hash_min >= 1 and hash_max >= hash_min")
        if not 4 <= self.hash_log2_table <= 24:
            raise InputError(f"hash_log2_table must be 4 to 24, got {self.hash_log2_table}")


@dataclasses.dataclass
class FieldConfig:
    """How a field is trained; the defaults are the best measured for a minute on two cores."""

    shape: FieldShape = dataclasses.field(default_factory=FieldShape)
    """Section: the network."""
    steps: int = 1500
    """Length of the schedule (images, learning rate) where nobody says how far the run has come."""
    time_budget: float = 75.0
    """Seconds of wall clock the field gets when it only prepares the octree."""
    downscales: tuple[int, ...] = (8, 4, 2)
    """Images are area-averaged by these factors, coarse ones first."""
    stage_ends: tuple[float, ...] = (0.08, 0.35, 1.0)
    """Progress in (0, 1] at which each of them ends."""
    samples_per_step: int = 16384
    """Samples of one step: the number of rays follows from how many samples a ray has just now."""
    max_rays: int = 8192
    """Most rays of one step."""
    march_steps: tuple[int, ...] = (96, 192, 384)
    """Marching steps along the diagonal of the detail cube, for each of them."""
    sampler: Literal["occupancy", "importance"] = "occupancy"
    """Skip empty space, or stratified coarse samples and inverse-CDF fine samples as the paper does."""
    n_coarse: int = 64
    """Stratified samples of a ray with the importance sampler."""
    n_fine: int = 128
    """Inverse-CDF samples of a ray with the importance sampler."""
    grid_resolution: int = 64
    """Cells along an edge of the occupancy grid."""
    near_fraction: float = 0.05
    """Nearest sample to a camera, in units of half the detail cube's edge."""
    learning_rate: float = 0.01
    """Adam's, at the start."""
    final_learning_rate: float = 0.05
    """Its factor at the end; the decay is exponential and starts at a third of the run."""
    colour_weight: float = 0.0
    """Weight of the loss of each sample's own colour, (sum w |c - target|^2 + T |background - target|^2)."""
    sparsity_weight: float = 0.0
    """Weight of mean(1 - exp(-sigma * step)) at random points: clears space that nothing constrains."""
    bfloat16: bool = True
    """Network arithmetic in bfloat16 while training (2 to 3 times as fast where the processor has it)."""

    def __post_init__(self) -> None:
        if not len(self.downscales) == len(self.stage_ends) == len(self.march_steps) >= 1:
            raise InputError(
                "field.downscales, field.stage_ends and field.march_steps must be lists of the same length"
            )
        if min(self.downscales) < 1 or min(self.march_steps) < 8:
            raise InputError("field.downscales must be at least 1 and field.march_steps at least 8")
        if list(self.stage_ends) != sorted(self.stage_ends) or self.stage_ends[-1] != 1:
            raise InputError(f"field.stage_ends must increase and end with 1, got {self.stage_ends}")
        for name in ("steps", "samples_per_step", "max_rays", "n_coarse", "n_fine"):
            if getattr(self, name) < 1:
                raise InputError(f"field.{name} must be at least 1, got {getattr(self, name)}")
        if self.grid_resolution < 8 or self.grid_resolution % 4:
            raise InputError(f"field.grid_resolution must be a multiple of 4, at least 8, got {self.grid_resolution}")
        if not self.learning_rate > 0 or not 0 < self.final_learning_rate <= 1:
            raise InputError("field.learning_rate must be positive and field.final_learning_rate in (0, 1]")


@dataclasses.dataclass
class DistillConfig:
    """How a field is made into an octree."""

    level: int | None = None
    """Finest leaves: 2**level along an edge of the detail cube. None: 8, and 6 in photographs, whose fields are hazy."""
    coarse_level: int = 5
    """Where the search begins; also the coarsest leaves that merging makes in the detail cube."""
    sh_degree: int = 1
    density_scale: float = 300.0
    """Coefficient that a raw density of 1 means, per edge of the detail cube."""
    empty_opacity: float = 5e-4
    """A cell is empty where a finest leaf of its largest coefficient would be less opaque than this."""
    merge_tolerance: float = 0.01
    """Largest error, in opacity of a leaf and in its colour, that merging may cause; 0 keeps all leaves at one size."""
    prune_weight: float = 0.005
    """Leaves whose largest rendering weight over the training rays is below are removed; 0 keeps all."""
    samples_per_vertex: int = 8
    """Field samples averaged into a vertex: 1 (the vertex itself) or 8."""
    max_leaves: int = 2_000_000
    """Most candidates; leaves are made coarser until they fit, then ``empty_opacity`` is raised."""
    visibility_downscale: int = 4
    compare_downscale: int = 4
    compare_views: int = 2
    """Views, and their size, for the comparison of field and octree."""

    def for_scene(self, scene: SceneBounds) -> DistillConfig:
        """The same with a number for each None; photographs are scenes with surroundings."""
        return filled(self, {"level": 8 if scene.background_cube is None else 6})


def filled(settings: T, automatic: Mapping[str, Any]) -> T:
    """The dataclass ``settings`` with a value of ``automatic`` for each of these that is None."""
    chosen = {name: value for name, value in automatic.items() if getattr(settings, name) is None}
    return dataclasses.replace(cast(Any, settings), **chosen)
