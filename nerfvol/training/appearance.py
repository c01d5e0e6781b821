"""Photographs of different exposure and white balance: a colour map for each, solved in closed form while a run goes on.

Photograph i shows G_i of the scene's colours, a 3x4 map. They begin as gains, from what the photographs share
(starts.exposures), and at a few moments of a run they are fitted to what the model shows of each view, in small pictures;
training sees G_i^-1 of the photograph, while kernels know nothing of it.
Scene and maps have a gauge: all maps times one, the scene by its inverse, is the same pictures. So the maps are divided by
their mean, exactly: the mean map is the identity, and the scene has the photographs' mean exposure.

Maps are used where exposures differ by more than SPREAD; else photographs stay as they are, bit for bit. Photographs say so
themselves before the start; only where they share too little to be compared the model is asked, once it shows enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.averages import area_average
from nerfvol.datasets.dataset import Dataset, evenly
from nerfvol.datasets.images import UInt8
from nerfvol.measure.colour_fit import IDENTITY, SATURATED, apply_map, compose, exposure, fit_colour_map, inverse
from nerfvol.starts.exposures import Exposures

MOMENTS = (0.05, 0.1, 0.16, 0.23, 0.33, 0.45, 0.6, 0.8)
"""Of a run's progress, at which maps are fitted."""
SPREAD = 0.08
"""Standard deviation of the exposures, as factors, from which on maps are used (uniform within 14 % to either side). Below, a
model's view dependence takes them up as well: at 5 % (a cup photographed by a phone) maps gain 0.4 dB after a
fit and lose 1.1 plainly."""
LEAST_SHOWN = 0.6
"""Share of a photograph's variance that the model must show, in the median, before exposures are asked for: fog would take the
bright side of a thing for an exposure."""
FIRST_ASKED = 8
"""Photographs, evenly chosen, of which that is asked first: drawing all of them in fog would take a short run's seconds."""
ASKED_FOR_SPREAD = 24
"""... of which it is asked next whether exposures differ at all: the rest are drawn only where these do by half of SPREAD. With
a spread of SPREAD so many show less than half of it once in 10,000 times (chi-squared of 23 degrees below 23 / 4)."""
AGREEMENT = 0.6
"""Correlation of the exposures of left and right halves from which on these are the photographs' own."""
SURE = 0.5
"""Of the spread: the most that pairs of photographs may err by for their exposures to be believed."""
BRIGHTER = 1.02
"""Exposure of a photograph from which on its saturated pixels, which may be anything from there on, are left out."""
FITTED_WIDTH = 50
"""Pixels along the longer side that a picture has at least when its map is fitted."""
LARGEST_FACTOR = 8
OPAQUE = 0.999
"""Pixels with transparency whose colour is the thing's alone: these have a colour map fitted."""
Mode = Literal["auto", "on", "off"]

Look = tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]
"""A view's photograph (h, w, 3), what the model shows there (h, w, 3), both in [0, 1], and weights (h, w)."""
Seen = Callable[[int], Look]
"""Index of a view -> its look."""


