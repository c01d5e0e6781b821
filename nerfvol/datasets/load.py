"""``load_dataset``: finds the format, reads the listing, decodes the images and works out the scene bounds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.focus import focus_point
from nerfvol.datasets.bounds import bounds_of_box, bounds_of_points, estimate_bounds, require_seen
from nerfvol.datasets.dataset import Dataset, evenly
from nerfvol.datasets.decoding import decoded, on_masks, readable, settle_alpha
from nerfvol.datasets.extras import unread
from nerfvol.datasets.formats import SPLITS, find_format
from nerfvol.datasets.frames import View, views_of, with_circles, with_common_masks
from nerfvol.datasets.holdout import HOLDOUTS, hold_out_arc
from nerfvol.datasets.images import UInt8, map_threads
from nerfvol.datasets.kinds import KINDS, Decision, Evidence, decide, look
from nerfvol.datasets.listing import Frame, Listing, listed_names, named
from nerfvol.datasets.odd_ones import blank, dim, thumbnails
from nerfvol.datasets.sampled import Sampled, sample, seen_small
from nerfvol.datasets.store import ImageStore
from nerfvol.errors import InputError, shown
from nerfvol.machine import total_memory
from nerfvol.region import SceneBounds, check_box


def load_dataset(
    path: str | os.PathLike[str],
    split: str = "train",
    downscale: int = 1,
    aabb: ArrayLike | None = None,
    threads: int | None = None,
    holdout: str = "own",
    scene: str = "auto",
    most: int | None = None,
) -> Dataset:
    """Loads one split of a folder of posed images, whatever its format (docs/data.md).

    Args:
        path: a folder that one of FORMATS recognises, or one transforms*.json.
        split: "train", "val" or "test".
        downscale: area-averages the images (premultiplied by alpha) over downscale x downscale pixels.
        aabb: the region of detail (see SceneBounds) instead of the one worked out: x0, y0, z0, x1, y1, z1 or its two
            corners (2, 3), in scene units.
        threads: threads that decode; one for every core by default.
        holdout: "own": the split is the files', or every 8th view is held out; "arc": neighbours among the views that would
            then train are held out together, for validation and test alike, and the others train.
        scene: what kind of scene it is, one of kinds.KINDS; "auto": by what pictures and cameras say.
        most: views at most, evenly chosen, the first and the last among them; None: all.

    Raises:
        InputError: where the files cannot be used, in one sentence that names the file.
    """
    found = _find(path, split, downscale, aabb, threads, holdout, scene, most)
    _require_memory([view.camera.scaled(downscale) for view in found.views], downscale)
    views, messages, decision, listing = found.views, found.messages, found.decision, found.listing
    # In photographs of a place what is transparent was not seen, by whatever cut it out.
    cut_out = decision.kind != "object"

    def decode(views: Sequence[View]) -> tuple[list[UInt8], list[UInt8 | None]]:
        made = map_threads(lambda view: decoded(view, found.sampled.get(view.path), downscale, cut_out), views, threads)
        return settle_alpha([image for image, _ in made], listing.source), [mask for _, mask in made]

    try:
        images, masks = decode(views)
    except InputError:  # found out which: once it is known that one is damaged, the time does not matter
        views = readable(views, messages, threads)
        images, masks = decode(views)
    found.release()
    if nothing := blank(views, images, messages):
        kept = [i for i in range(len(views)) if i not in nothing]
        views, images, masks = [views[i] for i in kept], [images[i] for i in kept], [masks[i] for i in kept]
    cameras = [view.camera.scaled(downscale) for view in views]
    require_seen(found.bounds, cameras)
    messages += on_masks(views, masks, images)
    store = ImageStore(len(images), lambda: decode(views)[0], images)
    names, source = listed_names([view.frame for view in views]), str(listing.source)
    evidence = found.evidence
    backdrop = evidence.backdrop if decision.kind == "object" and not evidence.see_through else None
    some = masks if any(mask is not None for mask in masks) else None
    return Dataset(
        cameras,
        store,
        names,
        found.bounds,
        source,
        messages,
        threads,
        listing.read_points,
        some,
        backdrop,
        decision.kind,
    )


def dataset_cameras(
    path: str | os.PathLike[str],
    split: str = "train",
    downscale: int = 1,
    aabb: ArrayLike | None = None,
    threads: int | None = None,
    holdout: str = "own",
    scene: str = "auto",
) -> tuple[list[Camera], SceneBounds]:
    """The cameras and the bounds that :func:`load_dataset` has, from as many pictures as tell what kind of scene it is.

    Those of pictures that turn out to be blank or damaged are among them.

    Raises:
        InputError: as load_dataset, of what comes before the pictures are decoded.
    """
    found = _find(path, split, downscale, aabb, threads, holdout, scene, None)
    found.release()
    cameras = [view.camera.scaled(downscale) for view in found.views]
    require_seen(found.bounds, cameras)
    return cameras, found.bounds


@dataclass(eq=False)
class _Found:
    """A split before its pictures are decoded; ``sampled``: those that were, to be judged by."""

    listing: Listing
    views: list[View]
    sampled: dict[Path, Sampled]
    bounds: SceneBounds
    decision: Decision
    evidence: Evidence
    messages: list[str]

    def release(self) -> None:
        """Gives up the pictures that nobody took."""
        for picture in self.sampled.values():
            picture.take()


def _find(
    path: str | os.PathLike[str], split: str, downscale: int, aabb: ArrayLike | None, threads: int | None, holdout: str,
    scene: str, most: int | None,
) -> _Found:  # fmt: skip
    """The views of a split, with masks and circles, and where the scene is."""
    box = _checked(split, downscale, holdout, scene, aabb)
    row = find_format(Path(path))
    reader = row.reader
    listing = (
        reader.read(Path(path), split) if holdout == "own" else _without_arc(reader.read(Path(path), "train"), split)
    )
    messages = [*listing.messages, *unread(Path(path), row)]
    frames = _present(listing, messages)
    training = [f for f in listing.training if f.path is not None] or frames
    views, training_views = views_of(frames, training, listing.source, messages, threads)
    views, training_views = thumbnails(training_views, views, downscale, messages)
    if most is not None and len(views) > most:
        views = [views[i] for i in evenly(len(views), most)]
    views = with_common_masks(views, training_views, messages)
    judged, sampled = sample(training_views, threads)
    views, circles = with_circles(views, judged, messages)
    judged = [(replace(view, circle=circles.get(view.camera.intrinsics)), picture) for view, picture in judged]
    evidence = look(*seen_small(judged))
    bounds, decision, said = _scene_of(listing, training_views, box, evidence, scene)
    messages += [*dim([picture for _, picture in judged]), *decision.doubts, decision.sentence, said]
    return _Found(listing, views, sampled, bounds, decision, evidence, messages)


def _checked(
    split: str, downscale: int, holdout: str, scene: str, aabb: ArrayLike | None
) -> NDArray[np.float64] | None:
    """The aabb as two corners (2, 3), or None; InputError where an argument of load_dataset is none that it takes."""
    if split not in SPLITS:
        raise InputError(f"the split must be one of {', '.join(SPLITS)}, got {split!r}")
    if not isinstance(downscale, int) or not 1 <= downscale <= 256:
        raise InputError(f"downscale must be an integer between 1 and 256, got {downscale!r}")
    if scene not in ("auto", *KINDS):
        raise InputError(f"the kind of scene must be auto or one of {', '.join(KINDS)}, got {shown(scene)}")
    if holdout not in HOLDOUTS:
        raise InputError(f"holdout must be one of {', '.join(HOLDOUTS)}, got {holdout!r}")
    return None if aabb is None else check_box(aabb, "aabb")


def _scene_of(
    listing: Listing, training: Sequence[View], box: NDArray[np.float64] | None, evidence: Evidence, asked: str
) -> tuple[SceneBounds, Decision, str]:
    """The bounds, what they were taken for, and a sentence on how they were found."""
    cameras, hint = [view.camera for view in training], listing.hint
    decision = decide(asked, evidence, cameras, focus_point(cameras), hint.near_far is not None)
    has_alpha, bounded = evidence.see_through, decision.kind == "object"
    if box is not None:
        return bounds_of_box(box, has_alpha, bounded), decision, _of_box(box, cameras, "the aabb as given")
    if hint.aabb is not None:
        said = _of_box(hint.aabb, cameras, "the aabb of the file")
        return estimate_bounds(cameras, has_alpha, hint, decision.kind)[0], decision, said
    bounds, said = estimate_bounds(cameras, has_alpha, hint, decision.kind)
    if bounds.is_guess and listing.read_points is not None:
        points = listing.read_points()
        good = points.positions[points.track_lengths >= 3]
        if len(good) >= 100:
            return bounds_of_points(good, bounds), decision, f"scene bounds: around the points of {points.source}"
    return bounds, decision, said


def _of_box(box: NDArray[np.float64], cameras: Sequence[Camera], what: str) -> str:
    """A sentence on bounds that are stated; where the cameras look at a point beside them, that too."""
    focus = focus_point(cameras)
    aside = (focus.point <= box[0]).any() or (focus.point >= box[1]).any()
    if not (focus.is_clear and aside):
        return f"scene bounds: {what}"
    point = " ".join(f"{v:.4g}" for v in focus.point)
    return (
        f"scene bounds: {what}, beside the point that all cameras look at ({point}): is it in the units of the poses?"
    )


def _without_arc(listing: Listing, split: str) -> Listing:
    """The listing of the training split as one of the arc, or of what is left of it."""
    present = [frame for frame in listing.frames if frame.path is not None]
    try:
        kept, held, sentence = hold_out_arc(present)
    except InputError as error:
        raise InputError(f"{listing.source}: {error}") from error
    frames = kept if split == "train" else held
    return replace(listing, frames=frames, training=kept, messages=[*listing.messages, sentence])


def _present(listing: Listing, messages: list[str]) -> list[Frame]:
    """The frames whose image exists; the others are reported in a message."""
    missing = [frame.listed for frame in listing.frames if frame.path is None]
    present = [frame for frame in listing.frames if frame.path is not None]
    if not present:
        raise InputError(
            f"{listing.source}: none of the {len(missing)} images it lists exists (the first is {missing[0]})"
            if missing
            else f"{listing.source}: no images are left for this split"
        )
    if missing:
        messages.append(
            f"{listing.source.name} lists {len(missing)} images that are not on disk; they are left out: {named(missing)}"
        )
    return present


def _require_memory(cameras: Sequence[Camera], downscale: int) -> None:
    """Refuses a set of images that cannot fit in memory (the machine's, or its container's limit) before they are decoded."""
    need = sum(4 * camera.intrinsics.width * camera.intrinsics.height for camera in cameras)
    have = total_memory()
    if have is not None and need > 0.8 * have:  # on a platform that does not tell, decode and see
        factor = int(np.ceil(downscale * np.sqrt(need / (0.5 * have))))
        raise InputError(
            f"{len(cameras)} images need {need / 2**30:.1f} GiB and there are {have / 2**30:.1f} GiB of memory; "
            f"use a downscale of {factor} or more"
        )
