"""A phase: something that a training run optimises, step by step. The trainers are phases; a run may have several."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.kernels.state import StepReport
from nerfvol.models import Model


class Phase(Protocol):
    """What a run asks of a trainer.

    name: "field", "octree". rates: the settings to lower where it diverges. steps: of the whole schedule without a time
    budget. most_steps: at which a run with a budget ends early. previews: moments of progress at which a picture of
    ``preview_width`` pixels is written.
    """

    steps_done: int
    stage: int

    @property
    def name(self) -> str: ...

    @property
    def rates(self) -> str: ...

    @property
    def steps(self) -> int: ...

    @property
    def most_steps(self) -> float: ...

    @property
    def previews(self) -> Sequence[float]: ...

    @property
    def preview_width(self) -> int: ...

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
        """Seconds that writing and reading the product will take."""
        ...

    def needs_images(self) -> bool:
        """Whether the training images will be asked for again."""
        ...

    def outgrown(self) -> str | None:
        """A sentence where the representation needs more memory than was announced."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Everything that an exact continuation needs: arrays, numbers and strings."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from ``state``; InputError, LookupError, TypeError or ValueError where it does not fit."""
        ...


class FinalPhase(Phase, Protocol):
    """A phase whose product is the run's: the last one."""

    def take_model(self, metadata: dict[str, Any]) -> Model:
        """The finished model; everything else is released."""
        ...