class Appearance:
    """The colour maps of a run's photographs.

    ``maps``: (n, 3, 4), scene to photograph; their mean is the identity. ``rounds``: fits made so far. ``active``: whether
    photographs are corrected. ``decided``: whether the model has shown enough to tell.
    """

    def __init__(self, n: int, mode: Mode = "auto") -> None:
        self.maps = np.repeat(IDENTITY[None], n, axis=0)
        self.mode: Mode = mode
        self.rounds, self.active, self.decided = 0, False, False
        self._to_scene = self.maps.copy()

    def begin(self, measured: Exposures | None) -> None:
        """Takes what was measured before the start; None: nothing could be, the model will be asked."""
        if measured is None or self.mode == "off":
            return
        self.decided = True
        sure = measured.spread > SPREAD and measured.error < SURE * measured.spread
        if sure or self.mode == "on":
            maps = np.repeat(IDENTITY[None], len(self.maps), axis=0)
            maps[:, range(3), range(3)] = measured.gains
            self._use(centred(maps))

    def go_on_from(self, other: Appearance) -> None:
        """Takes the maps, and the decision for or against them, that ``other`` came to with another model of the photographs;
        where they are used they will be fitted to the model at hand as well."""
        self.decided = other.decided
        if other.active:
            self._use(other.maps.copy())

    def due(self, progress: float) -> bool:
        """Whether a fit is due at ``progress`` in [0, 1]; once it was decided that exposures are even, none is."""
        return self.may_change and progress >= MOMENTS[self.rounds]

    @property
    def may_change(self) -> bool:
        """Whether photographs will be asked for again because of a fit to come."""
        return self.mode != "off" and self.rounds < len(MOMENTS) and (self.active or not self.decided)

    def fit(self, seen: Seen, progress: float) -> bool:
        """Fits all maps to what the model shows now; whether photographs are corrected from here on."""
        while self.rounds < len(MOMENTS) and progress >= MOMENTS[self.rounds]:
            self.rounds += 1  # a run on a clock may jump over moments
        needs_sight = self.active or self.mode == "auto"
        first = evenly(len(self.maps), FIRST_ASKED) if needs_sight and len(self.maps) > FIRST_ASKED else []
        looked = {i: seen(i) for i in first}
        if looked and not _shows_enough(list(looked.values())):
            return False
        if not self.active and self.mode == "auto" and len(self.maps) > ASKED_FOR_SPREAD:
            asked = map(seen, scattered(len(self.maps), ASKED_FOR_SPREAD))  # one in memory at a time
            shares, sides = zip(*((_share_shown(look), halves_of(*look)) for look in asked), strict=True)
            if np.median(shares) < LEAST_SHOWN:
                return False
            if common_spread(np.array(sides)) < SPREAD / 2:
                self.decided = True
                return False
        fitted, halves, explained = [], [], []
        for i in range(len(self.maps)):  # all at once would be as much memory as their photographs
            photograph, shown, weight = looked[i] if i in looked else seen(i)
            fitted.append(fit_colour_map(shown, photograph, weight))
            explained.append(share_explained(fitted[-1], shown, photograph, weight))
            if not self.active:
                halves.append(halves_of(photograph, shown, weight))
        if needs_sight and np.median(explained) < LEAST_SHOWN:
            return False
        if not self.active and self.mode == "auto":
            self.decided = True
            if not exposures_differ(np.array(halves)):
                return False
        self._use(centred(np.stack(fitted)))
        return True

    def _use(self, maps: NDArray[np.float64]) -> None:
        self.maps, self.active = maps, True
        self._to_scene = np.stack([inverse(m) for m in maps])

    def corrected(self, i: int, image: UInt8) -> UInt8:
        """Photograph i (h, w, 3 or 4) as the scene's colours; itself where nothing is corrected.

        Of four channels the last is the pixel's weight and becomes 0 where a photograph brighter than the others is saturated.
        """
        if not self.active:
            return image
        return self._mapped(i, image, masks=True)

    def corrected_colours(self, i: int, image: UInt8) -> UInt8:
        """The same with the fourth channel, an opacity, as it is."""
        return self._mapped(i, image, masks=False) if self.active else image

    def _mapped(self, i: int, image: UInt8, masks: bool) -> UInt8:
        m = self._to_scene[i].astype(np.float32)
        flat = image.reshape(-1, image.shape[2])
        values = flat[:, :3] @ m[:, :3].T
        values += 255 * m[:, 3] + 0.5
        np.clip(values, 0, 255, out=values)
        out = flat.copy()
        out[:, :3] = values
        if masks and image.shape[2] == 4 and exposure(self.maps[i]) > BRIGHTER:
            out[(flat[:, :3] >= 255 * SATURATED).any(1), 3] = 0
        return out.reshape(image.shape)

    def exposures(self) -> NDArray[np.float64]:
        """Exposure of each photograph against their mean, a factor (n,)."""
        return np.array([exposure(m) for m in self.maps])

    def sentence(self) -> str:
        """For a person, once maps are used."""
        low, high = self.exposures().min(), self.exposures().max()
        return (
            f"the photographs' exposures differ ({low:.2f} to {high:.2f} of the mean): each gets a colour map; scores are "
            "given plain and after the same fit (--appearance off: none)"
        )

    def state_dict(self) -> dict[str, Any]:
        """What a continuation needs."""
        return {"maps": self.maps, "rounds": self.rounds, "active": int(self.active), "decided": int(self.decided)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continues from :meth:`state_dict`; ValueError where it does not fit."""
        maps = np.array(state["maps"], np.float64)
        if maps.shape != self.maps.shape or not np.isfinite(maps).all():
            raise ValueError(f"colour maps {maps.shape} for {len(self.maps)} photographs")
        self.rounds, self.decided = int(state["rounds"]), bool(state["decided"])
        if int(state["active"]):
            self._use(maps)


def scattered(n: int, most: int) -> list[int]:
    """``most`` of n >= ``most`` places in order, one of each ``most``-th part: where in it the golden ratio's multiples say.

    Places at one distance would all be of one exposure where these take turns: brackets, or two cameras side by side.
    """
    k, parts = np.arange(most), np.arange(most + 1) * n // most
    return (parts[:-1] + (k * (math.sqrt(5) - 1) / 2 % 1 * np.diff(parts)).astype(int)).tolist()


def centred(maps: NDArray[np.float64]) -> NDArray[np.float64]:
    """The maps (n, 3, 4) after one common map of the scene's colours, so that their mean is the identity."""
    undo = inverse(maps.mean(0))
    return np.stack([compose(m, undo) for m in maps])


def _shows_enough(looked: Sequence[Look]) -> bool:
    """Whether the model shows enough of these views for their exposures to be asked for."""
    return bool(np.median([_share_shown(look) for look in looked]) >= LEAST_SHOWN)


def _share_shown(look: Look) -> float:
    photograph, shown, weight = look
    return share_explained(fit_colour_map(shown, photograph, weight), shown, photograph, weight)


def halves_of(
    photograph: NDArray[np.floating], shown: NDArray[np.floating], weight: NDArray[np.floating]
) -> list[float]:
    """The exposures of the left and the right half of a look."""
    middle = photograph.shape[1] // 2
    sides = (np.s_[:, :middle], np.s_[:, middle:])
    return [exposure(fit_colour_map(shown[side], photograph[side], weight[side])) for side in sides]


def exposures_differ(halves: NDArray[np.float64]) -> bool:
    """Whether photographs differ in exposure by more than SPREAD: ``halves`` (n, 2) are those of their left and right halves.

    An exposure is one for both halves; where the model shows too little so early in a run, each half errs by itself. So the
    spread is the root of their covariance, and they must agree.
    """
    own = np.std(halves / halves.mean(0), axis=0, ddof=1) if len(halves) > 2 else np.zeros(2)
    spread = common_spread(halves)
    return bool(spread > SPREAD and spread**2 > AGREEMENT * max(float(own.prod()), 1e-30))


def common_spread(halves: NDArray[np.float64]) -> float:
    """The standard deviation of exposures that both halves (n, 2) show, as factors; 0 of two photographs, or where they
    contradict each other."""
    together = np.cov((halves / halves.mean(0)).T)[0, 1] if len(halves) > 2 else 0.0
    return float(np.sqrt(max(together, 0.0)))


def share_explained(
    colour_map: NDArray[np.float64],
    shown: NDArray[np.floating],
    photograph: NDArray[np.floating],
    weight: NDArray[np.floating],
) -> float:
    """Of the variance of a photograph (h, w, 3), the share that the model shows after the colour map."""
    w = np.asarray(weight, np.float64)[..., None]
    total = max(float(w.sum()), 1e-12)
    mean = (w * photograph).sum((0, 1)) / total
    left = float((w * (apply_map(colour_map, shown) - photograph) ** 2).sum())
    return 1 - left / max(float((w * (photograph - mean) ** 2).sum()), 1e-12)


def fitting_factor(width: int, height: int) -> int:
    """The power of two by which a picture is reduced before its map is fitted."""
    factor = LARGEST_FACTOR
    while factor > 1 and max(width, height) / factor < FITTED_WIDTH:
        factor //= 2
    return factor


def small_picture(
    dataset: Dataset, i: int, picture: Callable[[Camera], NDArray[np.floating]]
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[Any]]:
    """What Seen says of view ``i``, where ``picture`` draws the model."""
    camera, image = dataset.cameras[i], dataset.images[i]
    k = fitting_factor(camera.intrinsics.width, camera.intrinsics.height)
    small = area_average(image, k).astype(np.float32) / 255
    shown = picture(camera.scaled(k))
    weight = small[..., 3] > OPAQUE if small.shape[2] == 4 else np.ones(shown.shape[:2])
    return small[..., :3], shown, weight
