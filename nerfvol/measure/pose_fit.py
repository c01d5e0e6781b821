"""The pose from which splats look most like a photograph: what scores of refined scenes are given after as well.

Where training moved its cameras, held-out ones still stand where the given poses put them, and a score would measure that.
So each is moved along the loss's gradient too, the splats staying as they are: small pictures first, then larger ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.cameras.motions import Motions
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.kernels import splat_ops
from nerfvol.kernels.splat_state import SplatOptions, SplatState, view_of
from nerfvol.views import SplatModel

REFINED = "refined_poses"
"""Key of a model's metadata: the subject's distance, scene units, where training moved its cameras."""
STEPS = 24
"""On each of the sizes."""
LARGEST, LEAST = 400, 100
"""Pixels along the longer side of the largest and, about, of the smallest pictures."""
PIXELS, DECAY = 0.5, 0.1
"""Of the picture, that a step moves at the start of a size, and the factor at its end."""


def fit_poses(model: SplatModel, dataset: Dataset, background: Sequence[float]) -> list[Camera]:
    """The dataset's cameras where ``model`` looks most like its photographs over ``background`` (3,) in [0, 1]."""
    photographs = Photographs(dataset, background)
    state, distance = SplatState(model.packed), float(model.metadata[REFINED])
    motions = Motions(photographs.cameras, distance)
    options = SplatOptions((float(background[0]), float(background[1]), float(background[2])), ssim=0.03)
    for i, camera in enumerate(photographs.cameras):
        longest = max(camera.intrinsics.width, camera.intrinsics.height)
        for factor in (2**k for k in range(6, -1, -1)):
            if not LEAST / 2 < longest / factor <= max(LARGEST, LEAST):
                continue
            view = photographs.view(i, factor)
            for step in range(STEPS):
                seen = view_of(motions.camera(i, view.camera), state.origin, model.near)
                _, report = splat_ops.loss_gradient(state, seen, view.image, options)
                pixels = PIXELS * DECAY ** (step / STEPS)
                motions.step(i, np.asarray(report.motion), view.camera.intrinsics, pixels)
    for factor in photographs.held:
        photographs.drop(factor)
    return [replace(c, c2w=pose) for c, pose in zip(dataset.cameras, motions.poses, strict=True)]
