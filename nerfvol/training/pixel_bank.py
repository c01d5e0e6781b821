"""The training pixels that a field in torch draws its rays from; compiled_field.Pixels is the same for the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from nerfvol.datasets.dataset import Dataset


class PixelBank:
    """All training pixels of one image scale, to draw rays from: uint8 colours and shared pixel directions."""

    def __init__(self, dataset: Dataset, background: Sequence[float], downscale: int) -> None:
        images = dataset.pyramid(background, downscale)
        self.colours = torch.from_numpy(np.concatenate([np.asarray(image).reshape(-1, 3) for image in images]))
        sizes = [image.shape[0] * image.shape[1] for image in images]
        self.starts = torch.tensor(np.concatenate([[0], np.cumsum(sizes)]))
        self.intrinsics = [camera.intrinsics.scaled(downscale) for camera in dataset.cameras]
        poses = np.stack([camera.c2w for camera in dataset.cameras])
        self.rotations = torch.tensor(poses[:, :3, :3], dtype=torch.float32)
        self.origins = torch.tensor(poses[:, :3, 3], dtype=torch.float32)

    def rays(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Origins and unit directions (n, 3) of flat pixel numbers over all images; increasing numbers are fastest."""
        image = torch.searchsorted(self.starts, pixels, right=True) - 1
        local = (pixels - self.starts[image]).numpy()
        directions = np.empty((len(local), 3), np.float32)
        for which in np.unique(image.numpy()):
            rows = np.flatnonzero(image.numpy() == which)
            directions[rows] = self.intrinsics[which].directions().reshape(-1, 3)[local[rows]]
        turned = torch.bmm(self.rotations[image], torch.from_numpy(directions)[..., None])[..., 0]
        return self.origins[image], turned

    def sample(self, n_rays: int, generator: torch.Generator) -> tuple[Tensor, Tensor, Tensor]:
        """Random pixels: origins, unit directions and colours in [0, 1], each (n_rays, 3) float32."""
        pixels = torch.randint(len(self.colours), (n_rays,), generator=generator).sort().values
        rays_o, rays_d = self.rays(pixels)
        return rays_o, rays_d, self.colours[pixels].float() / 255
