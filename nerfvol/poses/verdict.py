"""What structure from motion came to, in sentences that a person with a camera can act on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

LEAST_SHARE = 0.5
"""Of the photographs, the fewest that must be placed."""
USUAL_FEATURES = 1000
FEW_FEATURES = 300
"""A photograph with fewer shows bare walls or is blurred."""
TURNING = 0.003
"""Of a picture's longer side: parallax below which the camera turned on the spot (matches are good to half of that)."""
LARGE_ERROR = 1.5
NAMED = 5
LEAST_GROUP = 3
"""Photographs of which cameras could follow."""


def components(names: Sequence[str], links: Sequence[tuple[str, str, int]], least: int = 15) -> list[list[str]]:
    """The photographs that hang together by pairs with ``least`` verified matches, the largest group first."""
    parent = {name: name for name in names}

    def root(name: str) -> str:
        while parent[name] != name:
            parent[name] = parent[parent[name]]
            name = parent[name]
        return name

    for a, b, matches in links:
        if matches >= least:
            parent[root(a)] = root(b)
    groups: dict[str, list[str]] = {}
    for name in names:
        groups.setdefault(root(name), []).append(name)
    return sorted(groups.values(), key=lambda group: (-len(group), group[0]))


def listed(names: Sequence[str]) -> str:
    """Up to five names and how many more."""
    shown = ", ".join(names[:NAMED])
    return shown + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")


def groups_of(result: dict[str, Any], names: Sequence[str]) -> list[list[str]]:
    """The groups of two or more photographs that hang together, the largest first."""
    return [group for group in components(names, result["links"]) if len(group) > 1]


def parted(groups: Sequence[Sequence[str]], n: int) -> str:
    """What the two largest of several groups are; ``n`` photographs in all."""
    first, second = groups[:2]
    more = f"; {sum(map(len, groups[2:]))} are in smaller groups" if len(groups) > 2 else ""
    return (
        f"{len(first)} of {n} photographs hang together ({listed(first)}); {len(second)} more form a group without connection "
        f"to it ({listed(second)}){more}"
    )


def turning(result: dict[str, Any]) -> bool:
    """Whether the camera turned without moving: one rotation a pair explains its matches."""
    motion = result["motion"]
    return motion["good_pairs"] >= 3 and 0 <= motion["parallax"] < TURNING


def failure(result: dict[str, Any], names: Sequence[str], sharpness: float | None = None) -> str | None:
    """Why the photographs gave no usable cameras, one sentence; None where at least half of them were placed.

    ``result``: of the engine. ``names``: all photographs. ``sharpness``: median of the pictures (measure.sharpness), or
    None where it was not looked at.
    """
    n, placed = len(names), result["registered"]
    enough = len(placed) >= max(3, LEAST_SHARE * n)
    features = int(np.median(list(result["features"].values()) or [0]))
    if turning(result):
        return (
            f"the {n} photographs were taken turning on the spot, which shows no depth: step sideways while you take them, "
            "half a metre between two pictures of a room"
        )
    if enough:
        return None
    groups = groups_of(result, names)
    if features < FEW_FEATURES:
        why = "they are blurred" if sharpness is not None and 0 < sharpness < BLURRED else "blur or bare walls"
        return (
            f"the photographs share too little: {features} features each where {USUAL_FEATURES:,} are usual: {why}; take them "
            "with more light and a steady hand, and let something with a pattern be in each"
        )
    if not groups:
        return f"no two of the {n} photographs share enough ({features:,} features each): each must show half of the one before"
    if len(groups) > 1 and len(groups[1]) >= LEAST_GROUP:
        return f"{parted(groups, n)}: take pictures between them, or leave one group out"
    return (
        f"only {len(placed)} of {n} photographs could be placed: each must show half of what another shows, from a place "
        f"beside it; left out: {listed([name for name in names if name not in set(placed)])}"
    )


BLURRED = 0.12
"""Sharpness (measure.sharpness) of thumbnails below which a picture is blurred by some four pixels of them."""


def remarks(result: dict[str, Any], names: Sequence[str]) -> list[str]:
    """What a person should know of cameras that were found."""
    said, placed = [], set(result["registered"])
    left = [name for name in names if name not in placed]
    if left:
        features = result["features"]
        few = [name for name in left if features.get(name, 0) < FEW_FEATURES]
        groups = groups_of(result, names)
        apart = len(groups) > 1 and len(groups[1]) >= LEAST_GROUP and not placed.intersection(groups[1])
        why = f"they share too little with the others: {listed(left)}"
        if len(few) > len(left) / 2:
            why = f"they show blur or bare walls: {listed(left)}"
        elif apart:
            why = f"{parted(groups, len(names))}; pictures between them would join them"
        said.append(f"{len(placed)} of {len(names)} photographs were placed; {why}")
    if result["error_pixels"] > LARGE_ERROR:
        said.append(
            f"the cameras fit the pictures to {result['error_pixels']:.1f} pixels only, where 1 is usual: something moved, "
            "or the lens zoomed"
        )
    for camera in result["cameras"]:
        side, focal = max(camera["width"], camera["height"]), camera["focal"]
        view = float(np.degrees(2 * np.arctan(side / (2 * focal)))) if focal > 0 else 0.0
        if not 15 <= view <= 120:
            said.append(
                f"a field of view of {view:.0f} degrees came out, which no ordinary lens has: take more pictures from further "
                "apart"
            )
        k1 = _k1(camera)
        if k1 is not None and abs(k1) > 0.5:
            said.append(f"a strong distortion (k1 = {k1:.2f}) came out: if the lens is a fisheye, say --fisheye")
    return said


def _k1(camera: dict[str, Any]) -> float | None:
    place = {"SIMPLE_RADIAL": 3, "OPENCV": 4}.get(camera["lens"])
    return None if place is None else camera["parameters"][place]
