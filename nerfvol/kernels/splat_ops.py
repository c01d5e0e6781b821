"""The operators on Gaussian splats, on numpy arrays: argument checks, and the choice between compiled kernels and reference.

What is computed: ``splat_reference``. Threads and instruction sets are those of ``ops``.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.defaults import WHITE
from nerfvol.kernels.checks import check_background, check_early_stop, check_outputs
from nerfvol.kernels.splat_state import SplatOptions, SplatRates, SplatReport, SplatState, SplatView, view_of
from nerfvol.kernels.state import OUTPUTS
from nerfvol.kernels.threads import WITHOUT_KERNELS
from nerfvol.native import aligned_empty, native, need_torch
from nerfvol.splats.packing import PackedSplats, as_packed, unpack
from nerfvol.splats.splats import Splats

__all__ = [
    "OUTPUTS", "SplatOptions", "SplatRates", "SplatReport", "SplatState", "SplatView", "loss_gradient", "pad_image",
    "render_points", "render_splats", "train_step", "view_of",
]  # fmt: skip

TILE = 16
"""Images of training are padded to multiples of this many pixels."""


def _on_torch() -> ModuleType:
    need_torch(WITHOUT_KERNELS)
    from nerfvol.kernels import splat_on_torch

    return splat_on_torch


def _kernel_view(view: SplatView) -> Any:
    compiled = native()
    assert compiled is not None
    lens = [float(x) for x in (view.fx, view.fy, view.cx, view.cy)]
    pose = (view.rotation.ravel().tolist(), view.translation.tolist(), view.eye.tolist())
    return compiled.SplatView(*pose, lens, float(view.near), int(view.width), int(view.height))


def render_splats(
    splats: Splats | PackedSplats,
    view: SplatView,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = 1e-4,
    outputs: Sequence[str] = ("rgb",),
) -> dict[str, NDArray[np.float32]]:
    """Renders a picture of splats.

    Returns float32 arrays for the names in ``outputs``: rgb (H, W, 3) over ``background``, opacity 1 - T (H, W), depth
    sum_i w_i t_i (H, W), median_depth (H, W) the distance where T falls to 1/2 (0 where it does not), normal (H, W, 3)
    the weighted mean of the splats' shortest axes, turned to the viewer. Distances in scene units along the pixel's ray,
    to the plane through the mean that faces the camera. A pixel ends when T < early_stop_eps; 0 is exact. Raises ValueError
    where background, threshold or outputs are not what they should be.
    """
    bg, eps = _checked(background, early_stop_eps, outputs)
    if native() is None:
        return _on_torch().render_splats(splats, view, bg, eps, outputs)
    return _draw(as_packed(splats), view, bg, eps, outputs, surfaces=False)


def render_points(
    splats: Splats | PackedSplats,
    view: SplatView,
    background: Sequence[float] = WHITE,
    early_stop_eps: float = 1e-4,
    outputs: Sequence[str] = ("rgb",),
) -> dict[str, NDArray[np.float32]]:
    """As :func:`render_splats`, of splats of degree 0 that are points of surfaces: what is at one depth is averaged.

    What is computed: ``point_reference``. The same bits for any number of threads. Raises ValueError as render_splats, and
    where the splats have more than one colour.
    """
    bg, eps = _checked(background, early_stop_eps, outputs)
    packed = as_packed(splats)
    if packed.basis != 1:
        raise ValueError(f"points have one colour each, got spherical harmonics of degree {packed.sh_degree}")
    if native() is None:
        need_torch(WITHOUT_KERNELS)
        from nerfvol.kernels.point_reference import render_surfaces

        drawn = render_surfaces(unpack(packed), view, bg, eps)
        return {name: drawn[name] for name in OUTPUTS if name in outputs}
    return _draw(packed, view, bg, eps, outputs, surfaces=True)


def _checked(background: Sequence[float], early_stop_eps: float, outputs: Sequence[str]) -> tuple[list[float], float]:
    """Background and threshold as the kernels take them; ValueError where they or the outputs' names are wrong."""
    check_outputs(outputs)
    return check_background(background), check_early_stop(early_stop_eps)


def _draw(
    packed: PackedSplats, view: SplatView, bg: Sequence[float], eps: float, outputs: Sequence[str], surfaces: bool
) -> dict[str, NDArray[np.float32]]:
    compiled = native()
    assert compiled is not None
    shape = (view.height, view.width)
    out = {k: np.empty((*shape, 3) if k in ("rgb", "normal") else shape, np.float32) for k in OUTPUTS if k in outputs}
    arrays = (out.get(name) for name in OUTPUTS)
    compiled.splat_render(packed.params, packed.n, packed.mode == "mip", _kernel_view(view), bg, eps, *arrays, surfaces)
    return out


