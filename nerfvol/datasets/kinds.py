"""What kind of scene a set of photographs shows, by evidence, and the sentence that says so.

object: a thing before nothing (transparency) or a plain backdrop; seen whole, with no background of its own.
surroundings: a subject that the cameras look at, and all that is behind it. room: cameras that look outwards or in all
directions. forward: cameras that look one way. The last three are photographs, with background shells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.focus import Focus, focus_of
from nerfvol.datasets.images import UInt8

KINDS = ("object", "surroundings", "room", "forward")
SEE_THROUGH = 250
"""Alpha below which a pixel counts as transparent."""
FAIR_SHARE = 0.05
"""Of a picture: transparency of less is a retouched pixel, a rounded corner, the rim that undistortion left."""
NEARLY_ALL = 0.75
"""Of the pictures: as many must show an object's transparency, or its backdrop."""
PLAIN = 0.9
"""Of a picture's border: as much must have the backdrop's colour."""
NOISE = 12
"""Levels of 255 by which a backdrop's pixels may differ from its colour, as JPEG leaves them."""
CONTENT = 1e-3
"""Share of a picture that must differ from the backdrop, somewhere."""
LOOKS_IN, LOOKS_AWAY = 0.75, 0.1
"""Shares of cameras that have the point where their axes meet before them: of those around a subject, and of those that
turn their backs on it."""
WELL_FIXED = 0.05
"""Certainty of the point where axes meet, above which it says something."""


@dataclass(frozen=True)
class Evidence:
    """What pictures say. ``transparent``: shares (n,) of see-through pixels; ``backdrop``: its RGB in [0, 1], or None."""

    transparent: tuple[float, ...]
    backdrop: tuple[float, float, float] | None

    @property
    def see_through(self) -> bool:
        """Whether a fair share of nearly all pictures is transparent."""
        return float(np.mean([share >= FAIR_SHARE for share in self.transparent])) >= NEARLY_ALL


@dataclass(frozen=True)
class Decision:
    """``kind``: one of KINDS; ``why``: the evidence, in words; ``doubts``: sentences on poses that look wrong."""

    kind: str
    why: str
    doubts: tuple[str, ...] = ()

    @property
    def sentence(self) -> str:
        """What it was taken for, and the option that overrules."""
        names = {"object": "an object", "surroundings": "a subject and its surroundings", "room": "a room seen from inside",
                 "forward": "photographs that look one way"}  # fmt: skip
        return f"scene: taken for {names[self.kind]} ({self.why}); --scene {'|'.join(KINDS)} overrules"


def look(pictures: Sequence[UInt8], seen: Sequence[NDArray[np.bool_] | None]) -> Evidence:
    """The evidence of pictures (h, w, 3 or 4); ``seen`` (h, w): which of their pixels count, None for all."""
    transparent, colours, plain = [], [], []
    content = False
    for picture, mask in zip(pictures, seen, strict=True):
        transparent.append(float((picture[..., 3] < SEE_THROUGH).mean()) if picture.shape[2] == 4 else 0.0)
        border = _border(picture, mask)
        if len(border):
            colour = np.median(border, axis=0)
            colours.append(colour)
            plain.append(float((np.abs(border - colour).max(axis=1) <= NOISE).mean()) >= PLAIN)
            content |= bool((np.abs(picture[..., :3] - colour).max(axis=2) > NOISE).mean() > CONTENT)
    if not content:  # nothing before it: that is no backdrop
        return Evidence(tuple(transparent), None)
    return Evidence(tuple(transparent), _backdrop(np.array(colours), np.array(plain)))


