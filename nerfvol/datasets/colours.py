"""Which colours a picture's numbers stand for. Models are made of sRGB; what states other colours is converted to it.

A file states them by an ICC profile (Display P3 of phones, Adobe RGB of cameras, inks), by a PNG's code points, gamma and
primaries (primaries.py), or as cameras mark Adobe RGB in EXIF. A profile that maps colours as sRGB does, whatever
its name, changes no bit. Sources: docs/data.md.
"""

from __future__ import annotations

import functools
import io
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nerfvol.datasets.primaries import SRGB, UNSPECIFIED, Matrix, code_points, is_srgb, named, to_srgb

SAME = 2
"""Levels of 255 by which a profile's colours may differ from sRGB's and still be those: profiles are rounded."""
_PNG_GAMMA, _NEAR = 1 / 2.2, 0.03
_GAMMAS = (0.1, 10)
"""Beyond which a PNG's gamma is a mistake: it would make pictures black or white."""
_ADOBE = ((1.39835574, -0.39835574, 0.0), (0.0, 1.0, 0.0), (0.0, -0.04292933, 1.04292933))
"""Linear Adobe RGB (1998) to linear sRGB: both have D65's white and, but for green, the same primaries."""
_ADOBE_GAMMA = 2.19921875
_FINE = 1 << 14
"""Steps of linear light, of which the darkest are a fifth of a level of sRGB."""
_WITH_ALPHA = ("RGBA", "LA", "PA", "RGBa", "La")
_EXIF_DETAILS, _EXIF_COLOURS, _EXIF_INTEROP = 0x8769, 0xA001, 0xA005


@dataclass(frozen=True)
class Colours:
    """Colours that are not sRGB's. ``name``: for sentences. ``profile``: ICC; else values to the power ``gamma`` are linear
    light, which ``matrix`` makes sRGB's; without a gamma their curve is sRGB's. None of the three: no conversion
    is known."""

    name: str
    profile: bytes | None = None
    gamma: float | None = None
    matrix: Matrix | None = None

    @property
    def is_known(self) -> bool:
        """Whether pictures can be converted."""
        return not (self.profile is None and self.gamma is None and self.matrix is None)

    def to_srgb(self, image: Image.Image) -> Image.Image:
        """The picture as RGB or RGBA in sRGB; as it is where no conversion is known."""
        if self.profile is not None:
            return _by_profile(self.profile, image)
        if not self.is_known:
            return image
        pixels, values = np.array(_plain(image)), np.arange(256) / 255
        light = (_decoded(values) if self.gamma is None else values**self.gamma).astype(np.float32)
        if self.matrix is None:
            pixels[..., :3] = _encoded(light)[pixels[..., :3]]
            return Image.fromarray(pixels)
        matrix = np.array(self.matrix, np.float32).T
        band = max(1, (1 << 16) // pixels.shape[1])  # rows whose floats stay in the processor's cache
        for top in range(0, len(pixels), band):
            rows = pixels[top : top + band, :, :3]
            mixed = light[rows] @ matrix
            rows[:] = _fine_encoded()[(np.clip(mixed, 0, 1) * _FINE + np.float32(0.5)).astype(np.int32)]
        return Image.fromarray(pixels)


def colours_of(image: Image.Image) -> Colours | None:
    """The colours of an opened picture, from its header alone; None where they are sRGB's, or nothing is stated."""
    codes = code_points(image)
    if codes is not None and codes[:2] != (UNSPECIFIED, UNSPECIFIED):  # goes before all others
        found = named(codes)
        return found and Colours(found[0], gamma=found[1], matrix=found[2])
    profile = image.info.get("icc_profile")
    if isinstance(profile, bytes) and profile:
        return _of_profile(profile, image.mode)
    if image.format == "PNG" and "srgb" not in image.info:
        return _of_numbers(image.info.get("gamma"), image.info.get("chromaticity"))
    if image.format in ("JPEG", "MPO") and "exif" in image.info and _says_adobe(image):
        return Colours("Adobe RGB, by EXIF", gamma=_ADOBE_GAMMA, matrix=_ADOBE)
    return Colours("inks (CMYK) without a profile") if image.mode == "CMYK" else None


def _of_numbers(gamma: Any, places: Any) -> Colours | None:
    """Of a PNG's gAMA and cHRM."""
    name, known = "", None
    if isinstance(gamma, float) and gamma > 0 and abs(gamma - _PNG_GAMMA) >= _NEAR:
        name, known = f"a gamma of {gamma:.3g}", 1 / gamma
        if not _GAMMAS[0] <= gamma <= _GAMMAS[1]:
            return Colours(name)
    if not isinstance(places, tuple) or len(places) != len(SRGB) or is_srgb(places):  # some decoders hand on any number
        return Colours(name, gamma=known) if name else None
    red = f"{places[2]:.3g} {places[3]:.3g}"
    name = f"{name} and " * bool(name) + f"primaries of their own (red at {red}, by cHRM)"
    matrix = to_srgb(places)
    return Colours(name) if matrix is None else Colours(name, gamma=known, matrix=matrix)


def _says_adobe(image: Image.Image) -> bool:
    """Design rule for Camera File systems 2.0: colours that are not calibrated, and the interoperability R03."""
    exif = image.getexif()
    details: dict[int, Any] = exif.get_ifd(_EXIF_DETAILS)
    if details.get(_EXIF_COLOURS) == 2:  # as some cameras say it
        return True
    mark = exif.get_ifd(_EXIF_INTEROP).get(1) if details.get(_EXIF_COLOURS) == 0xFFFF else None
    return str(mark).strip("\0 ") == "R03"


@functools.cache
def _fine_encoded() -> NDArray[np.uint8]:
    return _encoded(np.arange(_FINE + 1) / _FINE)


def _decoded(values: NDArray[np.floating]) -> NDArray[np.floating]:
    """sRGB's values in [0, 1] as linear light."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def _encoded(light: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Linear light as sRGB's 8 bits (IEC 61966-2-1)."""
    light = np.clip(light, 0, 1)
    values = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return (255 * values + 0.5).astype(np.uint8)


@functools.lru_cache(maxsize=64)
def _of_profile(profile: bytes, mode: str) -> Colours | None:
    from PIL import ImageCms

    try:
        said = ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))
        _transform(profile, _for_profile(Image.new(mode, (1, 1)), profile).mode)
        if _space(profile) in ("RGB", "GRAY") and _is_srgb(profile):
            return None
    except Exception:  # whatever lcms makes of damaged bytes, or of a profile for other numbers than the picture's
        return Colours("a colour profile that cannot be used")
    return Colours(" ".join(said.split())[:60] or "unnamed", profile)


