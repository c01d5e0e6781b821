"""Small pictures whose bytes tell machines apart: what draws them alike draws everything alike."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.files.pictures import encode_png
from nerfvol.kernels.state import OUTPUTS
from nerfvol.octree.tree import Octree
from nerfvol.splats.splats import Splats
from nerfvol.views import OctreeModel, SplatModel


def pictures() -> bytes:
    """A digest of an octree and of splats of every degree, drawn in every output, and of an encoded PNG; 30 ms."""
    digest = hashlib.sha256()
    camera = Camera(Intrinsics(64, 64, 60.0, 60.0, 32.0, 32.0), look_at((1.1, -1.6, 0.9), (0.0, 0.0, 0.0)))
    for degree in range(4):
        for model in (OctreeModel(_octree(degree)), SplatModel(_splats(degree))):
            image = model.render(camera, (0.2, 0.4, 0.6), OUTPUTS)
            for name in sorted(image):
                digest.update(np.ascontiguousarray(image[name]).tobytes())
            digest.update(encode_png(image["rgb"]))
    return digest.digest()


def _numbers(*shape: int) -> NDArray[np.float32]:
    """Values in [-1, 1) by whole-number arithmetic (Knuth's multiplicative hash): sines differ between processors."""
    count = int(np.prod(shape))
    return (
        ((np.arange(1, count + 1, dtype=np.uint64) * 2654435761 % 2**32) / 2.0**31 - 1.0)
        .reshape(shape)
        .astype(np.float32)
    )


def _octree(degree: int) -> Octree:
    """8^3 leaves, half of them nearly empty."""
    cells = np.indices((8, 8, 8)).reshape(3, -1).T
    octree = Octree.from_leaves(np.full(len(cells), 3), cells, (-0.5, -0.5, -0.5), 1.0, degree)
    octree.density = 6 * _numbers(octree.n_vertices)
    octree.sh = 0.4 * _numbers(*octree.sh.shape)
    return octree


def _splats(degree: int) -> Splats:
    """200 Gaussians of all shapes in a cube."""
    n = 200
    return Splats(
        means=0.5 * _numbers(n, 3),
        log_scales=-3.0 + _numbers(n, 3),
        quats=_numbers(n, 4),
        logits=4.0 * _numbers(n),
        sh=0.4 * _numbers(n, 3, (degree + 1) ** 2),
    )
