"""Settings of field, distillation and octree, and constants that commands and operators share.

They stand apart from the modules that they steer because those import torch or numpy, which costs seconds: every command
reads the settings, few use a field.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from nerfvol.config.splats import SplatConfig
from nerfvol.config.values import Colour, Count, Seconds, box, filled, seconds
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.region import SceneBounds

T = TypeVar("T")


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
        return filled(self, {"level": 8 if not scene.is_unbounded else 6})


@dataclasses.dataclass
class OctreeConfig:
    """Settings of the octree's optimisation. Shares of progress lie in [0, 1]."""

    steps: int = 15000
    """Optimiser steps of the whole schedule when no time budget is given."""
    most_epochs: float = 60.0
    """... and when one is given, as many as draw each tile so often at most: a run that comes to them ends early, for more
    would overfit (docs/performance.md)."""
    levels: list[int] = dataclasses.field(default_factory=lambda: [5, 6, 7, 8, 8, 9, 10])
    """Finest level of each stage: level 8 means 256 cells along the region of detail."""
    downscales: list[int] = dataclasses.field(default_factory=lambda: [16, 8, 4, 2, 1, 1, 1])
    """Image downscale of each stage."""
    until: list[float] = dataclasses.field(default_factory=lambda: [0.003, 0.008, 0.03, 0.10, 0.35, 0.60, 1.0])
    """Share of progress at which each stage ends."""
    tiles: list[int] = dataclasses.field(default_factory=lambda: [64, 96, 128, 128, 192, 320, 320])
    """8x8 tiles in a batch, per stage: about equal work a step, so that shares of steps are shares of time."""
    prunes: list[int] = dataclasses.field(default_factory=lambda: [3, 3, 2, 2, 2, 2, 2])
    """Prunings inside each stage, evenly spaced."""
    coverage: float = 0.5
    """Pruning waits until this share of the tiles that are not plain background was seen (see _seen_enough for the cap)."""
    prune_steps: int = 20
    """... and this many steps were made: a thin start needs some to become visible at all, however few the pictures."""
    sh_degree: int | None = None
    """Spherical harmonics of the colours: 0 to 3. None: 1, and 2 in photographs, whose surfaces shine."""
    final_sh_degree: int = 1
    """... in the last stage, where it is more: for shiny scenes. It costs memory and steps (docs/performance.md)."""
    rich_share: float = 0.8
    """Share of a batch drawn from tiles that are not plain background."""
    colour: float = 0.06
    """Weight of the per-sample colour term at the start."""
    distortion: float = 0.05
    """Weight of the distortion term at the start."""
    smooth_density: float | None = None
    """Weight of differences of raw density between the corners of leaves (reference.roughness). None: 6e-5, and 2e-5 in
    photographs."""
    smooth_colour: float | None = None
    """... and of their colours' coefficients. None: 6e-5, and 4e-5 in photographs."""
    smooth_from: int | None = None
    """The step from which on both count. None: 1000, for at first objects have nothing that could overfit; 0 in photographs."""
    regulariser_decay: float = 0.1
    """The weights of all four terms shrink to this factor over the run."""
    rate_density: float = 0.3
    rate_dc: float = 0.07
    rate_sh: float = 0.006
    rate_decay: float | None = None
    """Learning rates shrink exponentially to this factor ... None: 0.04, and 0.02 in photographs."""
    decay_from: float | None = None
    """... from this share of progress on. None: 0.8, and 0.35 in photographs, whose noise takes longer to average."""
    beta: float = 0.98
    prune_weight: float = 0.005
    """Leaves whose largest rendering weight since the last pruning is below are removed."""
    final_prune_weights: list[float] = dataclasses.field(default_factory=lambda: [0.04, 0.02, 0.01])
    """At the end: the first of these at which pruning costs no more than ``final_prune_loss``."""
    final_prune_loss: float = 0.005
    """Share by which the squared error of training tiles may grow (0.005 is 0.02 dB); what it takes from the octree is speed
    and bytes that nobody sees, in thin shells about a tenth, in thick media nothing."""
    whole_pixels: float = 2.5
    """A stage begins by splitting leaves larger than this many pixels of its images in some view, down to its level, ..."""
    coarse_error: float | None = None
    """... that are among the fewest to hold this share of the squared error. None: 0.9, and 0.5 in photographs, where much
    of what rays cross is haze that will be pruned."""
    fine_from: int = 9
    """From this level on a stage splits leaves once, ..."""
    subdivide_pixels: float = 1.5
    """... those larger than this many pixels ..."""
    subdivide_error: float = 0.7
    """... that are among the fewest to hold this share of the squared error."""
    growing_error: float | None = None
    """Each pruning inside a stage splits leaves too, once, by this share. None: 0 (none), and 0.5 in photographs."""
    fine_steps: int = 2500
    """A stage from level ``fine_from`` on is left out where fewer steps would be left for it."""
    early_stop_eps: float = 4e-3
    """Training rays end when their transmittance falls below."""

    def __post_init__(self) -> None:
        for name, (low, high) in OCTREE_RANGES.items():
            given = getattr(self, name)
            for value in given if isinstance(given, list) else [given]:
                if value is not None and not low <= value <= high:
                    raise InputError(f"octree.{name} must lie between {low:g} and {high:g}, got {value:g}")

    def for_scene(self, scene: SceneBounds) -> OctreeConfig:
        """The same with a number for each None; photographs are scenes with surroundings."""
        return filled(self, BOUNDED if not scene.is_unbounded else PHOTOGRAPHS)