@functools.lru_cache(maxsize=64)
def _space(profile: bytes) -> str:
    """What the profile's numbers are: RGB, GRAY, CMYK, ..."""
    from PIL import ImageCms

    opened: Any = ImageCms.ImageCmsProfile(io.BytesIO(profile))
    return opened.profile.xcolor_space.strip()


def _is_srgb(profile: bytes) -> bool:
    steps = np.linspace(0, 255, 6).round().astype(np.uint8)
    grid = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(6, -1, 3)
    if _space(profile) == "GRAY":
        grid = np.arange(256, dtype=np.uint8)[None]
    found = np.asarray(_by_profile(profile, Image.fromarray(grid))).astype(int)
    return bool(np.abs(found - np.atleast_3d(grid)).max() <= SAME)


def _by_profile(profile: bytes, image: Image.Image) -> Image.Image:
    from PIL import ImageCms

    ready = _for_profile(image, profile)
    made = ImageCms.applyTransform(ready, _transform(profile, ready.mode))
    assert made is not None
    if ready.mode == "L" and (whole := _plain(image)).mode == "RGBA":  # grey profiles have no alpha of their own
        made.putalpha(whole.getchannel("A"))
    return made


def _for_profile(image: Image.Image, profile: bytes) -> Image.Image:
    """The picture in the mode that the profile is for."""
    space = _space(profile)
    if space == "GRAY" and (image.mode in ("1", "L", "LA") or image.mode.startswith("I")):
        return Image.fromarray(eight_bits(image)) if image.mode.startswith("I") else image.convert("L")
    if space == "CMYK" and image.mode == "CMYK":
        return image
    if space == "RGB" and image.mode not in ("CMYK", "LAB"):
        return _plain(image)
    raise ValueError(f"a profile of {space} for a picture of mode {image.mode}")


def _plain(image: Image.Image) -> Image.Image:
    """The picture as RGB, or as RGBA where it has transparency."""
    if image.mode.startswith("I"):
        image = Image.fromarray(eight_bits(image))
    wanted = "RGBA" if image.mode in _WITH_ALPHA or "transparency" in image.info else "RGB"
    return image if image.mode == wanted else image.convert(wanted)


def eight_bits(image: Image.Image) -> NDArray[np.uint8]:
    """A grey picture of 16 bits, of mode I;16 or as older Pillows call it, reduced to 8: (h, w)."""
    return ((np.asarray(image).astype(np.uint32) + 128) // 257).astype(np.uint8)


@functools.lru_cache(maxsize=64)
def _transform(profile: bytes, mode: str) -> Any:
    from PIL import ImageCms

    return ImageCms.buildTransform(
        ImageCms.ImageCmsProfile(io.BytesIO(profile)), _srgb(), mode, "RGBA" if mode == "RGBA" else "RGB",
        ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )  # fmt: skip


@functools.cache
def _srgb() -> Any:
    from PIL import ImageCms

    return ImageCms.createProfile("sRGB")
