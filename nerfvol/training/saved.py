"""Reading a run's checkpoint: what a continuation looks up in it is there, and is what it must be."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from nerfvol.config.assemble import assemble
from nerfvol.config.field import FieldShape
from nerfvol.errors import InputError, shown
from nerfvol.files.checkpoint import load_checkpoint

PHASES = ("field", "octree", "splats", "medium", "done")
_STATE = {
    "elapsed": float, "phase_started": float, "running": float, "log_bytes": int, "results": dict, "steps": dict,
    "trainer": dict,
}  # fmt: skip


def read_saved(path: Path) -> dict[str, Any]:
    """The state in a run's checkpoint, with everything that a continuation looks up in it.

    Raises:
        InputError: there is no such file, it is damaged, or no checkpoint of a training run.
    """
    state = load_checkpoint(path)
    phase = state.get("phase")
    needed = {"steps"} if phase == "done" else set(_STATE)
    if not (isinstance(phase, str) and phase in PHASES and needed <= state.keys()):
        raise InputError(f"{path} is no checkpoint of a training run")
    for name, kind in _STATE.items() if phase != "done" else ():
        if not isinstance(state[name], kind):
            raise InputError(f"{path} is damaged: its {name} is {shown(state[name])}")
    if phase != "done":
        _check_numbers(path, state)
    return state


def _check_numbers(path: Path, state: dict[str, Any]) -> None:
    """InputError where a number of the state is none that a run can go on with."""
    for name in ("elapsed", "phase_started"):
        if not 0 <= state[name] < math.inf:
            raise InputError(f"{path} is damaged: its {name} is {shown(state[name])}")
    steps = state["steps"]
    if state["log_bytes"] < 0 or not all(type(n) is int and n >= 0 and name in PHASES for name, n in steps.items()):
        raise InputError(f"{path} is damaged: its counts are {shown(state['log_bytes'])} and {shown(steps)}")


def field_begun(state: Mapping[str, Any], path: Path) -> FieldShape | None:
    """The shape of the field that a run with ``state`` in its checkpoint has begun; None: it has begun none, or with a version
    whose settings stated it all. InputError where the checkpoint at ``path`` states no shape there."""
    trainer = state.get("trainer") if state["phase"] == "field" else None
    shape = (
        trainer.get("shape") if isinstance(trainer, dict) else None
    )  # what is damaged there is told once it is taken up
    if shape is None:
        return None
    if not isinstance(shape, dict):
        raise InputError(f"{path} is damaged: its field's shape is {shown(shape)}")
    return assemble(FieldShape, (shape, f"{path}, its field's shape"))
