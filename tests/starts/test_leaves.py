"""Octrees around splats: a leaf wherever a Gaussian is and nowhere else, as fine as the Gaussians, each place once."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at, orbit
from nerfvol.errors import InputError
from nerfvol.native import native
from nerfvol.region import SceneBounds
from nerfvol.rotations import rotations
from nerfvol.splats.splats import Splats
from nerfvol.starts import leaves
from nerfvol.starts.leaves import BLUR, FAINTEST, PIXELS, SCALES, SPACING, WIDEST, _pixel_squares, octree_around

SCENE = SceneBounds(np.array([[-1.0] * 3, [1.0] * 3]), None, False)


def random_splats(n: int, scale: tuple[float, float], seed: int = 0) -> Splats:
    random = np.random.default_rng(seed)
    opacity = random.uniform(0.02, 0.98, n)
    return Splats(
        random.uniform(-0.8, 0.8, (n, 3)), random.uniform(*np.log(scale), (n, 3)), random.normal(size=(n, 4)),
        np.log(opacity / (1 - opacity)), random.normal(0, 0.3, (n, 3, 4)), np.array([0.05, 0, -0.05]),
    )  # fmt: skip


def test_a_leaf_for_every_gaussian_and_none_without():
    """A leaf holds a sample of an ellipsoid: its middle is within half its diagonal of one, along every axis."""
    splats = random_splats(60, (0.03, 0.06))
    octree = octree_around(splats, SCENE, [], 5)
    octree.validate()
    means = splats.means + splats.origin
    assert (octree.query(means) >= 0).all()
    opacity = 1 / (1 + np.exp(-splats.logits.astype(float)))
    reach = np.minimum(np.sqrt(2 * np.log(np.maximum(opacity / FAINTEST, 1))), WIDEST)
    # Cells were found at their Gaussian's level, at most twice the side of the finest leaf here.
    diagonal = np.sqrt(3) / 2 * octree.leaf_sizes().max()
    own = np.einsum("gij,lgi->lgj", rotations(splats.quats), octree.leaf_centers()[:, None] - means)
    wide = reach[:, None] * np.hypot(np.exp(splats.log_scales.astype(float)), BLUR * octree.leaf_sizes().max())
    near = (np.abs(own) <= wide + diagonal).all(2)
    assert near.any(1).all() and near.any(0).all()


def test_ellipsoids_are_filled():
    """Samples of an ellipsoid are SPACING leaves apart, so that none of its points is farther from one than the diagonal of
    their lattice; and every sample is in a leaf."""
    splats = random_splats(40, (0.02, 0.1), seed=1)
    octree = octree_around(splats, SCENE, [], 6)
    random = np.random.default_rng(0)
    ball = random.normal(size=(60, 3))
    ball *= (random.random(60) ** (1 / 3) / np.linalg.norm(ball, axis=1))[:, None]
    opacity = 1 / (1 + np.exp(-splats.logits.astype(float)))
    reach = np.minimum(np.sqrt(2 * np.log(np.maximum(opacity / FAINTEST, 1))), WIDEST)
    scales = np.exp(splats.log_scales.astype(float))
    own = ball[None] * (reach[:, None] * scales)[:, None]
    points = own @ rotations(splats.quats).transpose(0, 2, 1) + (splats.means + splats.origin)[:, None]
    side = 2 / 2.0 ** np.clip(np.round(np.log2(2 / (SCALES * np.sort(scales, 1)[:, 1]))), 3, 6)
    steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * 3, indexing="ij"), -1).reshape(-1, 3)
    around = points[:, :, None] + steps * (np.sqrt(3) * SPACING * side)[:, None, None, None]
    found = (octree.query(around.reshape(-1, 3)) >= 0).reshape(around.shape[:3]).any(2)
    assert found[(np.abs(points) < 1).all(2)].all()
    assert (octree.query(points.reshape(-1, 3)) >= 0).mean() > 0.97


def test_leaves_are_as_fine_as_gaussians_or_pixels():
    fine, coarse = random_splats(50, (0.006, 0.007)), random_splats(50, (0.05, 0.06), seed=3)
    levels = [np.bincount(octree_around(s, SCENE, [], 9).leaf_level).argmax() for s in (fine, coarse)]
    assert levels[0] >= levels[1] + 3
    cameras = orbit(4, center=(0, 0, 0), radius=4, elevation_deg=10, intrinsics=Intrinsics(100, 100, 120, 120, 50, 50))
    nearest = min(np.linalg.norm(fine.means + fine.origin - c.position, axis=1).min() for c in cameras)
    octree = octree_around(fine, SCENE, cameras, 9)
    # Rounded to a power of two.
    assert octree.leaf_sizes().min() >= PIXELS * nearest / 120 / np.sqrt(2)


def test_splats_outside_the_region():
    splats = random_splats(30, (0.03, 0.05))
    splats.means[:10] += 5
    assert (octree_around(splats, SCENE, [], 5).query((splats.means + splats.origin)[10:]) >= 0).all()
    splats.means[:] += 5
    with pytest.raises(InputError, match="none of the 30 splats"):
        octree_around(splats, SCENE, [], 5)


def test_colours_are_the_gaussians():
    """One Gaussian alone: every vertex has its coefficients."""
    splats = random_splats(1, (0.1, 0.2))
    splats.logits[:] = 2
    octree = octree_around(splats, SCENE, [], 5)
    np.testing.assert_allclose(octree.sh, np.broadcast_to(splats.sh[0], octree.sh.shape), rtol=1e-5, atol=1e-6)


@pytest.mark.skipif(native() is None, reason="no compiled kernels")
def test_with_and_without_compiled_kernels_the_leaves_hold_the_same(monkeypatch):
    """Gaussians of many sizes that overlap, some of whose cells hold finer ones; both ways add up in the same order, and a
    compiler may fuse a product and a sum: 2**-24 of the float32 that is kept, and the rounding of thousands of doubles."""
    splats = random_splats(300, (0.004, 0.08), seed=3)
    ours = octree_around(splats, SCENE, [], 7)
    assert len(np.unique(ours.leaf_level)) > 1
    monkeypatch.setattr(leaves, "native", lambda: None)
    theirs = octree_around(splats, SCENE, [], 7)
    assert np.array_equal(ours.corners, theirs.corners)
    np.testing.assert_allclose(ours.values, theirs.values, rtol=2**-23, atol=1e-9)


def test_a_pixel_is_as_wide_far_from_the_origin():
    """Squares are taken apart around the cameras' middle: what that loses is a rounding of the largest term over the result."""
    rng = np.random.default_rng(0)
    offset = np.array([4e5, 5e6, 100.0])
    points = offset + rng.normal(size=(200, 3))
    lenses = [Intrinsics(64, 48, focal, focal / 2, 32, 24) for focal in (50.0, 80.0, 200.0)]
    cameras = [Camera(lens, look_at(offset + 3 * rng.normal(size=3), offset, (0.0, 0.0, 1.0))) for lens in lenses]
    apart = np.stack([np.linalg.norm(points - c.position, axis=1) / c.intrinsics.fx for c in cameras])
    middle = np.mean([c.position for c in cameras], axis=0)
    largest = max(
        np.linalg.norm(points - middle, axis=1).max(), *(np.linalg.norm(c.position - middle) for c in cameras)
    )
    # Positions themselves are rounded to half a unit of the offset; differences of them by that much more.
    bound = 16 * np.finfo(float).eps * (2 * largest) ** 2 + 4 * np.spacing(5e6) * 2 * largest
    assert np.abs(_pixel_squares(points, cameras) - apart.min(0) ** 2).max() * 50**2 < bound * 4
