"""Fitting extinction and albedo of a medium to pictures under known suns: coarse to fine, in torch.

Every random number of step k comes from (seed, k), and all that lives between steps is in ``state_dict``.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate, softplus

from nerfvol.config.medium import MediumConfig
from nerfvol.errors import InputError
from nerfvol.kernels.state import StepReport
from nerfvol.medium.lighting import Lighting
from nerfvol.medium.model import MediumModel
from nerfvol.medium.transport import Medium, displayed, receive
from nerfvol.training.appearance import Appearance, small_picture

if TYPE_CHECKING:
    from nerfvol.cameras.camera import Camera
    from nerfvol.datasets.dataset import Dataset

SATURATED = 254.5 / 255
"""A channel of a picture from here on says that there is at least so much."""
SECONDS_TO_WRITE = 1.0


class LitPixels:
    """All training pixels, by the light that they were taken under: rays, straight colours and alphas."""

    def __init__(self, dataset: Dataset) -> None:
        views = defaultdict(list)
        for i, camera in enumerate(dataset.cameras):
            views[camera.light].append(i)
        self.lights = list(views)
        self._of = {light: self._columns(dataset, numbers) for light, numbers in views.items()}

    @staticmethod
    def _columns(dataset: Dataset, numbers: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
        """Origins and directions (n, 3), and straight colours with alpha (n, 4), uint8, of all pixels that count."""
        columns = []
        for i in numbers:
            image, mask = dataset.images[i], dataset.mask(i)
            o, d = dataset.cameras[i].rays()
            pixels = image.reshape(-1, image.shape[2])
            if pixels.shape[1] == 3:
                pixels = np.concatenate([pixels, np.full((len(pixels), 1), 255, np.uint8)], 1)
            kept = slice(None) if mask is None else mask.reshape(-1) > 127
            columns.append((np.broadcast_to(o, d.shape)[kept], d[kept], pixels[kept]))
        o, d, pixels = (torch.from_numpy(np.concatenate(parts)) for parts in zip(*columns, strict=True))
        return o, d, pixels

    def sample(self, light: str | None, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """n random pixels under a light: origins, directions (n, 3), straight colours with alpha (n, 4) in [0, 1]."""
        o, d, pixels = self._of[light]
        chosen = torch.randint(len(o), (n,), generator=generator)
        return o[chosen], d[chosen], pixels[chosen].to(torch.float32) / 255


class MediumTrainer:
    """Fits a medium to one dataset, a step at a time; a phase (training.phase.Phase).

    Args:
        dataset: posed images with alpha; cameras name their light.
        lighting: what is known of the light.
        config: see ``MediumConfig``.
        seed: all randomness.
        background: RGB that previews lie on.
    """

    name = "medium"
    rates = "medium.rate"
    previews = (0.1, 0.4, 1.0)
    preview_width = 200
    timed_at = 1
    most_steps = math.inf

    def __init__(
        self, dataset: Dataset, lighting: Lighting, config: MediumConfig, seed: int = 0,
        background: Sequence[float] = (1.0, 1.0, 1.0),
    ) -> None:  # fmt: skip
        for camera in dataset.cameras:
            lighting.of(camera.light)
        self.dataset, self.lighting, self.config, self.seed = dataset, lighting, config, seed
        self.background, self.appearance = background, Appearance(len(dataset), "off")
        lo, hi = dataset.scene.aabb
        self.lo, self.hi = torch.tensor(lo, dtype=torch.float32), torch.tensor(hi, dtype=torch.float32)
        self.pixels = LitPixels(dataset)
        self.steps_done, self.stage = 0, 0
        shape = self._shape(0)
        # softplus(raw) is the optical depth of a vertex's distance
        first = math.log(math.expm1(config.first_depth / max(shape)))
        albedo = math.log(config.first_albedo / (1 - config.first_albedo))
        self.density = torch.full(shape, first, requires_grad=True)
        self.albedo = torch.full((3, *shape), albedo, requires_grad=True)
        self.optimizer = self._new_optimizer()

    def _new_optimizer(self) -> torch.optim.Adam:
        return torch.optim.Adam([self.density, self.albedo], lr=self.config.rate, betas=(0.9, 0.99), eps=1e-12)

    def _shape(self, stage: int) -> tuple[int, int, int]:
        extent = (self.hi - self.lo).tolist()
        voxel = max(extent) / (self.config.resolutions[stage] - 1)
        counts = [max(2, round(side / voxel) + 1) for side in extent]
        return counts[0], counts[1], counts[2]

    # ------------------------------------------------------------------ what a run asks of a phase
    @property
    def steps(self) -> int:
        """Of the whole schedule without a time budget."""
        return self.config.steps

    @property
    def stages_left(self) -> int:
        """Stages after the present one."""
        return len(self.config.resolutions) - 1 - self.stage

    def share_of(self, seconds: float) -> float:
        """All of them."""
        return seconds

    def size(self) -> str:
        """See Phase."""
        return "x".join(map(str, self.density.shape)) + " vertices"

    def seconds_to_write(self) -> float:
        """A grid is small."""
        return SECONDS_TO_WRITE

    def needs_images(self) -> bool:
        """All pixels are at hand as rays."""
        return False

    def outgrown(self) -> str | None:
        """Its memory follows from the settings."""
        return None

    def outcome(self) -> str | None:
        """What a medium could still learn is not known."""
        return None

    def medium(self) -> Medium:
        """The medium as it is; differentiable in the parameters."""
        side = float((self.hi - self.lo).max()) / (max(self.density.shape) - 1)
        return Medium(softplus(self.density) / side, torch.sigmoid(self.albedo), self.lo, self.hi)

    def picture(self, camera: Camera) -> np.ndarray:
        """(height, width, 3) float32 image of the medium as ``camera`` sees it."""
        return self.take_model({}).render(camera, self.background)["rgb"]

    def seen(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See FinalPhase."""
        return small_picture(self.dataset, i, self.picture)

    def refined(self) -> None:
        """The cameras stay."""

    def take_model(self, metadata: dict[str, Any]) -> MediumModel:
        """The medium as it is."""
        with torch.no_grad():
            medium = self.medium()
        arrays = medium.sigma_t.numpy().copy(), medium.albedo.movedim(0, -1).contiguous().numpy()
        box = np.stack([self.lo.double().numpy(), self.hi.double().numpy()])
        return MediumModel(*arrays, box, self.lighting, metadata)

    # ------------------------------------------------------------------ training
    def step(self, progress: float) -> StepReport:
        """One optimisation step."""
        config = self.config
        while self.stage < config.stage_at(progress):
            self._refine()
        generator = torch.Generator().manual_seed(self.seed * 0x9E3779B1 + self.steps_done)
        for group in self.optimizer.param_groups:
            group["lr"] = config.rate * config.rate_decay**progress
        medium = self.medium()
        step = config.step_voxels * float(medium.voxel.max())
        order = torch.randperm(len(self.pixels.lights), generator=generator)[: config.lights].tolist()
        n, error, loss = max(1, config.rays // len(order)), 0.0, self._smoothness(medium)
        for k in order:
            light = self.pixels.lights[k]
            o, d, truth = self.pixels.sample(light, n, generator)
            jitter = torch.rand(n, generator=generator)
            received = receive(medium, (o, d), self.lighting.of(light), self.lighting.phase, step, jitter)
            difference = self._difference(displayed(received, self.lighting.exposure), received.opacity, truth)
            loss = loss + difference.square().mean() / len(order)
            error += float(difference[:, :3].detach().square().mean()) / len(order)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.steps_done += 1
        return StepReport(squared_error=error, samples=float(n * len(order)))

    def _difference(self, colour: Tensor, opacity: Tensor, truth: Tensor) -> Tensor:
        """(n, 4) of premultiplied colours and alpha: what is left over every background. Pictures cut off what is brighter
        than white, so there only too little is an error."""
        cut = (truth[:, :3] >= SATURATED) & (colour > 1)
        seen = torch.where(cut, torch.ones_like(colour), colour)
        alpha = truth[:, 3:]
        return torch.cat([opacity[:, None] * seen - alpha * truth[:, :3], opacity[:, None] - alpha], 1)

    def _smoothness(self, medium: Medium) -> Tensor:
        config, total = self.config, torch.zeros(())
        for axis in (1, 2, 3):
            if config.smooth_albedo > 0:
                total = total + config.smooth_albedo * medium.albedo.diff(dim=axis).square().mean()
            if config.smooth_density > 0:
                total = total + config.smooth_density * softplus(self.density).diff(dim=axis - 1).square().mean()
        return total

    def _refine(self) -> None:
        """The next stage's grid: the same medium between the vertices."""
        self.stage += 1
        shape, before = self._shape(self.stage), max(self.density.shape) - 1
        with torch.no_grad():
            depth = softplus(self.density) * before / (max(shape) - 1)
            depth = interpolate(depth[None, None], shape, mode="trilinear", align_corners=True)[0, 0]
            albedo = interpolate(self.albedo[None], shape, mode="trilinear", align_corners=True)[0]
            self.density = torch.log(torch.expm1(depth).clamp(min=1e-9)).requires_grad_()
        self.albedo = albedo.detach().requires_grad_()
        self.optimizer = self._new_optimizer()

    def state_dict(self) -> dict[str, Any]:
        """Everything that lives between steps, as arrays and numbers."""
        moments = self.optimizer.state_dict()["state"]
        arrays = {f"{key}_{k}": row[key].numpy() for k, row in moments.items() for key in ("exp_avg", "exp_avg_sq")}
        own = {"density": self.density.detach().numpy(), "albedo": self.albedo.detach().numpy()}
        counted = float(moments[0]["step"]) if moments else 0.0
        return {**own, **arrays, "steps_done": self.steps_done, "stage": self.stage, "counted": counted}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of ``state_dict``; InputError where the state is of another grid."""
        stage = int(state["stage"])
        if not 0 <= stage < len(self.config.resolutions) or state["density"].shape != self._shape(stage):
            raise InputError("the checkpoint's medium does not fit the configured resolutions")
        self.stage, self.steps_done = stage, int(state["steps_done"])
        self.density = torch.from_numpy(state["density"].copy()).requires_grad_()
        self.albedo = torch.from_numpy(state["albedo"].copy()).requires_grad_()
        self.optimizer = self._new_optimizer()
        if "exp_avg_0" in state:
            rows = {
                k: {"step": torch.tensor(float(state["counted"]))}
                | {key: torch.from_numpy(state[f"{key}_{k}"].copy()) for key in ("exp_avg", "exp_avg_sq")}
                for k in range(2)
            }
            groups = self.optimizer.state_dict()["param_groups"]
            self.optimizer.load_state_dict({"state": rows, "param_groups": groups})
