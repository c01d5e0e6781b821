"""What RUN|FILE means to a command: the model, the background it is seen on and the orbit around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nerfvol.config.assemble import run_settings
from nerfvol.config.parsers import Colour
from nerfvol.config.values import coerce
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError, shown
from nerfvol.files.run_folder import model_path

if TYPE_CHECKING:
    from nerfvol.cameras.camera import Camera
    from nerfvol.models import Model
    from nerfvol.region import SceneBounds


@dataclass(frozen=True)
class Target:
    """A model, where it came from and the RUN|FILE that named it; background: RGB in [0, 1]."""

    name: str
    path: Path
    model: Model
    background: tuple[float, ...]

    def orbit(self) -> Mapping[str, Any]:
        """The orbit stored with the model, else that of the run's training cameras, else one that shows the model."""
        from nerfvol.cameras.paths import default_orbit, describe_orbit

        stored = self.model.metadata.get("orbit")
        if isinstance(stored, dict) and {"center", "radius", "elevation_deg"} <= stored.keys():
            return _checked(stored, self.path)
        if found := self._cameras():
            return describe_orbit(found[0], found[1].aabb)
        return default_orbit(self.model.aabb())

    def training_cameras(self) -> Sequence[Camera]:
        """Those of the run's data; none where the run says no data or they are gone."""
        found = self._cameras()
        return found[0] if found else []

    def _cameras(self) -> tuple[list[Camera], SceneBounds] | None:
        """Those of the run's training views, whose pictures nobody asked for, and where its scene is."""
        data = run_settings(self.name).get("data")
        if not data or not Path(data).exists():
            return None
        from nerfvol.datasets.load import dataset_cameras

        return dataset_cameras(data, "train")


_RANGES: dict[str, tuple[float, float]] = {
    "radius": (1e-300, 1e15), "elevation_deg": (-89.999, 89.999), "camera_angle_x": (1e-6, 3.14159), "azimuth_deg": (-1e6, 1e6),
    "arc_deg": (0, 360),
}  # fmt: skip
_VECTORS = {"center": (3, 1e15), "up": (3, 1e15), "size": (2, 16384)}


def _checked(orbit: dict[str, Any], path: Path) -> dict[str, Any]:
    """An orbit that a file states; InputError where one of its fields is not what it should be."""

    def is_number(value: Any, low: float, high: float) -> bool:
        return type(value) in (int, float) and low <= value <= high

    for name, (low, high) in _RANGES.items():
        if name in orbit and not is_number(orbit[name], low, high):
            raise InputError(
                f"{path}: its orbit's {name} is {shown(orbit[name])}, expected a number from {low:g} to {high:g}"
            )
    for name, (length, most) in _VECTORS.items():
        value, least = orbit.get(name), 1 if name == "size" else -most
        if value is None and name != "center":
            continue
        fits = isinstance(value, list) and len(value) == length and all(is_number(x, least, most) for x in value)
        if not fits or (name == "up" and not any(value or ())):
            raise InputError(f"{path}: its orbit's {name} is {shown(value)}, expected {length} numbers up to {most:g}")
    return {name: value for name, value in orbit.items() if value is not None}


def open_target(name: str, background: Sequence[float] | None = None) -> Target:
    """The model of RUN|FILE; ``background``: as given, else the file's, else the run's, else white.

    Raises:
        InputError: there is no such run or file, or it holds no model.
    """
    from nerfvol.models import load_model

    path = model_path(name)
    model = load_model(path)
    candidates = background, model.metadata.get("background"), run_settings(name).get("background"), WHITE
    chosen = next(candidate for candidate in candidates if candidate is not None)
    return Target(name, path, model, coerce(chosen, Colour, "background"))
