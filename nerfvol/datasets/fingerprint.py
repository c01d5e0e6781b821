"""What a run was begun with: names, sizes, poses and content of its pictures, so that a resumed run knows them again."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.images import map_threads
from nerfvol.datasets.listing import named

_ALIKE = 1e-5
"""Of the cameras' extent: poses that differ by less are the same, worked out on another machine."""
_SAME_REGION = 0.01
"""Of its side: a region that a plane sweep found on another machine differs by less."""


def fingerprint(dataset: Dataset, lights: int | None = None) -> dict[str, Any]:
    """What a checkpoint keeps of a dataset: names, sizes (n, 2), poses (n, 3, 4), check sums (n,) of pixels and masks; and
    the region of detail (2, 3) and whether there is a background around it. ``lights``: of the file of lights, if any."""

    def content(i: int) -> int:
        mask = dataset.mask(i)
        total = zlib.crc32(np.ascontiguousarray(dataset.images[i]).data)
        return total if mask is None else zlib.crc32(np.ascontiguousarray(mask).data, total)

    return {
        "names": list(dataset.names),
        "sizes": np.array([(c.intrinsics.width, c.intrinsics.height) for c in dataset.cameras], np.int64).reshape(
            -1, 2
        ),
        "lenses": np.array([_lens(c.intrinsics) for c in dataset.cameras], np.int64),
        "poses": np.stack([camera.c2w[:3] for camera in dataset.cameras]),
        "content": np.array(map_threads(content, range(len(dataset)), dataset.threads), np.int64),
        "region": dataset.scene.aabb,
        "unbounded": dataset.scene.is_unbounded,
        "lights": lights,
        "lit": [camera.light for camera in dataset.cameras],
    }


def _lens(intrinsics: Any) -> int:
    numbers = [intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy, *intrinsics.distortion]
    return zlib.crc32(" ".join(f"{x:.7g}" for x in numbers).encode())


def changes(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """What is different between two fingerprints, in words; None: nothing.

    Raises:
        LookupError, TypeError, ValueError: ``before`` is no fingerprint.
    """
    old = {str(name): i for i, name in enumerate(before["names"])}
    new = {str(name): i for i, name in enumerate(now["names"])}
    n = len(old)
    if any(len(np.asarray(before[key])) != n for key in ("sizes", "lenses", "poses", "content")):
        raise ValueError("its record of the pictures does not fit itself")
    said = []
    gone, added = [name for name in old if name not in new], [name for name in new if name not in old]
    if gone:
        said.append(f"{len(gone)} are gone ({named(gone)})")
    if added:
        said.append(f"{len(added)} are new ({named(added)})")
    both = [name for name in new if name in old]
    was, are = [old[name] for name in both], [new[name] for name in both]
    poses = np.asarray(before["poses"], np.float64)[was], np.asarray(now["poses"], np.float64)[are]
    extent = float(np.ptp(poses[1][:, :, 3], axis=0).max(initial=0.0)) + 1e-12 * float(
        np.abs(poses[1]).max(initial=0.0)
    )
    turned = np.abs(poses[0][:, :, :3] - poses[1][:, :, :3]).max(axis=(1, 2), initial=0.0) > _ALIKE
    moved = np.abs(poses[0][:, :, 3] - poses[1][:, :, 3]).max(axis=1, initial=0.0) > _ALIKE * extent
    sizes = (np.asarray(before["sizes"])[was] != np.asarray(now["sizes"])[are]).any(axis=1)
    lenses = np.asarray(before["lenses"])[was] != np.asarray(now["lenses"])[are]
    content = (np.asarray(before["content"])[was] != np.asarray(now["content"])[are]) & ~sizes
    for different, what in ((sizes, "another size"), (turned | moved, "another pose"), (lenses & ~sizes, "another calibration"),
                            (content, "other pixels or masks")):  # fmt: skip
        if different.any():
            names = [name for name, is_so in zip(both, different, strict=True) if is_so]
            said.append(f"{len(names)} have {what} ({named(names)})")
    if not said and [str(name) for name in before["names"]] != [str(name) for name in now["names"]]:
        said.append("they are in another order")
    if said:
        return f"of {n} pictures, " + ", ".join(said)
    return _other_region(before, now) if "region" in before else None


def _other_region(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    old, new = (np.asarray(record["region"], np.float64).reshape(2, 3) for record in (before, now))
    if bool(before["unbounded"]) != bool(now["unbounded"]):
        return "they are taken for another kind of scene"
    if list(before["lit"]) != list(now["lit"]) or before["lights"] != now["lights"]:
        return "the lights that they are taken under are others"
    if np.abs(old - new).max() > _SAME_REGION * np.ptp(old, axis=0).max():
        return f"the scene's aabb was {_shown(old)} and is {_shown(new)}"
    return None


def _shown(box: Any) -> str:
    return ",".join(f"{v:.4g}" for v in box.ravel())
