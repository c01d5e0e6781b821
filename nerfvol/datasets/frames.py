"""From listed frames to views: the size of each picture against its calibration, how it lies, its lens's reach, its masks.

One odd picture does not decide for the whole set: where a few do not fit, they are left out, counted and named.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.cameras.lens import Fisheye
from nerfvol.datasets.images import ImageHeader, UInt8, image_header, map_threads, read_mask
from nerfvol.datasets.listing import Frame, named, require_few, with_count
from nerfvol.datasets.odd_ones import alone, astray
from nerfvol.errors import InputError

UNLIT = 32
"""Levels of 255: what is darker in all pictures, from some radius on, no lens has lit."""
ENOUGH = 3
"""Pictures that must agree on that."""
DARK_SHARE = 0.02
"""Of the picture: less is a dark corner."""
LEAST_REACH = 0.3
"""Share of a picture that its lens must reach: less is no fisheye's circle but a wrong calibration."""


@dataclass(frozen=True, eq=False)
class View:
    """A frame whose picture is there and fits. ``orientation``: how EXIF means it to be turned, 1 where it is not.
    ``circle``: pixels from the principal point to the end of the disc that a fisheye lens lights; None: no such end."""

    frame: Frame
    camera: Camera
    orientation: int
    circle: float | None = None

    @property
    def path(self) -> Path:
        """The picture's file."""
        return self.frame.file

    def seen(self) -> UInt8 | None:
        """(h, w) uint8, 0 where a mask leaves pixels out or the lens does not reach, else 255; None: all are seen.

        Raises:
            InputError: a mask cannot be read, or is of another shape than its picture.
        """
        lens = self.camera.intrinsics
        reach = lens.seen()
        parts = [] if reach is None else [np.where(reach, 255, 0).astype(np.uint8)]
        if self.circle is not None:
            parts.append(np.where(_from_axis(lens) <= self.circle, 255, 0).astype(np.uint8))
        for mask in self.frame.masks:
            pixels = _mask(mask.path, (lens.width, lens.height), self.orientation)
            parts.append(pixels if mask.black_is_out else 255 - pixels)
        if not parts:
            return None
        together = functools.reduce(np.minimum, parts)
        return None if together.all() else together


@functools.lru_cache(maxsize=2)
def _from_axis(lens: Intrinsics) -> NDArray[np.float64]:
    """Pixels (h, w) from the principal point."""
    return np.hypot(np.arange(lens.width) + 0.5 - lens.cx, (np.arange(lens.height) + 0.5 - lens.cy)[:, None])


@functools.lru_cache(maxsize=2)
def _mask(path: Path, size: tuple[int, int], orientation: int) -> UInt8:
    """One mask often serves all frames."""
    return read_mask(path, size, orientation)


def views_of(
    frames: Sequence[Frame], training: Sequence[Frame], source: Path, messages: list[str], threads: int | None = None
) -> tuple[list[View], list[View]]:
    """The views of a split and of the training split; sentences on what was done to them go to ``messages``.

    Raises:
        InputError: most pictures do not fit their calibration, or a lens does not reach them.
    """
    everything = {id(frame): frame for frame in (*training, *frames)}
    found = dict(zip(everything, map_threads(_header, everything.values(), threads), strict=True))
    headers = {key: header for key, header in found.items() if not isinstance(header, InputError)}
    made: dict[int, View] = {}
    unread = {key: header for key, header in found.items() if isinstance(header, InputError)}
    wrong: dict[int, InputError] = {}
    odd = _odd_sizes({key: everything[key] for key in headers}, headers)
    for key, frame in everything.items():
        if key in unread:
            continue
        try:
            if key in odd:
                raise odd[key]
            made[key] = _view(frame, headers[key], source)
        except InputError as error:
            wrong[key] = error
    require_few([*unread.values(), *wrong.values()], len(everything))
    if unread:
        messages.append(unread_sentence(list(unread.values())))
    odd_ones = alone([made[key] for key in everything if key in made], messages)
    made = {key: view for key, view in made.items() if id(view) not in odd_ones}
    by_pose = astray([made[id(f)] for f in training if id(f) in made], [made[id(f)] for f in frames if id(f) in made])
    own = [frame for frame in frames if id(frame) in made and id(made[id(frame)]) not in by_pose]
    if not own:
        raise next(iter((unread | wrong).values()), InputError(f"{source}: no images are left for this split"))
    _tell(frames, headers, made, wrong, by_pose, messages)
    kept = [made[id(f)] for f in training if id(f) in made and id(made[id(f)]) not in by_pose]
    views = [made[id(frame)] for frame in own]
    return views, kept or views


