"""Optimising Gaussian splats: small photographs first, one whole view a step, splitting where the error is, pruning.

Sources: 3D Gaussian splatting, Kerbl et al. 2023; the anti-aliased opacity of Mip-Splatting, Yu et al. 2024; splitting by error
to a planned number, as in Taming 3DGS, Mallick et al. 2024. The rates are our own: a run on a CPU has thousands of steps
where theirs has tens of thousands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.motions import Motions
from nerfvol.config.splats import SplatConfig
from nerfvol.datasets.photographs import Photographs
from nerfvol.errors import InputError
from nerfvol.kernels import splat_ops
from nerfvol.kernels.splat_state import SplatOptions, SplatRates, SplatState, view_of
from nerfvol.kernels.state import StepReport
from nerfvol.measure.pose_fit import REFINED
from nerfvol.splats.packing import LOGIT
from nerfvol.splats.splats import Splats
from nerfvol.splats.turn import similar
from nerfvol.training.appearance import Appearance, fitting_factor
from nerfvol.training.backgrounds import is_second
from nerfvol.training.phase import RefinedPoses
from nerfvol.training.splat_schedule import Schedule, saved_schedule
from nerfvol.views import SplatModel

VIEWS, SPLITS = 3, 4
"""Streams of random numbers; octree training has 0 to 2."""
NEAR_SHARE = 0.02
"""Of the subject's distance: what is nearer to a camera is not drawn."""
SECONDS_TO_WRITE = 0.3
SECOND_EVERY = 4
"""Steps of which one is before the second background: a whole view tells of all that is open in it, and pictures before the
first are what most people look at (with every second step these lose 0.1 to 0.8 dB more, docs/experiments.md)."""
MOTION_PIXELS, MOTION_DECAY = 0.4, 0.1
"""Pixels of the present pictures by which a refined camera moves a visit, and the factor at the end: small pictures first,
which see far, then fine ones."""
MOTION_FROM = 0.15
"""Share of progress from which on cameras move, not before every photograph was seen once: fog tells them nothing, and moves
exact poses for as long as it is there."""