def _border(picture: UInt8, mask: NDArray[np.bool_] | None) -> NDArray[np.float64]:
    """The opaque pixels (n, 3) of the picture's rim, a fortieth of it wide, that count."""
    height, width = picture.shape[:2]
    rim = np.ones((height, width), dtype=bool)
    wide = max(1, min(height, width) // 40)
    rim[wide:-wide, wide:-wide] = False
    if mask is not None:
        rim &= mask
    if picture.shape[2] == 4:
        rim &= picture[..., 3] >= SEE_THROUGH
    return picture[rim][:, :3].astype(np.float64)


def _backdrop(colours: NDArray[np.float64], plain: NDArray[np.bool_]) -> tuple[float, float, float] | None:
    """The one colour (3,) in [0, 1] that the borders of nearly all pictures have."""
    if not len(colours) or plain.mean() < NEARLY_ALL:
        return None
    common = np.median(colours[plain], axis=0)
    alike = np.abs(colours - common).max(axis=1) <= NOISE
    if (alike & plain).mean() < NEARLY_ALL:
        return None
    ends = np.where(common >= 252, 255, np.where(common <= 3, 0, common)) / 255
    return float(ends[0]), float(ends[1]), float(ends[2])


def decide(asked: str, evidence: Evidence, cameras: Sequence[Camera], focus: Focus, stated_depths: bool) -> Decision:
    """What kind of scene it is: as ``asked``, or for "auto" by the evidence of pictures and ``cameras``.

    ``stated_depths``: whether the file states near and far, as those of forward-facing captures do.
    """
    doubts = tuple(_doubts(cameras, focus))
    looks_in = focus.certainty >= 1e-3 and focus.ahead >= LOOKS_IN
    if asked != "auto":
        return Decision(asked, "as asked", doubts)
    if evidence.see_through:
        share = float(np.median(evidence.transparent))
        return Decision("object", f"{100 * share:.0f} % of a picture is transparent", doubts)
    if evidence.backdrop is not None and looks_in:
        return Decision("object", f"before a plain {_colour(evidence.backdrop)} backdrop", doubts)
    if (stated_depths and focus.certainty < WELL_FIXED) or focus.certainty < 1e-3:
        return Decision("forward", "their axes are nearly parallel", doubts)
    if looks_in or focus.ahead >= 0.5 and focus.spread < 0.2:
        return Decision("surroundings", "the cameras look at one point", doubts)
    return Decision("room", "the cameras look at no common point before them", doubts)


def _colour(colour: tuple[float, float, float]) -> str:
    names = {(1.0, 1.0, 1.0): "white", (0.0, 0.0, 0.0): "black"}
    return names.get(colour, "grey" if max(colour) - min(colour) < 0.05 else ",".join(f"{c:.2f}" for c in colour))


def _doubts(cameras: Sequence[Camera], focus: Focus) -> list[str]:
    """Sentences on the two commonest mistakes of those who write poses themselves."""
    if len(cameras) < 4:
        return []
    poses = np.stack([camera.c2w for camera in cameras])
    apart = np.abs(poses - poses[0]).max(axis=0)
    if apart[:3, 3].max() <= 1e-9 * np.abs(poses[0, :3, 3]).max():
        if (apart <= 1e-9).all():
            return [f"all {len(cameras)} poses are the same: were the cameras found at all?"]
        return [
            "all cameras stand at one point, as in a panorama: nothing tells how far away things are; or are the poses "
            "world-to-camera matrices, which are to be inverted?"
        ]
    inverse = focus_of(np.linalg.inv(poses).astype(np.float64, copy=False))
    meets = focus.certainty >= WELL_FIXED and focus.spread < 0.2
    looks_away = meets and focus.ahead <= LOOKS_AWAY
    if inverse.certainty >= WELL_FIXED and inverse.spread < 0.1 and not (meets and focus.ahead >= LOOKS_IN):
        opencv = inverse.ahead <= LOOKS_AWAY and not looks_away
        if opencv or inverse.ahead >= 0.9:
            axes = ", in OpenCV axes (y down, z forward)" if opencv else ""
            return [
                f"the poses make sense as world-to-camera matrices{axes}: taken so, all cameras look at one point, and as the "
                "camera-to-world matrices that are expected they do not; are they to be inverted?"
            ]
    if looks_away:
        return [
            "all cameras look away from one point, as in a room seen from its middle: or are the poses in OpenCV axes (y down, "
            "z forward)? then negate the second and third column of each"
        ]
    return []
