"""Before a run begins: its folder, the settings it is resumed with, and its data, read and refused where it is useless."""

from __future__ import annotations

import os
import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from nerfvol.config.assemble import assemble, read_yaml, to_plain, write_yaml
from nerfvol.config.training import Config
from nerfvol.datasets.averages import composite_average, plain_colour
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.fingerprint import changes, fingerprint
from nerfvol.datasets.frame import Frame
from nerfvol.datasets.load import load_dataset
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError
from nerfvol.files.atomic import ensure_writable_folder, explain_os_error, read_bytes
from nerfvol.files.run_folder import (
    CHECKPOINT,
    CONFIG,
    DISTILLED,
    LOG,
    METRICS,
    PHOTOGRAPHS,
    PHOTOGRAPHS_PAGE,
    PREVIOUS,
    PRODUCTS,
    REFINED,
    UNFINISHED,
)
from nerfvol.measure.metrics import WINDOW
from nerfvol.measure.truth import TRUTH
from nerfvol.starts.region import region_of_sweep

Colour = tuple[float, float, float]

PROVENANCE = "provenance.json"
"""What simulated data have beside them, with or without TRUTH."""
HELD_OUT_KEPT = 32 << 20
"""Bytes of held-out images that a run keeps; more are read once again to be scored."""
COMPARED_SIZE = 200
"""Pixels along the middle of a held-out view on which field and octrees are compared: a field takes seconds for so many."""
LARGEST_HELD_OUT = 32
"""Views that a run scores itself on; `nerfvol eval` scores all there are."""
_FILES = (CONFIG, *PRODUCTS, DISTILLED, CHECKPOINT, METRICS, LOG, PHOTOGRAPHS, PHOTOGRAPHS_PAGE, REFINED)
_FREE = {"data", "poses", "out", "time_budget", "threads", "resume", "checkpoint_every", "storage", "compare_views"}
"""Settings that a resumed run may change; all others have already shaped its numbers."""


# ------------------------------------------------------------------ the folder
def resumable_config(run: str | os.PathLike[str]) -> Path:
    """RUN/config.yaml of a run that can be resumed; InputError where it or the checkpoint is missing."""
    config, checkpoint = Path(run) / CONFIG, Path(run) / CHECKPOINT
    for path in (config, checkpoint):
        if not path.is_file():
            raise InputError(f"--resume: {run} holds no {path.name}, so there is nothing to resume")
    return config


def check_folder(config: Config) -> Path:
    """The run folder, made where it is missing and proved to be writable; nothing in it is touched.

    Raises:
        InputError: it cannot be written, or a resumed run is asked for other settings than it was begun with.
    """
    run = ensure_writable_folder(config.out)
    if config.resume:
        _refuse_changes(_as_begun(run / CONFIG), to_plain(config))
    return run


def claim_folder(config: Config) -> None:
    """Put an earlier run in the folder aside and write the resolved config: for a run that has made its first step.

    The earlier run moves to RUN/previous (one generation is kept), unless this run resumes it; to RUN/unfinished where it has
    no model and RUN/previous has one.
    """
    run = Path(config.out)
    if not config.resume:
        _set_aside(run)
    # As --config the file starts a run of its own. A resumed one needs the file of its start no more, which may be gone.
    write_yaml(run / CONFIG, to_plain(config) | {"resume": False})


def _as_begun(path: Path) -> dict[str, Any]:
    """The settings in a run's file, each by its present name; of those that the run's version did not know what they are where
    nobody chose them."""
    # What it began with, a file perhaps, is not asked for again.
    layers = (read_yaml(path), str(path)), ({"resume": True}, str(path))
    return to_plain(assemble(Config, *layers, say=lambda sentence: None))


def _refuse_changes(old: dict[str, Any], new: dict[str, Any]) -> None:
    """An InputError where a resumed run is asked for other settings than the ones it was begun with."""
    for key, value in new.items():
        before = old[key]
        if key in _FREE or before == value:
            continue
        if isinstance(value, dict) and isinstance(before, dict):
            inner = next(name for name in value if before[name] != value[name])
            key, before, value = f"{key}.{inner}", before[inner], value[inner]
        raise InputError(
            f"--resume: the run was begun with {key} = {before}, which cannot become {value} half-way; "
            "leave the option out, or train again from the start"
        )


def _set_aside(run: Path) -> None:
    old = [run / name for name in _FILES if (run / name).is_file()]
    if not old:
        return
    finished = any((run / name).is_file() for name in PRODUCTS)
    kept = any((run / PREVIOUS / name).is_file() for name in PRODUCTS)
    # A generation without a model never takes the place of one that has one.
    previous = ensure_writable_folder(run / (PREVIOUS if finished or not kept else UNFINISHED))
    try:
        for name in _FILES:  # a file of the generation before must not mix with it
            (previous / name).unlink(missing_ok=True)
        for path in old:
            os.replace(path, previous / path.name)
    except OSError as error:
        raise InputError(f"cannot move the earlier run to {previous}: {explain_os_error(error)}") from error


