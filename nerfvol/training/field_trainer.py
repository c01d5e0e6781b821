"""Training of a radiance field from posed images: rays -> samples -> field -> quadrature -> loss, step by step.

Every random number of step k comes from (seed, k), and all that lives between steps is in ``FieldTrainer.state_dict``:
a run that was stopped and resumed gives the same numbers as one that was not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nerfvol.config.field import FieldConfig
from nerfvol.errors import InputError
from nerfvol.field.fields import AtPoints, make_field
from nerfvol.field.occupancy import OccupancyGrid, OccupiedField, Samples, StepSchedule
from nerfvol.field.rendering import importance_samples, render_field, shade
from nerfvol.field.sampling import intersect_aabb, step_generator
from nerfvol.quadrature import Composite, accumulate
from nerfvol.training.field_phase import FIELD_SHARE, SECONDS_TO_DISTILL, FieldReport, domain_of, near_plane_of
from nerfvol.training.pixel_bank import PixelBank

if TYPE_CHECKING:
    from nerfvol.cameras.camera import Camera
    from nerfvol.datasets.dataset import Dataset

MOST_RAYS = 8192
"""Of one step, while most of space is known to be empty."""


class FieldTrainer:
    """Trains one field on one dataset, a step at a time; a phase (training.phase.Phase).

    Args:
        dataset: posed images.
        config: see ``FieldConfig``.
        seed: all randomness.
        background: RGB that images with alpha are composited on and that lies behind the field.
    """

    def __init__(
        self, dataset: Dataset, config: FieldConfig, seed: int = 0, background: Sequence[float] = (1.0, 1.0, 1.0)
    ) -> None:
        self.dataset, self.config, self.seed = dataset, config, seed
        self.background = torch.tensor(background, dtype=torch.float32)
        self.domain = domain_of(dataset.scene)
        self.field = make_field(self.domain, config.shape, seed)
        self.grid = OccupancyGrid(self.domain, config.grid_resolution)
        self.schedules = [StepSchedule(self.domain, n) for n in config.march_steps]
        self.schedule = self.schedules[-1]
        self.optimizer = torch.optim.Adam(
            self.field.parameters(), lr=config.rate, betas=(0.9, 0.99), eps=1e-15, fused=True
        )
        self.steps_done, self.stage = 0, 0  # an image scale is no stage: nothing else changes with it
        self.n_rays = max(1, min(MOST_RAYS, int(config.samples_per_step / (self._importance_samples or 64))))
        self._banks: dict[int, PixelBank] = {}

    # ------------------------------------------------------------------ what a run asks of a phase
    name = "field"
    rates = "field.rate"
    previews = (0.1, 0.4, 1.0)
    preview_width = 100  # a field renders slowly
    timed_at = 8
    stages_left = 0
    most_steps = math.inf

    @property
    def _importance_samples(self) -> int:
        """Of each ray with the importance sampler; 0 with the other, where they are as many as there is occupied space."""
        return self.config.n_coarse + self.config.n_fine if self.config.sampler == "importance" else 0

    @property
    def steps(self) -> int:
        """Of the whole schedule without a time budget."""
        return self.config.steps

    @property
    def parameter_bytes(self) -> int:
        """Bytes of the network."""
        return sum(p.numel() * p.element_size() for p in self.field.parameters())

    def share_of(self, seconds: float) -> float:
        """``field.time_budget``, and at most FIELD_SHARE: an octree must follow."""
        return min(self.config.time_budget, FIELD_SHARE * seconds)

    def size(self) -> str:
        """See Phase."""
        return f"{self.parameter_bytes // 4:,} parameters"

    def seconds_to_write(self) -> float:
        """Distilling comes first."""
        return SECONDS_TO_DISTILL

    def needs_images(self) -> bool:
        """The octree will."""
        return True

    def outgrown(self) -> str | None:
        """A field does not grow."""
        return None

    def outcome(self) -> str | None:
        """What a field could still learn is not known."""
        return None

    def picture(self, camera: Camera) -> np.ndarray:
        """(height, width, 3) float32 image of the field as ``camera`` sees it."""
        rays_o, rays_d = (torch.from_numpy(rays) for rays in camera.rays())
        shape = (camera.intrinsics.height, camera.intrinsics.width, 3)
        return self.render(rays_o, rays_d)["rgb"].numpy().reshape(shape)

    # ------------------------------------------------------------------ training
    def find_samples(self, rays_o: Tensor, rays_d: Tensor, generator: torch.Generator | None = None) -> Samples:
        """Where to look along rays_o, rays_d (n, 3), scene units and unit directions: packed samples.

        Jittered with a generator, the middles without.
        """
        near_plane = near_plane_of(self.domain)
        if self.config.sampler == "importance":
            near, far = intersect_aabb(rays_o, rays_d, self.domain.aabb)
            near = near.clamp(min=near_plane)
            span, counts = (near, torch.maximum(near, far)), (self.config.n_coarse, self.config.n_fine)
            return importance_samples(self.field, rays_o, rays_d, span, counts, generator)
        jitter = None if generator is None else torch.rand(len(rays_o), generator=generator)
        return self.grid.march(rays_o, rays_d, self.schedule, near_plane, jitter)

    def trained_field(self) -> AtPoints:
        """The field without what it holds in space that training skips: what is to be rendered or distilled."""
        return AtPoints(OccupiedField(self.field, self.grid) if self.config.sampler == "occupancy" else self.field)

    def render(self, rays_o: Tensor, rays_d: Tensor, chunk: int = 4096) -> dict[str, Tensor]:
        """``render_field`` of the field as it is now: rgb (n, 3), opacity (n,), depth (n,).

        rays_o: (n, 3) or (3,), rays_d: (n, 3) unit; ``chunk`` rays at a time.
        """
        return render_field(self.field, rays_o, rays_d, self.background.tolist(), self.find_samples, chunk)

    def step(self, progress: float | None = None) -> FieldReport:
        """One optimisation step.

        Args:
            progress: how much of the run is over, 0 to 1; None = steps done / ``config.steps``.

        """
        config = self.config
        progress = min(1.0, self.steps_done / config.steps if progress is None else progress)
        generator = step_generator(self.seed, self.steps_done)
        self._set_rate(progress)
        stage = config.stage_at(progress)
        bank, self.schedule = self._bank(stage), self.schedules[stage]
        rays_o, rays_d, target = bank.sample(self.n_rays, generator)
        samples = self.find_samples(rays_o, rays_d, generator)
        with torch.autocast("cpu", torch.bfloat16, enabled=config.bfloat16):
            sigmas, rgb, parts = shade(self.field, samples, rays_o, rays_d)
        colour = accumulate(parts.weights, rgb, samples.ray_indices, self.n_rays)
        error = (colour + parts.trans_final[:, None] * self.background - target).square().mean()
        loss = error + self._regularisers(rgb, parts, samples, target, generator)
        self.optimizer.zero_grad(set_to_none=True)
        if loss.requires_grad and len(sigmas):
            loss.backward()
            self.optimizer.step()
        self.steps_done += 1
        n_rays = self.n_rays
        self._update_grid(samples, rays_o, rays_d, sigmas, generator)
        self._follow_samples(len(sigmas))
        return FieldReport(
            squared_error=float(error.detach()), samples=len(sigmas) / n_rays, loss=float(loss.detach()), n_rays=n_rays,
            downscale=config.downscales[stage],
        )  # fmt: skip

    def _regularisers(
        self, rgb: Tensor, parts: Composite, samples: Samples, target: Tensor, generator: torch.Generator
    ) -> Tensor:
        config, total = self.config, torch.zeros(())
        if config.colour_weight > 0:
            apart = (rgb - target[samples.ray_indices]).square().mean(-1)
            behind = (self.background - target).square().mean(-1)
            own = (parts.weights * apart).sum() + (parts.trans_final * behind).sum()
            total = total + config.colour_weight * own / len(target)
        if config.sparsity_weight > 0:
            aabb = self.domain.aabb
            points = aabb[0] + (aabb[1] - aabb[0]) * torch.rand(1024, 3, generator=generator)
            opacity = -torch.expm1(-self.field.density(points) * self.schedule.step_size)
            total = total + config.sparsity_weight * opacity.mean()
        return total

    def _update_grid(
        self, samples: Samples, rays_o: Tensor, rays_d: Tensor, sigmas: Tensor, generator: torch.Generator
    ) -> None:
        if self.config.sampler != "occupancy":
            return
        self.grid.update(samples.positions(rays_o, rays_d), sigmas)
        if self.steps_done % 16 == 0:
            self.grid.probe(self.field.density, 16384, generator)
            self.grid.refresh()
            self.grid.check_not_empty()

    def _follow_samples(self, n_samples: int) -> None:
        """Choose the next number of rays so that a step has about ``samples_per_step`` samples."""
        per_ray = n_samples / self.n_rays
        if self._importance_samples:
            per_ray = float(self._importance_samples)
        wanted = self.config.samples_per_step / max(per_ray, 1.0)
        self.n_rays = max(1, min(MOST_RAYS, int(min(wanted, 1.25 * self.n_rays + 16))))

    def _bank(self, stage: int) -> PixelBank:
        downscale = self.config.downscales[stage]
        if downscale not in self._banks:
            self._banks = {downscale: PixelBank(self.dataset, self.background.tolist(), downscale)}
        return self._banks[downscale]

    def _set_rate(self, progress: float) -> None:
        warm = min(1.0, (self.steps_done + 1) / 20)
        decay = self.config.rate_decay ** max(0.0, (progress - 1 / 3) * 1.5)
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.rate * warm * decay

    def state_dict(self) -> dict[str, Any]:
        """Everything that lives between steps, as tensors and numbers."""
        return {
            "field": self.field.state_dict(),
            "optimizer": {k: dict(v) for k, v in self.optimizer.state_dict()["state"].items()},
            "grid": self.grid.state_dict(),
            "steps_done": self.steps_done,
            "n_rays": self.n_rays,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Inverse of ``state_dict``; InputError where the state is of another network."""
        try:
            self.field.load_state_dict(state["field"])
        except (RuntimeError, KeyError) as error:
            raise InputError(f"the checkpoint's field does not fit the configured network: {error}") from error
        moments = {int(k): dict(v) for k, v in state["optimizer"].items()}
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": moments})
        self.grid.load_state_dict(state["grid"])
        self.steps_done, self.n_rays = int(state["steps_done"]), int(state["n_rays"])