def pad_image(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(H16, W16, 4) uint8: ``image`` (H, W, 3 or 4) padded to multiples of 16 by pixels of weight 0; RGB gets weight 255.

    Raises ValueError where the image is not uint8 of that shape.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[2] not in (3, 4) or image.dtype != np.uint8:
        raise ValueError(f"an image must be uint8 (H, W, 3 or 4), got {image.dtype} {image.shape}")
    height, width, channels = image.shape
    out = np.zeros((-(-height // TILE) * TILE, -(-width // TILE) * TILE, 4), np.uint8)
    out[:height, :width, 3] = 255
    out[:height, :width, :channels] = image
    return out


def _check_image(view: SplatView, image: np.ndarray) -> NDArray[np.uint8]:
    shape = (-(-view.height // TILE) * TILE, -(-view.width // TILE) * TILE, 4)
    if image.shape != shape or image.dtype != np.uint8:
        raise ValueError(
            f"the image must be uint8 {shape}, padded to multiples of {TILE}, got {image.dtype} {image.shape}"
        )
    return np.ascontiguousarray(image)


def _kernel_settings(options: SplatOptions, rates: SplatRates) -> tuple[Any, Any]:
    """Both as the kernels' classes, field by field."""
    compiled = native()
    assert compiled is not None
    out = compiled.SplatLoss(), compiled.SplatRates()
    for given, made in zip((options, rates), out, strict=True):
        for name, value in vars(given).items():
            setattr(made, name, check_background(value) if name == "background" else float(value))
    return out


def _check_settings(options: SplatOptions, rates: SplatRates) -> None:
    check_background(options.background)
    check_early_stop(options.early_stop_eps)
    numbers = [v for s in (options, rates) for k, v in vars(s).items() if k != "background"]
    if not np.isfinite(numbers).all() or min(numbers) < 0:
        raise ValueError(f"weights of the loss and rates must be finite and not negative, got {options}, {rates}")
    if not (0 <= rates.beta1 < 1 and 0 < rates.beta2 < 1 and rates.eps > 0):
        raise ValueError(
            f"Adam needs 0 <= beta1 < 1, 0 < beta2 < 1 and eps > 0, got {rates.beta1}, {rates.beta2}, {rates.eps}"
        )


def train_step(
    state: SplatState,
    view: SplatView,
    image: NDArray[np.uint8],
    options: SplatOptions,
    rates: SplatRates,
    motion: bool = False,
) -> SplatReport:
    """One Adam step on ``state`` in place, for one view.

    image: (H16, W16, 4) uint8, see :func:`pad_image`; straight colours, alpha / 255 is the pixel's weight in the loss.
    motion: the report has the gradient in the camera's motion as well, before the step; it costs a few per cent.
    Only splats that the view hits are changed, moments included. Bitwise the same for any number of threads.
    """
    image = _check_image(view, image)
    _check_settings(options, rates)
    state.check()
    if native() is None:
        return _on_torch().train_step(state, view, image, options, rates, motion)
    return _step(state, view, image, options, rates, None, motion)


def loss_gradient(
    state: SplatState, view: SplatView, image: NDArray[np.uint8], options: SplatOptions
) -> tuple[NDArray[np.float32], SplatReport]:
    """Gradient of the loss in ``state.params`` (n_blocks, rows, 16), 0 where a splat was not hit; changes nothing.

    The report has the gradient in the camera's motion as well.
    """
    image, rates = _check_image(view, image), SplatRates()
    _check_settings(options, rates)
    state.check()
    gradient = aligned_empty(state.params.shape, np.float32)
    gradient[...] = 0
    if native() is None:
        return _on_torch().loss_gradient(state, view, image, options)
    return gradient, _step(state, view, image, options, rates, gradient, True)


def _step(
    state: SplatState,
    view: SplatView,
    image: np.ndarray,
    options: SplatOptions,
    rates: SplatRates,
    gradient: np.ndarray | None,
    motion: bool,
) -> SplatReport:
    compiled = native()
    assert compiled is not None
    arrays = (state.params, state.n, state.mode == "mip", state.first, state.second, state.updates)
    statistics = (state.error, state.max_weight, state.seen)
    settings = _kernel_settings(options, rates)
    r = compiled.splat_step(*arrays, *statistics, _kernel_view(view), image, *settings, gradient, motion)
    return SplatReport(r.loss, r.squared_error, r.visible, r.entries, r.blocks, tuple(r.motion) if motion else None)