def unread_sentence(errors: Sequence[InputError]) -> str:
    """Of pictures that are left out because their files are damaged."""
    return f"{len(errors)} images cannot be read and are left out: {with_count(errors)}"


def _header(frame: Frame) -> ImageHeader | InputError:
    try:
        return image_header(frame.file)
    except InputError as error:
        return error


def with_circles(
    views: Sequence[View], judged: Sequence[tuple[View, UInt8]], messages: list[str]
) -> tuple[list[View], dict[Intrinsics, float]]:
    """The views with the discs that their fisheye lenses light, as the small pictures ``judged`` (h, w, 3 or 4) show them: what
    is black in all of them from some radius on was never lit. A sentence goes to ``messages``; the radii by lens too."""
    lit: dict[Intrinsics, list[float]] = {}
    for view, picture in judged:
        lens = view.camera.intrinsics
        if isinstance(lens.lens, Fisheye):
            height, width = picture.shape[:2]
            across = (np.arange(width) + 0.5) * lens.width / width - lens.cx
            down = (np.arange(height) + 0.5) * lens.height / height - lens.cy
            bright = picture[..., :3].max(axis=2) > UNLIT
            lit.setdefault(lens, []).append(float((np.hypot(across, down[:, None]) * bright).max()))
    circles = {}
    for lens, radii in lit.items():
        dark = float((_from_axis(lens) > max(radii)).mean())
        if len(radii) >= ENOUGH and dark > DARK_SHARE:
            circles[lens] = max(radii) * (1 - 0.5 / max(min(lens.width, lens.height), 1))
    n = sum(view.camera.intrinsics in circles for view in views)
    if n:
        messages.append(f"the fisheye lens of {n} images lights a disc of them: what is black around it takes no part")
    return [replace(view, circle=circles.get(view.camera.intrinsics)) for view in views], circles


def with_common_masks(views: Sequence[View], training: Sequence[View], messages: list[str]) -> list[View]:
    """The views, those without a mask with that of the training views where all of them share one: it is the camera's."""
    shared = {view.frame.masks for view in training}
    if len(training) < 3 or len(shared) != 1 or shared == {()}:
        return list(views)
    (masks,) = shared
    sizes = {(view.camera.intrinsics.width, view.camera.intrinsics.height) for view in training}
    bare = [v for v in views if not v.frame.masks and (v.camera.intrinsics.width, v.camera.intrinsics.height) in sizes]
    if bare:
        messages.append(f"all training views share one mask, and {len(bare)} views without any get it too")
    chosen = {id(view) for view in bare}
    return [replace(v, frame=replace(v.frame, masks=masks)) if id(v) in chosen else v for v in views]


def _view(frame: Frame, header: ImageHeader, source: Path) -> View:
    try:
        turns = header.orientation >= 5 and frame.calibration.turns(*header.size)
        size = header.upright if turns else header.size
        camera = Camera(frame.calibration.intrinsics(*size), frame.c2w, frame.light)
        reach = camera.intrinsics.seen()
        if reach is not None and reach.mean() < LEAST_REACH:
            width, height = size
            camera.intrinsics.directions_at([(0, 0), (width, 0), (0, height), (width, height)])  # says what is wrong
        return View(frame, camera, header.orientation if turns else 1)
    except InputError as error:
        raise InputError(f"{source}, frame {frame.listed}: {error}") from None


def _odd_sizes(frames: dict[int, Frame], headers: dict[int, ImageHeader]) -> dict[int, InputError]:
    """A field of view shared by images of unstated size means nothing unless they are of one size, that of most."""
    free = [key for key, frame in frames.items() if frame.calibration.width is None and frame.calibration.fx is None]
    if not free:
        return {}
    usual = Counter(headers[key].size for key in free).most_common(1)[0][0]
    like = next(frames[key].listed for key in free if headers[key].size == usual)
    return {
        key: InputError(
            f"{frames[key].path}: expected an image of {usual[0]}x{usual[1]} pixels like {like}, got "
            f"{headers[key].size[0]}x{headers[key].size[1]}"
        )
        for key in free
        if headers[key].size != usual
    }


