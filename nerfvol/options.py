"""The options of the commands other than ``train``, as dataclasses: the command line and config files fill them alike.

This module imports nothing heavy, so that ``nerfvol --help`` answers at once.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from nerfvol.config import Colour, Count
from nerfvol.settings import DEFAULT_EARLY_STOP, DEFAULT_LOD

AOVS = ("depth", "median_depth", "opacity", "normal")


def image_size(value: Any) -> Any:
    """(width, height) from "WxH" or a list of two whole numbers; at most 16384 a side."""
    parts = value.lower().replace("×", "x").split("x") if isinstance(value, str) else value
    try:
        size = tuple(int(part) for part in parts)
    except (TypeError, ValueError):
        size = ()
    if len(size) != 2 or not all(1 <= side <= 16384 for side in size):
        raise ValueError(f"expected a size such as 800x600 (1 to 16384 pixels a side), got {value!r}")
    return size


def aov_names(value: Any) -> Any:
    """Names of extra pictures from "depth,normal" or a list."""
    names = [part.strip() for part in value.split(",") if part.strip()] if isinstance(value, str) else value
    for name in names:
        if name not in AOVS:
            raise ValueError(f"expected names out of {', '.join(AOVS)}, got {name!r}")
    return tuple(names)


def fraction(value: Any) -> Any:
    """A number in [0, 1)."""
    number = float(value)
    if not 0.0 <= number < 1.0:
        raise ValueError(f"expected a number from 0 (exact) to below 1, got {value!r}")
    return number


def pixels(value: Any) -> Any:
    """A finite number >= 0."""
    number = float(value)
    if not 0.0 <= number < math.inf:
        raise ValueError(f"expected a number of pixels, 0 (off) or more, got {value!r}")
    return number


Size = Annotated[tuple[int, int], image_size]


@dataclass
class EvalOptions:
    """``nerfvol eval``."""

    target: str = ""
    data: str | None = None
    split: Literal["train", "val", "test"] = "val"
    downscale: Count = 1
    background: Colour | None = None
    early_stop_eps: Annotated[float, fraction] = DEFAULT_EARLY_STOP
    lod: Annotated[float, pixels] = DEFAULT_LOD
    json: str | None = None
    save_images: str | None = None
    truth: str | None = None
    threads: int = 0


@dataclass
class RenderOptions:
    """``nerfvol render``."""

    target: str = ""
    cameras: str | None = None
    orbit: Count | None = None
    size: Size | None = None
    out: str = ""
    aov: Annotated[tuple[str, ...], aov_names] = ()
    format: Literal["png", "exr"] = "png"
    fps: Count = 30
    background: Colour | None = None
    early_stop_eps: Annotated[float, fraction] = DEFAULT_EARLY_STOP
    lod: Annotated[float, pixels] = DEFAULT_LOD
    threads: int = 0


@dataclass
class InfoOptions:
    """``nerfvol info``."""

    target: str = ""
    json: bool = False


@dataclass
class BenchOptions:
    """``nerfvol bench``."""

    target: str = ""
    sizes: tuple[Count, ...] = (400, 800, 1600)
    repeats: Count = 5
    data: str | None = None
    reference: bool = True
    json: str | None = None
    plot: str | None = None
    runs: tuple[str, ...] = ()
    threads: int = 0


def usable_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
