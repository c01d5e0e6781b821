"""Settings of field, distillation and octree, and constants that commands and operators share.

They stand apart from the modules that they steer because those import torch or numpy, which costs seconds: every command
reads the settings, few use a field. u is the scene unit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from nerfvol.config.medium import MediumConfig
from nerfvol.config.splats import SplatConfig
from nerfvol.config.values import (
    Checked,
    Colour,
    Count,
    Decay,
    Rate,
    Seconds,
    Share,
    Weight,
    above,
    at_least,
    box,
    filled,
    increasing_to_one,
    same_length,
    seconds,
    within,
)
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.region import SceneBounds

MOST_THREADS = 1024
"""More help on no machine, and tens of thousands are refused by the system in the middle of the work."""
SMALLEST_PICTURE = 24
"""Pixels along the shorter side, below which no stage averages pictures by itself."""
FINEST_LEVEL = 16
"""Of a stage's leaves, where the numbers of octree.topology end."""
Degree = Annotated[int, within(0, 3)]
Level = Annotated[int, within(1, FINEST_LEVEL)]
Downscale = Annotated[int, within(1, 256)]


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
    hash_log2_table: Annotated[int, within(4, 24)] = 17
    """Entries of a table of the hash encoding, as a power of two."""
    hash_min: Count = 16
    """Cells along an edge of the coarsest grid."""
    hash_max: Count = 256
    """Cells along an edge of the finest grid."""
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

    def check(self) -> None:
        if self.skip >= self.depth:
            raise InputError(f"field.shape.skip must be below field.shape.depth ({self.depth}), got {self.skip}")
        if self.hash_max < self.hash_min:
            raise InputError(
                f"field.shape.hash_max must be at least field.shape.hash_min ({self.hash_min}), got {self.hash_max}"
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
    few_decay: Weight = 1e-4
    """... this, colours do not depend on the direction, ..."""
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


@dataclass
class DistillConfig(Checked):
    """How a field is made into an octree."""

    section: ClassVar[str] = "distill"
    former: ClassVar[Mapping[str, str]] = {
        "density_scale": "it is always 300, as in octrees that start from low density",
        "samples_per_vertex": "it is always 8",
        "visibility_downscale": "images are made so small that about 200 pixels are left along them, at most by 4",
        "compare_downscale": "images are made so small that about 200 pixels are left along them, at most by 4",
        "compare_views": "it is always 2",
    }

    level: Level | None = None
    """Finest leaves: 2**level along an edge of the inner cube. None: 8, and 6 in photographs, whose fields are hazy."""
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


@dataclass
class OctreeConfig(Checked):
    """Settings of the octree's optimisation. Shares of progress lie in [0, 1]; levels count along the inner cube."""

    section: ClassVar[str] = "octree"
    former: ClassVar[Mapping[str, str]] = {
        "until": "stage_ends",
        "rich_share": "foreground_share",
        "colour": "colour_weight",
        "smooth_density": "tv_density",
        "smooth_colour": "tv_sh",
        "smooth_from": "tv_from",
        "coverage": "pruning always waits until half of the foreground tiles were seen",
        "beta": "it is always 0.98",
        "final_prune_weights": "they are always 0.04, 0.02 and 0.01, and final_prune_loss chooses among them",
        "fine_from": "stages from level 9 on split leaves once",
        "fine_steps": "a stage from level 9 on is always left out where fewer than 2500 steps would be left for it",
    }

    steps: Count = 15000
    """Optimiser steps of the whole schedule when no time budget is given."""
    most_epochs: Annotated[float, at_least(0.1)] = 60.0
    """... and when one is given, as many as draw each tile so often at most: a run that comes to them ends early, for more
    would overfit (docs/experiments.md)."""
    levels: list[Level] = dataclasses.field(default_factory=lambda: [5, 6, 7, 8, 8, 9, 10])
    """Finest level of each stage: level 8 means 256 cells along the inner cube."""
    downscales: list[Downscale] = dataclasses.field(default_factory=lambda: [16, 8, 4, 2, 1, 1, 1])
    """Images are area-averaged by these factors, one a stage."""
    stage_ends: list[Share] = dataclasses.field(default_factory=lambda: [0.003, 0.008, 0.03, 0.10, 0.35, 0.60, 1.0])
    """Share of progress at which each stage ends."""
    tiles: list[Annotated[int, within(1, 1 << 20)]] = dataclasses.field(
        default_factory=lambda: [64, 96, 128, 128, 192, 320, 320]
    )
    """8x8 tiles in a batch, per stage: about equal work a step, so that shares of steps are shares of time."""
    prunes: list[Annotated[int, at_least(0)]] = dataclasses.field(default_factory=lambda: [3, 3, 2, 2, 2, 2, 2])
    """Prunings inside each stage, evenly spaced."""
    prune_steps: Annotated[int, at_least(0)] = 20
    """Steps before each pruning, at least: a low-density start needs some to become visible at all, however few the
    pictures."""
    sh_degree: Degree | None = None
    """Spherical harmonics of the colours: 0 to 3. None: 1, and 2 in photographs, whose surfaces shine."""
    final_sh_degree: Degree = 1
    """... in the last stage, where it is more: for shiny scenes. It costs memory and steps (docs/experiments.md)."""
    foreground_share: Share = 0.8
    """Share of a batch drawn from foreground tiles: those that show more than the background."""
    colour_weight: Weight = 0.06
    """Weight of the per-sample colour term at the start."""
    distortion: Weight = 0.05
    """Weight of the distortion term at the start."""
    sparsity: Weight | None = None
    """Weight of the logarithms of the segments' weights, reached where the rates begin to fall: haze on a ray costs as much as
    a surface, so that what is left are surfaces, and rays with fewer segments. None: 0, and 1.2e-3 in photographs."""
    tv_density: Weight | None = None
    """Weight of differences of raw density between the corners of leaves (reference.roughness). None: 6e-5, and 2e-5 in
    photographs."""
    tv_sh: Weight | None = None
    """... and of their colours' coefficients. None: 6e-5, and 4e-5 in photographs."""
    tv_from: Annotated[int, at_least(0)] | None = None
    """The step from which on both count. None: 1000, for at first objects have nothing that could overfit; 0 in photographs."""
    regulariser_decay: Decay = 0.1
    """The weights of all four terms shrink exponentially to this factor over the run."""
    rate_density: Rate = 0.3
    """RMSprop's rate of the raw density at the start, a step,"""
    rate_dc: Rate = 0.07
    """... of the colours' constant coefficients,"""
    rate_sh: Rate = 0.006
    """... and of the others."""
    rate_decay: Decay | None = None
    """Rates shrink exponentially to this factor at the end. None: 0.04, and 0.02 in photographs."""
    decay_from: Annotated[float, within(0, 0.999)] | None = None
    """... from this share of progress on. None: 0.8, and 0.35 in photographs, whose noise takes longer to average."""
    prune_weight: Weight = 0.005
    """Leaves whose largest rendering weight since the last pruning is below are removed."""
    final_prune_loss: Weight = 0.005
    """Share by which the squared error of training tiles may grow at the last pruning (0.005 is 0.02 dB); what it takes from
    the octree is speed and bytes that nobody sees, in thin shells about a tenth, in thick media nothing."""
    whole_pixels: Weight = 2.5
    """A stage begins by splitting leaves larger than this many pixels of its images in some view, down to its level, ..."""
    coarse_error: Share | None = None
    """... that are among the fewest to hold this share of the squared error. None: 0.9, and 0.5 in photographs, where much
    of what rays cross is haze that will be pruned."""
    subdivide_pixels: Weight = 1.5
    """A stage from level 9 on splits leaves once: those larger than this many pixels ..."""
    subdivide_error: Share = 0.7
    """... that are among the fewest to hold this share of the squared error."""
    growing_error: Share | None = None
    """Each pruning inside a stage splits leaves too, once, by this share of the squared error. None: 0 (none), and 0.5 in
    photographs."""
    early_stop_eps: Annotated[float, within(0, 0.999)] = 4e-3
    """Training rays end when their transmittance falls below."""

    def check(self) -> None:
        same_length(self, "levels", "downscales", "stage_ends", "tiles", "prunes")
        increasing_to_one(self, "stage_ends")

    def for_scene(self, scene: SceneBounds) -> OctreeConfig:
        """The same with a number for each None; photographs are scenes with background shells."""
        return filled(self, BOUNDED if not scene.is_unbounded else PHOTOGRAPHS)

    def for_pictures(self, side: int) -> OctreeConfig:
        """The same with stages that suit pictures of ``side`` pixels along their shorter side.

        Where nobody chose the stages, none averages pictures below SMALLEST_PICTURE: the rays of a tile of 4x4-pixel pictures
        cover the whole field of view, which makes a step ten times as long and teaches nothing. Nor are leaves asked for that
        are smaller than half a pixel, and of stages that become alike the last is left, with one pruning each before it. Larger
        pictures than the stages were made for have stages of finer leaves after them, in a half of what the last one had, each.
        """
        plain = OctreeConfig()
        names = ("levels", "downscales", "stage_ends", "tiles", "prunes")
        most = max(1, side // SMALLEST_PICTURE)
        if any(getattr(self, name) != getattr(plain, name) for name in names):
            return self
        if most >= max(self.downscales):
            return self._with_levels_to(min(finest_level(side), FINEST_LEVEL))
        factor, level = 1 << (most.bit_length() - 1), max(self.levels[0], finest_level(side))
        rows = [(min(row[0], level), min(row[1], factor), *row[2:])
                for row in zip(*(getattr(self, name) for name in names), strict=True)]  # fmt: skip
        kept = [
            row for row, after in zip(rows, [*rows[1:], None], strict=True) if after is None or row[:2] != after[:2]
        ]
        columns = {name: [row[i] for row in kept] for i, name in enumerate(names)}
        columns["prunes"] = [min(n, 1) for n in columns["prunes"][:-1]] + columns["prunes"][-1:]
        return dataclasses.replace(self, **columns)

    def _with_levels_to(self, finest: int) -> OctreeConfig:
        """The same with one more stage for each level after the last one's, to ``finest``."""
        levels, ends = [*self.levels], [*self.stage_ends]
        for level in range(levels[-1] + 1, finest + 1):
            levels.append(level)
            ends[-1:] = [(([0.0, *ends])[-2] + 1) / 2, 1.0]
        more = len(levels) - len(self.levels)
        again = {
            name: [*getattr(self, name), *getattr(self, name)[-1:] * more] for name in ("downscales", "tiles", "prunes")
        }
        return dataclasses.replace(self, levels=levels, stage_ends=ends, **again) if more else self


def finest_level(side: int) -> int:
    """Of leaves that pictures of ``side`` pixels along their shorter side can show: no smaller than half a pixel."""
    return (2 * side).bit_length() - 1


SHORT_RUN = 10.0
"""Seconds of a time budget up to which an octree does not begin as a field: distilling it would take most of them."""
BOUNDED = {"sh_degree": 1, "rate_decay": 0.04, "decay_from": 0.8, "coarse_error": 0.9, "growing_error": 0.0,
           "sparsity": 0.0, "tv_density": 6e-5, "tv_sh": 6e-5, "tv_from": 1000}  # fmt: skip
PHOTOGRAPHS = {"sh_degree": 2, "rate_decay": 0.02, "decay_from": 0.35, "coarse_error": 0.5, "growing_error": 0.5,
               "sparsity": 1.2e-3, "tv_density": 2e-5, "tv_sh": 4e-5, "tv_from": 0}  # fmt: skip
"""Settings of an octree where nothing else is said."""
FEW_VIEWS = {"tv_density": 3e-4, "tv_sh": 3e-4, "tv_from": 0}
"""... and of an object that few views show, which begins as a field (docs/experiments.md)."""


@dataclass(frozen=True)
class SceneChoices:
    """The settings of an octree that the kind of scene decides, as numbers: in OctreeConfig each may be None."""

    sh_degree: int
    rate_decay: float
    decay_from: float
    coarse_error: float
    growing_error: float
    sparsity: float
    tv_density: float
    tv_sh: float
    tv_from: int

    @classmethod
    def of(cls, config: OctreeConfig, scene: SceneBounds) -> SceneChoices:
        """Those of ``config`` for ``scene``."""
        settings = config.for_scene(scene)
        return cls(**{field.name: getattr(settings, field.name) for field in dataclasses.fields(cls)})


OCTREE_STARTS = ("direct", "mlp")
SPLAT_STARTS = ("points", "sweep", "points+sweep", "random")
"""Besides a file of splats or of an octree."""


@dataclass
class Config(Checked):
    """Everything one training run depends on. ``nerfvol train`` writes it, resolved, to RUN/config.yaml."""

    data: str = ""
    """Folder (or transforms JSON) of posed images."""
    out: str = ""
    """Run folder."""
    representation: Literal["auto", "octree", "splats", "field", "medium"] = "auto"
    """What is trained. auto: splats on photographs, which are sharper and sooner so; the octree, which has a density, on
    objects with a transparent background and on media. A field is a small network behind a hash grid. A medium, extinction
    and albedo on a grid, is what ``light`` asks for."""
    light: str | None = None
    """File of what is known of the light (medium.lighting): a medium is fitted that can be lit anew."""
    init: str = "auto"
    """Where it starts. An octree: "mlp", a small field that is trained and distilled (auto: of objects with few training
    views), or "direct", low density everywhere (auto: of all else). A field: auto. Splats: "points" of a COLMAP model, "sweep"
    of planes through the photographs, "points+sweep", "random", or a file or run of splats or of an octree (auto: what there
    is)."""
    time_budget: Annotated[float | None, seconds] = None
    """Seconds of wall clock for everything, from the start of the process; None: the sections' numbers of steps."""
    scene: Literal["auto", "object", "surroundings", "room", "forward"] = "auto"
    """What kind of scene it is (datasets.kinds): an object before nothing or a plain backdrop, a subject with its
    surroundings, a room seen from inside, or photographs that all look one way. auto: by what the pictures and cameras say."""
    background: Colour | None = None
    """Colour behind the scene, RGB in [0, 1]; images with alpha are composited on it. None: white, or the colour of the
    plain backdrop that the photographs show."""
    downscale: Count = 1
    """Images are area-averaged by this whole factor."""
    poses: Literal["given", "auto"] = "given"
    """auto: photographs without poses, or a video, get them first (`nerfvol poses`), in RUN/scene."""
    appearance: Literal["auto", "on", "off"] = "auto"
    """A colour map for each photograph, for exposure and white balance that differ. auto: where exposures spread by more
    than 8 %; off: photographs are taken as they are."""
    refine_poses: bool = False
    """Move the cameras along the loss's gradient while splats are trained: for poses of phones' tracking or of few features.
    Poses of structure from motion gain nothing (docs/photographs.md)."""
    aabb: Annotated[tuple[float, float, float, float, float, float] | None, box] = None
    """The region of detail, lowest and highest corner in the units of the poses; None: worked out from the cameras."""
    holdout: Literal["own", "arc"] = "own"
    """Views that are scored and not trained on. own: the data's, or every 8th; arc: neighbours among the training views, which
    says more of views between and beside the photographs."""
    threads: Annotated[int, within(0, MOST_THREADS)] = 0
    """CPU threads; 0: all cores this process may use."""
    seed: Annotated[int, within(0, 2**63 - 1)] = 0
    """Of every random choice."""
    resume: bool = False
    """Go on from RUN's checkpoint."""
    checkpoint_every: Seconds = 30.0
    """Seconds between checkpoints."""
    storage: Literal["float32", "float16", "compact", "mapped"] = "compact"
    """How octree files hold their values: exactly, halved, quantised to about a tenth, or as the kernels read them
    (docs/file_format.md)."""
    compare_views: Count = 2
    """Held-out views on which field, distilled and fine-tuned octree are compared (a field renders slowly)."""
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    """Section: the MLP field (FieldConfig)."""
    distill: DistillConfig = dataclasses.field(default_factory=DistillConfig)
    """Section: the field's way into the octree (DistillConfig)."""
    octree: OctreeConfig = dataclasses.field(default_factory=OctreeConfig)
    """Section: the octree and its optimisation (OctreeConfig)."""
    splats: SplatConfig = dataclasses.field(default_factory=SplatConfig)
    """Section: Gaussian splats and their optimisation (config.splats)."""
    medium: MediumConfig = dataclasses.field(default_factory=MediumConfig)
    """Section: a medium under known light (config.medium)."""

    def check(self) -> None:
        """Raises InputError where ``init`` is no start of the representation; a resumed run needs its file no more."""
        if self.light is not None and self.representation not in ("auto", "medium"):
            raise InputError(
                f"--light is what a medium is fitted under, expected no --representation {self.representation}"
            )
        if self.light is None and self.representation == "medium":
            raise InputError("--representation medium needs --light FILE, what is known of the light")
        if self.resume:
            return
        known = {"octree": OCTREE_STARTS, "splats": SPLAT_STARTS, "field": (), "medium": ()}
        names = known.get(self.representation, OCTREE_STARTS + SPLAT_STARTS)
        is_file = self.representation not in ("octree", "field", "medium") and Path(self.init).exists()
        if self.init != "auto" and self.init not in names and not is_file:
            of = "" if self.representation == "auto" else f" for {self.representation}"
            or_file = (
                "" if self.representation in ("octree", "field", "medium") else " or a file of splats or an octree"
            )
            raise InputError(f"init: expected {', '.join(('auto', *names))}{or_file}{of}, got {self.init!r}")

    def for_scene(self, scene: SceneBounds) -> Config:
        """The same with a number for each setting that the kind of scene decides."""
        octree = self.octree.for_scene(scene)
        distill = filled(self.distill, {"sh_degree": octree.sh_degree}).for_scene(scene)
        sections = {"octree": octree, "distill": distill, "splats": self.splats.for_scene(scene)}
        suited = self._suited(scene)
        if self.refine_poses and suited != "splats":
            raise InputError(
                f"--refine-poses moves cameras by the gradients of splats, and what is trained is {suited}: add "
                "--representation splats, or leave it out"
            )
        return dataclasses.replace(self, **sections, representation=suited)

    def _suited(self, scene: SceneBounds) -> Literal["octree", "splats", "field", "medium"]:
        """The representation as asked for, or the one that suits the light, the start or the scene."""
        if self.light is not None:
            return "medium"
        if self.representation != "auto":
            return self.representation
        if self.init == "auto":
            return "splats" if scene.is_unbounded else "octree"
        return "octree" if self.init in OCTREE_STARTS else "splats"

    def for_views(self, n: int, scene: SceneBounds) -> Config:
        """The same with the octree's start and smoothness for ``n`` training views, where nobody chose them: of an object that
        few views show a field leaves less open than low density does (docs/experiments.md), where there is time for one;
        smoothness in any case."""
        few = self._suited(scene) == "octree" and n <= self.field.few_views and not scene.is_unbounded
        if not few:
            return self
        short = self.time_budget is not None and self.time_budget <= SHORT_RUN
        init = "mlp" if self.init == "auto" and not short else self.init
        return dataclasses.replace(self, init=init, octree=filled(self.octree, FEW_VIEWS))

    def for_pictures(self, side: int) -> Config:
        """The same with stages for pictures of ``side`` pixels along their shorter side, where nobody chose them."""
        return dataclasses.replace(self, octree=self.octree.for_pictures(side))

    def before(self, backdrop: tuple[float, float, float] | None) -> Config:
        """The same with a background: as given, else ``backdrop``, the colour that the pictures have behind, else white.

        Where opaque pictures have a backdrop, it is what is behind them, whatever is asked for.
        """
        return dataclasses.replace(self, background=backdrop or self.background or WHITE)