def _may_lie(view: View, header: ImageHeader) -> bool:
    """Whether nothing tells which way up the poses mean a picture that its EXIF orientation would turn."""
    if view.orientation != 1 or header.orientation == 1:
        return False
    calibration, (width, height) = view.frame.calibration, header.size
    stated = calibration.width is not None and calibration.height is not None
    return header.orientation <= 4 or width == height or not (stated or calibration.cx is not None)


def _on_files(views: Sequence[View], headers: dict[int, ImageHeader]) -> list[str]:
    """Sentences on pictures that are not what a file of this name usually is: in other colours, or several in one."""
    said, by_name = [], {}  # by name alone: some programs write the moment into each profile
    for view in views:
        colours = headers[id(view.frame)].colours
        if colours is not None:
            by_name.setdefault((colours.name, colours.is_known), []).append(view.frame.listed)
    for (name, is_known), names in by_name.items():
        done = "they are converted to it" if is_known else "they are taken as if they were sRGB's"
        said.append(f"{len(names)} of {len(views)} images state other colours than sRGB ({name}): {done}")
    if several := [view.frame.listed for view in views if headers[id(view.frame)].is_several]:
        said.append(
            f"{len(several)} of {len(views)} images are files of several pictures, animations or pages: the first of each is "
            f"used: {named(several)}"
        )
    return said


def _tell(
    frames: Sequence[Frame], headers: dict[int, ImageHeader], made: dict[int, View], wrong: dict[int, InputError],
    by_pose: set[int], messages: list[str],
) -> None:  # fmt: skip
    """Sentences on what was left out, turned and scaled, of this split's frames and those of the training."""
    views = list(made.values())
    if wrong:
        messages.append(f"{len(wrong)} images do not fit the others and are left out: {next(iter(wrong.values()))}")
    messages += _on_files(views, headers)
    far = [view.frame.listed for view in views if id(view) in by_pose]
    if far:
        messages.append(
            f"{len(far)} of {len(views)} cameras lie astray, far from all others, as structure from motion leaves them; they "
            f"are left out: {named(far)}"
        )
    turned = [view.frame.listed for view in views if view.orientation != 1]
    if turned:
        messages.append(
            f"{len(turned)} of {len(views)} photographs lie on their side in their files and are turned as their EXIF "
            "orientation says, since the calibration is for upright ones"
        )
    as_stored = [view.frame.listed for view in views if _may_lie(view, headers[id(view.frame)])]
    if as_stored:
        messages.append(
            f"{len(as_stored)} of {len(views)} photographs have an EXIF orientation, and their calibration fits them as stored "
            f"and turned alike: they are taken as stored ({named(as_stored)})"
        )
    scaled: Counter[tuple[tuple[int, int], tuple[int, int], bool]] = Counter()
    off = []
    for frame in {id(f): f for f in frames}.values():
        if id(frame) not in made:
            continue
        size = headers[id(frame)].upright if made[id(frame)].orientation != 1 else headers[id(frame)].size
        calibration = frame.calibration
        stated = calibration.made_for(*size)
        if stated != size and not calibration.resizable:
            scaled[stated, size, calibration.width is None and calibration.height is None] += 1
        elif calibration.is_off(*size):
            off.append(frame.listed)
    for (stated, size, guessed), count in scaled.items():
        how = "its principal point (cx, cy) is the middle of such" if guessed else "as it states"
        messages.append(
            f"the calibration of {count} images of {size[0]}x{size[1]} pixels is for {stated[0]}x{stated[1]} ({how}): it is "
            "scaled to them"
        )
    if off:
        messages.append(
            f"the principal point (cx, cy) of {len(off)} images lies more than a quarter of the picture from its middle: is "
            f"the calibration for pictures of another size? ({named(off)})"
        )
    reached = [reach.mean() for v in views if (reach := v.camera.intrinsics.seen()) is not None]
    if reached:
        messages.append(
            f"the lens reaches {100 * float(np.mean(reached)):.0f} % of {len(reached)} images: what lies beyond has no ray, "
            "and takes no part in training and scores"
        )