class SplatTrainer:
    """Optimises splats on photographs; a phase (training.phase.Phase). ``progress`` runs from 0 to 1 and drives everything."""

    name = "splats"
    rates = "splats.rate_means, splats.rate_scales and splats.rate_logits"
    previews = (0.03, 0.1, 0.3, 0.6, 1.0)
    preview_width = 400
    timed_at = 1
    most_steps = math.inf

    def __init__(
        self,
        photographs: Photographs,
        splats: Splats,
        config: SplatConfig,
        schedule: Schedule,
        subject_distance: float,
        background: Sequence[float],
        seed: int = 0,
        appearance: Appearance | None = None,
        refine_poses: bool = False,
    ) -> None:
        """``config`` with a number for each None; ``subject_distance``: the median camera's, scene units; ``appearance``: of
        the photographs (default: they stay as they are); ``refine_poses``: cameras move along the loss's gradient."""
        self.photographs, self.config, self.schedule, self.seed = photographs, config, schedule, seed
        self.background = (float(background[0]), float(background[1]), float(background[2]))
        self.subject_distance = subject_distance
        self.appearance = appearance or Appearance(len(photographs), "off")
        self.motions = Motions(photographs.cameras, subject_distance) if refine_poses else None
        self.state = SplatState(splats)
        self.started_with = self.state.n
        self.steps = config.steps
        self.steps_done, self.stage, self.stage_began = 0, 0, 0
        self.seen_since = 0  # steps since what was not seen was last asked for
        self.growing = True  # until the first round after growth ends, which brings their number to the planned one

    # ------------------------------------------------------------------ what a run asks of a phase
    @property
    def stages_left(self) -> int:
        """See Phase."""
        return len(self.schedule.factors) - 1 - self.stage

    def share_of(self, seconds: float) -> float:
        """All of the time left."""
        return seconds

    def picture(self, camera: Camera) -> np.ndarray:
        """(H, W, 3) as the camera sees the splats."""
        return SplatModel(self.state.packed, self.metadata()).render(camera, self.background)["rgb"]

    def metadata(self) -> dict[str, Any]:
        """What drawing needs besides the splats."""
        return {"near": NEAR_SHARE * self.subject_distance}

    def size(self) -> str:
        """See Phase."""
        return f"{self.state.n:,} splats"

    def seconds_to_write(self) -> float:
        """See Phase."""
        return SECONDS_TO_WRITE

    def needs_images(self) -> bool:
        """The photographs hold them: released, they would be read a second time for the table of photographs."""
        return True

    def outgrown(self) -> str | None:
        """The number of splats is bounded before the start."""
        return None

    def outcome(self) -> str | None:
        """What splats could still learn is not known."""
        return None

    def state_dict(self) -> dict[str, Any]:
        """Everything an exact continuation needs."""
        return {
            **self.state.arrays(), "stage": self.stage, "steps_done": self.steps_done, "stage_began": self.stage_began,
            "started_with": self.started_with, "steps_of_stages": list(self.schedule.steps),
            "seen_since": self.seen_since, "growing": self.growing, "factors": list(self.schedule.factors),
            "ends": list(self.schedule.ends),
            "most": self.schedule.most, "grown": self.schedule.grown, "subject_distance": self.subject_distance,
            "appearance": self.appearance.state_dict(),
        } | ({} if self.motions is None else {"motions": self.motions.state_dict()})  # fmt: skip

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from :meth:`state_dict` as if nothing had happened."""
        self.state = SplatState.from_arrays(state)
        for name in ("stage", "stage_began", "steps_done", "started_with", "seen_since"):
            setattr(self, name, int(state[name]))
        self.growing = bool(state.get("growing", True))  # checkpoints of earlier versions have none
        self.schedule = saved_schedule(state)
        self.subject_distance = float(state["subject_distance"])
        self.appearance.load_state_dict(state["appearance"])
        if self.motions is not None:
            self.motions.load_state_dict(state["motions"])
        if not 0 <= self.stage < len(self.schedule.factors) or min(self.steps_done, self.seen_since) < 0:
            raise ValueError(f"stage {self.stage} and step {self.steps_done} are not in its schedule")
        if min(self.state.n, self.started_with) < 1 or not 0 < self.subject_distance < math.inf:
            raise ValueError(f"{self.state.n} splats, begun with {self.started_with}, at {self.subject_distance}")

    # ------------------------------------------------------------------ the schedule
    def step(self, progress: float) -> StepReport:
        """One view at ``progress`` in [0, 1] of the run."""
        while self.schedule.is_over(self.stage, progress, self.steps_done - self.stage_began):
            self.photographs.drop(self.schedule.factors[self.stage])
            self.stage, self.stage_began = self.stage + 1, self.steps_done
        if self.steps_done and self.steps_done % self.schedule.grow_every(self.config.grow_every) == 0:
            self.grow(progress)
        if self.appearance.due(progress):
            self.fit_appearance(progress)
        index = self._next_view()
        second = is_second(self.photographs.second, self.steps_done, SECOND_EVERY)
        view = self.photographs.view(index, self.schedule.factors[self.stage], second)
        near = NEAR_SHARE * self.subject_distance
        report = splat_ops.train_step(
            self.state,
            view_of(self._placed(index, view.camera), self.state.origin, near),
            self.appearance.corrected(index, view.image),
            self._options(second),
            self._rates(progress),
            self.motions is not None,
        )
        if self.motions is not None and progress >= MOTION_FROM and self.steps_done >= len(self.photographs):
            self.motions.step(
                index, report.motion or (), view.camera.intrinsics, MOTION_PIXELS * MOTION_DECAY**progress
            )
        self.steps_done += 1
        self.seen_since += 1
        pixels = view.image.shape[0] * view.image.shape[1]
        return StepReport(report.squared_error, 16 * report.blocks / pixels)

    def _placed(self, i: int, camera: Camera) -> Camera:
        """The camera of photograph i where it is now."""
        return camera if self.motions is None else self.motions.camera(i, camera)

    def fit_appearance(self, progress: float) -> None:
        """Fits the photographs' colour maps to what the splats show of small pictures of them."""
        held = self.photographs.held
        self.appearance.fit(self.seen, progress)
        for factor in self.photographs.held - held:
            self.photographs.drop(factor)

    def seen(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See FinalPhase."""
        canvas = self.photographs.cameras[i].intrinsics
        view = self.photographs.view(i, fitting_factor(canvas.width, canvas.height))
        values = view.image.astype(np.float32) / 255
        return values[..., :3], self.picture(self._placed(i, view.camera)), values[..., 3]

    def refined(self) -> RefinedPoses | None:
        """See FinalPhase."""
        if self.motions is None:
            return None
        lenses = [camera.intrinsics for camera in self.photographs.cameras]
        return RefinedPoses(list(self.photographs.names), self.motions.put_back(), self.motions.pixels(lenses))

    def _next_view(self) -> int:
        """Seed-shuffled epochs."""
        epoch, position = divmod(self.steps_done, len(self.photographs))
        random = np.random.Generator(np.random.Philox(np.random.SeedSequence([self.seed, VIEWS, epoch])))
        return int(random.permutation(len(self.photographs))[position])

    def _options(self, second: bool) -> SplatOptions:
        c = self.config
        scale = c.scale / self.subject_distance
        behind = self.photographs.second if self.photographs.second and second else self.background
        return SplatOptions(behind, ssim=c.ssim or 0.0, scale=scale, early_stop_eps=c.early_stop_eps)

    def _rates(self, progress: float) -> SplatRates:
        c = self.config
        assert (
            c.rate_means is not None and c.rate_scales is not None and c.beta2 is not None
        )  # see SplatConfig.for_scene
        fade = (c.rate_decay or 1.0) ** progress
        return SplatRates(
            means=c.rate_means * (c.rate_decay_means or 1.0) ** progress, log_scales=c.rate_scales * fade,
            quats=c.rate_quats * fade, logits=c.rate_logits * fade, dc=c.rate_dc * fade, sh=c.rate_sh * fade, beta2=c.beta2,
            most_log_ratio=math.log(c.most_ratio),
        )  # fmt: skip

    def grow(self, progress: float) -> None:
        """Removes what is nearly transparent or in no photograph, and splits what holds the error, up to the plan."""
        state = self.state
        keep = _opacity(state.row(LOGIT)) >= self.config.prune_opacity
        if self._all_were_asked():
            keep &= state.per_splat("seen") > 0
            self.seen_since = 0
            state.seen[...] = 0
        if not keep.any():
            raise InputError(
                f"the splats collapsed to empty space at step {self.steps_done}: no photograph needs any of them; check "
                "that the poses belong to the photographs, or choose another start (--init)"
            )
        if not keep.all():
            state.prune(keep)
        wanted = self.schedule.planned(self.started_with, progress) - state.n if self.growing else 0
        self.growing = progress < self.schedule.grown
        state.grow(
            wanted, np.random.Generator(np.random.Philox(np.random.SeedSequence([self.seed, SPLITS, self.steps_done])))
        )
        state.reorder()

    def _all_were_asked(self) -> bool:
        """Whether a whole epoch passed since ``seen`` was reset: rounds do not begin where epochs do."""
        n = len(self.photographs)
        first = -(-(self.steps_done - self.seen_since) // n) * n
        return first + n <= self.steps_done

    def take_model(self, metadata: dict[str, Any]) -> SplatModel:
        """The splats without those that are nearly transparent; of refined poses, where the given ones put the scene."""
        splats, own = self.state.splats(), self.metadata()
        seen = _opacity(splats.logits) >= self.config.prune_opacity
        splats = splats.select(seen) if seen.any() else splats
        if self.motions is not None:
            scale, rotation, shift = self.motions.back()
            splats = similar(splats, scale, rotation, shift)
            own = {"near": own["near"] * scale, REFINED: self.subject_distance * scale}
        return SplatModel(splats, {**metadata, **own})


def _opacity(logits: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-logits.astype(np.float64)))
