"""A phase: something that a training run optimises, step by step. The trainers are phases; a run may have several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.kernels.state import StepReport
from nerfvol.models import Model
from nerfvol.training.appearance import Appearance


class Phase(Protocol):
    """What a run asks of a trainer; ``steps_done`` are its own optimiser steps, ``stage`` its resolution step, from 0."""

    steps_done: int
    stage: int

    @property
    def name(self) -> str:
        """One of ``field``, ``octree``, ``splats`` and ``medium``."""
        ...

    @property
    def rates(self) -> str:
        """The settings to lower where it diverges, as a sentence names them."""
        ...

    @property
    def steps(self) -> int:
        """Optimiser steps of the whole schedule without a time budget."""
        ...

    @property
    def most_steps(self) -> float:
        """Steps at which a run with a time budget ends early; infinity: at none."""
        ...

    @property
    def previews(self) -> Sequence[float]:
        """Moments of progress in [0, 1] at which a picture is written."""
        ...

    @property
    def preview_width(self) -> int:
        """Width of that picture, pixels."""
        ...

    @property
    def timed_at(self) -> int:
        """Factor by which a picture is reduced where it is drawn to learn what a whole one takes: the factor's square times as
        long. 1 where other things than pixels count."""
        ...

    @property
    def stages_left(self) -> int:
        """Stages after the present one."""
        ...

    def share_of(self, seconds: float) -> float:
        """How many of the ``seconds`` left before the end of a run the phase may take."""
        ...

    def step(self, progress: float) -> StepReport:
        """One optimisation step at ``progress`` in [0, 1]."""
        ...

    def picture(self, camera: Camera) -> np.ndarray:
        """(H, W, 3) as the camera sees it."""
        ...

    def size(self) -> str:
        """How large the representation is, in words."""
        ...

    def seconds_to_write(self) -> float:
        """Seconds that finishing, writing and reading the product will take."""
        ...

    def needs_images(self) -> bool:
        """Whether the training images will be asked for again."""
        ...

    def outgrown(self) -> str | None:
        """A sentence where the representation needs more memory than was announced."""
        ...

    def outcome(self) -> str | None:
        """Once the steps are over, a sentence on what they went into and whether more would pay; None: there is none."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that an exact continuation needs: arrays, numbers and strings."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state``; InputError, LookupError, TypeError or ValueError where it does not fit."""
        ...


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """Training photographs by name, their refined poses (n, 4, 4) in the frame that is trained in, and by how many pixels what
    they show moved, (n,)."""

    names: list[str]
    poses: NDArray[np.float64]
    pixels: NDArray[np.float64]


class FinalPhase(Phase, Protocol):
    """A phase whose product is the run's: the last one. ``appearance``: the photographs' colour maps."""

    appearance: Appearance

    def seen(self, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A small picture of training view i as it was taken (h, w, 3), as the model shows it, both in [0, 1], and the
        pixels' weights (h, w)."""
        ...

    def refined(self) -> RefinedPoses | None:
        """Where the cameras are in the end; None where they stayed."""
        ...

    def take_model(self, metadata: dict[str, Any]) -> Model:
        """The finished model; everything else is released."""
        ...
