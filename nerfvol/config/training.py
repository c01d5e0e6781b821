"""Everything that one training run depends on, and constants that commands share.

Settings stand apart from the modules that they steer because those import torch or numpy, which costs seconds: every command
reads the settings, few use a field. u is the scene unit.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from nerfvol.config.field import FEW_VIEWS_DISTILLED, DistillConfig, FieldConfig, FieldShape
from nerfvol.config.medium import MediumConfig
from nerfvol.config.octree import FEW_VIEWS, OctreeConfig
from nerfvol.config.octree import SceneChoices as SceneChoices
from nerfvol.config.octree import finest_level as finest_level
from nerfvol.config.parsers import Colour, Seconds, box, seconds
from nerfvol.config.splats import FEW_VIEWS as FEW_VIEWS_OF_SPLATS
from nerfvol.config.splats import SplatConfig
from nerfvol.config.values import Checked, Count, filled, within
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError

if TYPE_CHECKING:
    from nerfvol.region import SceneBounds

MOST_THREADS = 1024
"""More help on no machine, and tens of thousands are refused by the system in the middle of the work."""
SHORT_RUN = 10.0
"""Seconds of a time budget up to which an octree of an object begins with low density: distilling a field would take most of
them, and splats and their conversion too many (lego, 10 s: 22.0 instead of 24.0 dB)."""
SPLATS_UNTIL, SPLATS_UNTIL_A_PIXEL = 60.0, 0.15
"""... and from there up to which that of an object that many views show begins as splats, or up to so many seconds for each
pixel of the pictures' shorter side, whichever is later; longer runs begin with a field. Fog takes most of the time to become
surfaces (lego 400x400, 1 minute: 33.4 dB from splats, 33.4 from a field, 33.2 from fog, 2 minutes: 34.3 and 34.7 from a field;
800x800, 2 minutes: 33.6, 32.8, 32.3, 5 minutes: 35.0, 35.2, 34.7; docs/performance.md)."""
LARGE_TABLES_FROM = 45.0
"""Seconds of a time budget from which on a field that is the product has larger tables than one that becomes an octree, ..."""
LARGE_TABLES: dict[str, Any] = {"hash_log2_table": 19, "hash_max": 512}
"""... these: a step takes 1.4 times as long, and they hold details that a longer run has the time to learn (lego 400x400:
28.83 and 28.65 dB after 30 s, 29.49 and 29.63 after 60; docs/experiments.md)."""
OCTREE_STARTS = ("direct", "mlp", "splats")
SPLAT_STARTS = ("mlp", "points", "sweep", "points+sweep", "hull", "random")
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
    views or a long time budget), "splats", which are trained first, too, and whose surfaces it begins with (auto: of
    photographs with a time budget, and of other objects where it is short), or "direct", low density everywhere (auto: of all
    else, and of what may be a medium). A field: auto.
    Splats: "mlp", discs on the octree of a small field that is trained first (auto: of objects with few training views),
    "points" of a COLMAP model, "sweep" of planes through the photographs, "points+sweep", "hull" of silhouettes, "random", or a
    file or run of splats or of an octree (auto: what there is)."""
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
        names = known.get(self.representation, tuple(dict.fromkeys(OCTREE_STARTS + SPLAT_STARTS)))
        is_file = self.representation not in ("octree", "field", "medium") and Path(self.init).exists()
        if self.init != "auto" and self.init not in names and not is_file:
            of = "" if self.representation == "auto" else f" for {self.representation}"
            or_file = (
                "" if self.representation in ("octree", "field", "medium") else " or a file of splats or an octree"
            )
            raise InputError(f"init: expected {', '.join(('auto', *names))}{or_file}{of}, got {self.init!r}")

    def for_scene(self, scene: SceneBounds) -> Config:
        """The same with a number for each setting that the kind of scene decides."""
        octree = (self.octree.from_surfaces(scene) if self.init == "splats" else self.octree).for_scene(scene)
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

    def for_views(
        self, n: int, scene: SceneBounds, is_simulated: bool = False, begun: Collection[str] = (), side: int = 0
    ) -> Config:
        """The same with the start, smoothness and backgrounds of an octree or splats for ``n`` training views, where nobody
        chose them: of an object that few views show a field leaves less open than low density or a hull does
        (docs/experiments.md), where there is time for one; the others in any case. An octree of one that many views show, and
        of photographs: splats are there sooner than fog has become surfaces, and where there is more time a field; photographs
        keep haze that fog leaves for good.

        is_simulated: the data may show a medium, whose density counts: no splats, which are surfaces. begun: the phases that a
        resumed run has begun: another time budget, which it may have, must not choose another start. side: of the pictures,
        the shorter one, pixels.
        """
        suited, budget = self._suited(scene), self.time_budget
        few = self._are_few(n, scene)
        if suited not in ("octree", "splats") or suited == "splats" and not few:
            return self
        if begun:
            as_splats = suited == "octree" and "splats" in begun
            start = "mlp" if "field" in begun else "splats" if as_splats else "auto"
        elif few:
            start = "auto" if budget is not None and budget <= SHORT_RUN else "mlp"
        else:
            until = math.inf if scene.is_unbounded else max(SPLATS_UNTIL, SPLATS_UNTIL_A_PIXEL * side)
            start = "auto"
            if budget is not None and not is_simulated and (scene.is_unbounded or budget > SHORT_RUN):
                start = "splats" if budget <= until else "mlp"
        init = start if self.init == "auto" else self.init
        return dataclasses.replace(self, init=init).for_few_views(n, scene)

    def for_few_views(self, n: int, scene: SceneBounds) -> Config:
        """The same with what an octree or splats are given of an object that ``n`` training views show, where these are few and
        nobody chose it: smoothness, backgrounds and the level at which a field is distilled, whatever they begin with."""
        if not self._are_few(n, scene):
            return self
        octree, distill = filled(self.octree, FEW_VIEWS), filled(self.distill, FEW_VIEWS_DISTILLED)
        splats = filled(self.splats, FEW_VIEWS_OF_SPLATS)
        return dataclasses.replace(self, octree=octree, distill=distill, splats=splats)

    def _are_few(self, n: int, scene: SceneBounds) -> bool:
        return n <= self.field.few_views and not scene.is_unbounded

    def for_field(self, n: int, scene: SceneBounds, begun: FieldShape | None = None) -> Config:
        """The same with the tables of a field that is the product, where nobody chose them: larger ones of an object that more
        than ``field.few_views`` views show, where there is time to fill them. Photographs and few views were not compared.

        n: training views. begun: the shape of the field that a resumed run has begun, which another time budget must not
        change.
        """
        if self._suited(scene) != "field":
            return self
        shape, budget = self.field.shape, self.time_budget
        tables: dict[str, Any] = {}
        if begun is not None:
            tables = {name: getattr(begun, name) for name in LARGE_TABLES}
        elif all(getattr(shape, name) is None for name in LARGE_TABLES):
            is_long = budget is not None and budget >= LARGE_TABLES_FROM
            tables = LARGE_TABLES if is_long and n > self.field.few_views and not scene.is_unbounded else {}
        settled = filled(shape, tables).settled()
        return dataclasses.replace(self, field=dataclasses.replace(self.field, shape=settled))

    def for_pictures(self, side: int) -> Config:
        """The same with stages for pictures of ``side`` pixels along their shorter side, where nobody chose them."""
        return dataclasses.replace(self, octree=self.octree.for_pictures(side))

    def before(self, backdrop: tuple[float, float, float] | None) -> Config:
        """The same with a background: as given, else ``backdrop``, the colour that the pictures have behind, else white.

        Where opaque pictures have a backdrop, it is what is behind them, whatever is asked for.
        """
        return dataclasses.replace(self, background=backdrop or self.background or WHITE)
