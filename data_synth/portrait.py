"""Pictures for people, not for training: framed by what is there, exposed by it, with a filmic curve over a backdrop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from data_synth.cameras import Camera, look_at
from data_synth.errors import InputError
from data_synth.image import Picture, linear_to_srgb

MARGIN = 0.08  # of the picture's side, left free around what is in it
WIDER = 3  # how much wider than the camera a glance is
STRAY = 0.005  # of all alpha: so much of it may lie beyond each edge of what counts, single specks for example
WHITE = 0.98  # part of the opaque pixels that stays below the film's shoulder


def film(x: np.ndarray) -> np.ndarray:
    """Linear light to linear display light: a toe, and a shoulder instead of clipping (Narkowicz 2015, a fit of ACES)."""
    x = np.maximum(x, 0.0)
    return np.clip(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)


def exposure_for(picture: Picture) -> float:
    """The factor that puts the brightest of the opaque pixels, but the last few, on the film's shoulder."""
    straight = picture.rgb[picture.alpha > 0.3] / picture.alpha[picture.alpha > 0.3][:, None]
    if not straight.size or not straight.max() > 0.0:
        return 1.0
    luminance = straight @ np.array([0.2126, 0.7152, 0.0722])
    return float(0.75 / max(np.quantile(luminance, WHITE), 1e-12))


def framed(camera: Camera, alpha: np.ndarray) -> Camera:
    """A camera in the same place that shows what ``alpha``, of any size, seen by ``camera``, holds: in the middle and large."""
    if not alpha.max() > 0.0:
        return camera
    sums = [np.cumsum(alpha.sum(axis=a)) for a in (1, 0)]
    rows, columns = (
        np.flatnonzero((s > STRAY * s[-1]) & (s - np.diff(s, prepend=0) < (1 - STRAY) * s[-1])) for s in sums
    )
    height, width = alpha.shape
    # edges of what is seen on the plane at distance 1
    x = (np.array([columns[0], columns[-1] + 1]) / width - 0.5) * camera.width / camera.focal
    y = -(np.array([rows[0], rows[-1] + 1]) / height - 0.5) * camera.height / camera.focal
    middle = camera.c2w[:3, :3] @ np.array([x.mean(), y.mean(), -1.0])
    corners = [camera.c2w[:3, :3] @ np.array([a, b, -1.0]) for a in x for b in y]
    c2w = look_at(camera.c2w[:3, 3], camera.c2w[:3, 3] + middle)
    seen = np.array([c2w[:3, :3].T @ c for c in corners])
    reach = np.abs(seen[:, :2] / -seen[:, 2:]).max(axis=0)
    focal = (0.5 - MARGIN) * min(camera.width / reach[0], camera.height / reach[1])
    return replace(camera, c2w=c2w, focal=float(focal))


def _frame(camera: Camera, glance: Callable[[Camera], Picture]) -> Camera:
    """``camera`` framed by a glance at three times its field, so that what it cuts off is seen whole.

    What goes on beyond that has no edges to be framed by: it is framed as the camera sees it.
    """
    wide = replace(camera, focal=camera.focal / WIDER)
    small = max(160 / max(camera.width, camera.height), 1 / min(camera.width, camera.height))
    size = [max(int(n * small), 1) for n in (camera.width, camera.height)]
    alpha = glance(replace(wide, width=size[0], height=size[1], focal=wide.focal * small)).alpha
    if max(edge.max() for edge in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1])) < 0.5:
        return framed(wide, alpha) if alpha.max() > 0.0 else camera
    rows, columns = (slice(n // WIDER, max(n - n // WIDER, 1)) for n in alpha.shape)
    return framed(camera, alpha[rows, columns])


def denoised(picture: Picture) -> Picture:
    """The picture without its noise, by Intel's Open Image Denoise: it looks right and is no truth any more.

    InputError where the extra is not installed.
    """
    try:
        import pyoidn  # pyright: ignore[reportMissingImports]  # an extra
    except (ImportError, OSError) as error:
        raise InputError(f"--denoise: expected 'pip install nerfvol[denoise]' to have been done ({error})") from error
    rgb = np.ascontiguousarray(picture.rgb, np.float32)
    alpha = pyoidn.denoise(np.repeat(np.asarray(picture.alpha, np.float32)[..., None], 3, axis=-1))
    clean = pyoidn.denoise(rgb, albedo=np.ascontiguousarray(alpha), hdr=True, clean_aux=True)
    alpha = np.clip(np.asarray(alpha[..., 0], float), 0.0, 1.0)
    return replace(picture, rgb=np.maximum(np.asarray(clean, float), 0.0), alpha=alpha, variance=None)


def backdrop(height: int, width: int) -> np.ndarray:
    """(H, W, 3) linear display light: a wall that is lit from above."""
    y, x = np.mgrid[0:height, 0:width]
    away = np.hypot((x + 0.5) / width - 0.5, (y + 0.5) / height - 0.42)
    level = 0.42 - 0.36 * away**1.3
    return level[..., None] * np.array([0.50, 0.72, 1.0])


def portrait(
    render: Callable[[Camera], Picture], camera: Camera, exposure: float | None = None, denoise: bool = False,
    preview: Callable[[Camera], Picture] | None = None,
) -> np.ndarray:  # fmt: skip
    """(H, W, 3) uint8: what ``camera`` looks at, framed anew. exposure: None for one that suits the picture.

    preview: a quicker way to see the alpha, for framing.
    """
    picture = render(_frame(camera, preview or render))
    if denoise:
        picture = denoised(picture)
    shown = film((exposure_for(picture) if exposure is None else exposure) * picture.rgb)
    pixels = shown + (1.0 - np.clip(picture.alpha, 0, 1)[..., None]) * backdrop(camera.height, camera.width)
    return np.rint(255.0 * linear_to_srgb(pixels)).astype(np.uint8)