OCTREE_RANGES = {
    "steps": (1, math.inf), "most_epochs": (0.1, math.inf), "levels": (1, 16), "downscales": (1, 256), "until": (0, 1),
    "tiles": (1, 1 << 20), "prunes": (0, math.inf), "coverage": (0, math.inf), "prune_steps": (0, math.inf),
    "sh_degree": (0, 3), "final_sh_degree": (0, 3), "rich_share": (0, 1), "colour": (0, math.inf), "distortion": (0, math.inf),
    "smooth_density": (0, math.inf), "smooth_colour": (0, math.inf), "smooth_from": (0, math.inf),
    "regulariser_decay": (1e-9, 1), "rate_density": (0, 1e3), "rate_dc": (0, 1e3), "rate_sh": (0, 1e3),
    "rate_decay": (1e-9, 1), "decay_from": (0, 0.999), "beta": (0, 0.9999),
    "prune_weight": (0, math.inf), "final_prune_weights": (0, 1), "final_prune_loss": (0, math.inf),
    "whole_pixels": (0, math.inf), "coarse_error": (0, 1), "fine_from": (0, math.inf), "subdivide_pixels": (0, math.inf),
    "subdivide_error": (0, 1), "growing_error": (0, 1), "fine_steps": (0, math.inf), "early_stop_eps": (0, 0.999),
}  # fmt: skip
"""Smallest and largest value of each setting of an octree, and of each entry of a list; levels end where topology's do."""
BOUNDED = {"sh_degree": 1, "rate_decay": 0.04, "decay_from": 0.8, "coarse_error": 0.9, "growing_error": 0.0,
           "smooth_density": 6e-5, "smooth_colour": 6e-5, "smooth_from": 1000}  # fmt: skip
PHOTOGRAPHS = {"sh_degree": 2, "rate_decay": 0.02, "decay_from": 0.35, "coarse_error": 0.5, "growing_error": 0.5,
               "smooth_density": 2e-5, "smooth_colour": 4e-5, "smooth_from": 0}  # fmt: skip
"""Settings of an octree where nothing else is said."""


OCTREE_STARTS = ("direct", "mlp")
SPLAT_STARTS = ("points", "sweep", "points+sweep", "random")
"""Besides a file of splats."""


@dataclass
class Config:
    """Everything one training run depends on. ``nerfvol train`` writes it, resolved, to RUN/config.yaml."""

    data: str = ""
    """Folder (or transforms JSON) of posed images."""
    out: str = ""
    """Run folder."""
    representation: Literal["auto", "octree", "splats"] = "auto"
    """What is trained. auto: splats on photographs, which are sharper and sooner so; the octree, which has a density, on
    objects with a transparent background and on media."""
    init: str = "auto"
    """Where it starts. An octree: "mlp", a small field that is trained and distilled, or "direct", low density everywhere
    (auto). Splats: "points" of a COLMAP model, "sweep" of planes through the photographs, "points+sweep", "random", or a
    file of splats (auto: what there is)."""
    time_budget: Annotated[float | None, seconds] = None
    """Seconds of wall clock for everything, from the start of the process; None: the sections' numbers of steps."""
    background: Colour = (1.0, 1.0, 1.0)
    """Colour behind the scene, RGB in [0, 1]; images with alpha are composited on it."""
    downscale: Count = 1
    """Images are area-averaged by this whole factor."""
    aabb: Annotated[tuple[float, float, float, float, float, float] | None, box] = None
    """The region of detail, lowest and highest corner in the units of the poses; None: worked out from the cameras."""
    threads: int = 0
    """CPU threads; 0: all cores this process may use."""
    seed: int = 0
    resume: bool = False
    """Go on from RUN's checkpoint."""
    checkpoint_every: Seconds = 30.0
    """Seconds between checkpoints."""
    storage: Literal["float32", "float16", "compact"] = "compact"
    """How octree files hold their values: exactly, halved, or quantised to about a tenth (docs/file_format.md)."""
    compare_views: Count = 2
    """Held-out views on which field, distilled and fine-tuned octree are compared (a field renders slowly)."""
    field: Any = dataclasses.field(default_factory=FieldConfig)
    """Section: the MLP field (FieldConfig)."""
    distill: Any = dataclasses.field(default_factory=DistillConfig)
    """Section: the field's way into the octree (DistillConfig)."""
    octree: OctreeConfig = dataclasses.field(default_factory=OctreeConfig)
    """Section: the octree and its optimisation (OctreeConfig)."""
    splats: SplatConfig = dataclasses.field(default_factory=SplatConfig)
    """Section: Gaussian splats and their optimisation (config.splats)."""

    def __post_init__(self) -> None:
        """Raises InputError where ``init`` is no start of the representation; a resumed run needs its file no more."""
        if self.resume:
            return
        known = {"octree": OCTREE_STARTS, "splats": SPLAT_STARTS}
        names = known.get(self.representation, OCTREE_STARTS + SPLAT_STARTS)
        is_file = self.representation != "octree" and Path(self.init).exists()
        if self.init != "auto" and self.init not in names and not is_file:
            of = "" if self.representation == "auto" else f" for {self.representation}"
            or_file = "" if self.representation == "octree" else " or a file of splats"
            raise InputError(f"init: expected auto, {', '.join(names)}{or_file}{of}, got {self.init!r}")

    def for_scene(self, scene: SceneBounds) -> Config:
        """The same with a number for each setting that the kind of scene decides."""
        sections = {name: getattr(self, name).for_scene(scene) for name in ("octree", "distill", "splats")}
        chosen = self.representation
        if chosen == "auto":
            named = "octree" if self.init in OCTREE_STARTS else "auto" if self.init == "auto" else "splats"
            chosen = ("splats" if scene.is_unbounded else "octree") if named == "auto" else named
        return dataclasses.replace(self, **sections, representation=chosen)
