"""``nerfvol bench`` on splats and points: frames a second, training steps, loading.

Pictures to train on are the model's own, a little darker, along its orbit. Steps run at rates of zero on a copy, so that every
byte is touched as in training and the splats stay what they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.clouds import PointModel
from nerfvol.defaults import DEFAULT_EARLY_STOP, WHITE
from nerfvol.kernels import ops, splat_ops
from nerfvol.kernels.splat_state import SplatOptions, SplatRates, SplatState, view_of
from nerfvol.measure.bench import median_seconds
from nerfvol.models import load_model
from nerfvol.splats.packing import pack
from nerfvol.views import SplatModel

STILL = SplatRates(means=0.0, log_scales=0.0, quats=0.0, logits=0.0, dc=0.0, sh=0.0)


def measure_loading(path: Path, repeats: int) -> dict[str, float]:
    """Bytes of the file and seconds until it can be rendered (from the system's cache)."""
    return {"bytes": path.stat().st_size, "seconds": median_seconds(lambda _: load_model(path), min(repeats, 3))}


def measure(
    model: SplatModel | PointModel, views: Sequence[list[Camera]], threads: int, repeats: int
) -> list[dict[str, Any]]:
    """Frames a second and milliseconds of a training step at each size, with 1 and all threads, for each build."""
    rows, in_use = [], ops.isa()
    state = SplatState(pack(model.splats))
    try:
        for isa in ops.available_isas():
            if isa != "reference":
                ops.set_isa(isa)
            for count in sorted({1, threads}):
                ops.set_threads(count)
                for cameras in views:
                    rows.append(
                        {
                            "isa": isa,
                            "threads": count,
                            "size": cameras[0].intrinsics.width,
                            "frames_per_second": 1.0 / _frame_seconds(model, cameras, repeats),
                            "train_step_ms": 1e3 * _step_seconds(state, model.near, cameras, repeats),
                        }
                    )
    finally:
        if in_use != "reference":
            ops.set_isa(in_use)
        ops.set_threads(threads)
    return rows


def _frame_seconds(model: SplatModel | PointModel, cameras: Sequence[Camera], repeats: int) -> float:
    def frame(index: int) -> object:
        return model.render(cameras[index % len(cameras)], WHITE, ("rgb",), DEFAULT_EARLY_STOP)

    return median_seconds(frame, repeats)


def _step_seconds(state: SplatState, near: float, cameras: Sequence[Camera], repeats: int) -> float:
    views = [view_of(camera, state.origin, near) for camera in cameras]
    images = []
    for view in views:
        rgb = splat_ops.render_splats(state.packed, view, WHITE, DEFAULT_EARLY_STOP, ("rgb",))["rgb"]
        images.append(splat_ops.pad_image(np.round(255 * np.clip(0.9 * rgb, 0, 1)).astype(np.uint8)))
    options = SplatOptions(WHITE, ssim=0.02)

    def step(index: int) -> object:
        k = index % len(views)
        return splat_ops.train_step(state, views[k], images[k], options, STILL)

    return median_seconds(step, repeats)