# ------------------------------------------------------------------ the data
@dataclass(frozen=True)
class Data:
    """What a run trains on and scores itself on.

    compared: parts of held-out views on which field, distilled and fine-tuned octree are compared. first: the first
    held-out view, for previews. reading: seconds that it takes to read the held-out images again; 0: they are kept.
    frame: what all of them are in; the finished model is brought back from it. fingerprint: of the training views.
    loading: seconds that the training images took to be read, as they are again where a phase released them.
    """

    training: Dataset
    held_out: Dataset
    compared: Dataset
    first: Dataset
    reading: float
    frame: Frame = field(default_factory=Frame)
    fingerprint: Mapping[str, Any] = field(default_factory=dict)
    loading: float = 0.0

    @property
    def held_out_bytes(self) -> int:
        """Bytes of the images that stay in memory next to the training images."""
        return self.held_out.nbytes or self.first.nbytes + self.compared.nbytes


def load_data(config: Config, say: Callable[[str], object] = print) -> Data:
    """Reads the views of ``config.data``; ``say`` gets the sentences that a person should see.

    Raises:
        InputError: the data cannot be used, or there is nothing in the images.
    """
    started = time.perf_counter()
    training = load_dataset(
        config.data, "train", config.downscale, config.aabb, holdout=config.holdout, scene=config.scene
    )
    loading, started = time.perf_counter() - started, time.perf_counter()
    held_out = load_dataset(
        config.data,
        "val",
        config.downscale,
        config.aabb,
        holdout=config.holdout,
        scene=config.scene,
        most=LARGEST_HELD_OUT,
    )
    require_scorable(held_out)
    first = held_out.evenly(1)
    compared = held_out.evenly(config.compare_views).middles(COMPARED_SIZE)
    reading = 0.0
    if held_out.nbytes > HELD_OUT_KEPT:  # else released until they are scored
        held_out.release()
        reading = time.perf_counter() - started
    for message in training.messages:
        say(message)
    others = [message for message in held_out.messages if message not in training.messages]
    for message in others:
        say(f"of the held-out views: {message}")
    if training.scene.is_guess and (better := region_of_sweep(training)) is not None:
        scene, sentence = better
        say(sentence)
        training, held_out, compared, first = (replace(d, scene=scene) for d in (training, held_out, compared, first))
    require_something(training, background_of(config, training, say))
    frame = Frame.of(training.scene)
    if not frame.is_identity:
        say(
            "the scene lies far from the origin, or its unit is extreme: it is trained in a frame of its own, and the model "
            "comes back in the units of the poses"
        )
    moved = [frame.dataset_into(d) for d in (training, held_out, compared, first)]
    lights = None if config.light is None else zlib.crc32(read_bytes(config.light))
    return Data(moved[0], moved[1], moved[2], moved[3], reading, frame, fingerprint(training, lights), loading)


def is_simulated(data: str) -> bool:
    """Whether what the images show was simulated, and may be a medium: the truth or the provenance lies beside them."""
    folder = Path(data) if Path(data).is_dir() else Path(data).parent
    return any((folder / name).is_file() for name in (TRUTH, PROVENANCE))


def require_same(saved: Mapping[str, Any] | None, data: Data, checkpoint: Path) -> None:
    """An InputError where a resumed run's training pictures are not those it was begun with.

    Checkpoints of versions that kept no record are not held to one.
    """
    before = None if saved is None else saved.get("data")
    if before is None:
        return
    try:
        different = changes(before, data.fingerprint)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{checkpoint} is damaged: its record of the pictures cannot be read ({error})") from error
    if different is not None:
        raise InputError(
            f"--resume: the data are not those that the run was begun with: {different}; put them back, or train again "
            "from the start"
        )


def background_of(config: Config, training: Dataset, say: Callable[[str], object] | None = None) -> Colour:
    """The colour (3,) behind the scene: see Config.before."""
    backdrop = training.backdrop
    if backdrop is not None and config.background not in (None, backdrop) and say is not None:
        colour = ",".join(f"{c:.3g}" for c in backdrop)
        say(f"--background is not used while training: the pictures are opaque and have {colour} behind them")
    return config.before(backdrop).background or WHITE


def require_scorable(held_out: Dataset) -> None:
    """An InputError where a held-out view is smaller than the window of SSIM: a run would learn it after its last step."""
    for name, camera in zip(held_out.names, held_out.cameras, strict=True):
        lens = camera.intrinsics
        if min(lens.width, lens.height) < WINDOW:
            raise InputError(
                f"{held_out.source}: the held-out view {name} is {lens.width}x{lens.height}, expected {WINDOW}x{WINDOW} pixels "
                "or more, without which SSIM has no value; take larger pictures or a smaller --downscale"
            )


def require_something(dataset: Dataset, background: Sequence[float]) -> None:
    """An InputError where every pixel of every picture has the background's colour: there is nothing to reconstruct."""
    plain = plain_colour(background)
    if all((composite_average(image, background, 1) == plain).all() for image in dataset.images):
        colour = ",".join(f"{c:g}" for c in background)
        raise InputError(
            f"{dataset.source}: the training images are empty, nothing in them differs from the background {colour}; "
            "check the images, or choose another --background"
        )
