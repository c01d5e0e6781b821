"""Points surface by surface: the kernels against their twin in float64, and the same bits for any number of threads."""

import functools

import numpy as np
import pytest

from nerfvol.kernels import point_reference, splat_ops
from nerfvol.splats.points import PointCloud, splats_of_points
from nerfvol.splats.splats import Splats
from tests.splats.scenes import BACKGROUND, random_splats, view_of_cube


def cloud(n: int, normals: bool, seed: int = 0) -> Splats:
    """Uneven points on a sphere, and on a wall behind it with gaps."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(n, 3)) * (1, 1, 0.6)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    wall = np.stack([rng.uniform(-2, 2, n), np.full(n, 1.5), rng.uniform(-2, 2, n)], 1)
    up = np.concatenate([d, np.tile([0.0, 1.0, 0.0], (n, 1))]).astype(np.float32)
    places = np.concatenate([0.7 * d, wall])
    return splats_of_points(PointCloud(places, rng.random((2 * n, 3)).astype(np.float32), up if normals else None))


@functools.cache
def expected(normals: bool, eps: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """What the twin draws of the cloud; (H, W) pixels that stay when the reach of a point and the thickness of a surface
    change a little: on the others float32 may decide otherwise than float64 what belongs to a pixel or to a surface."""
    splats, view = cloud(700, normals), view_of_cube(100, 60)
    drawn = point_reference.render_surfaces(splats, view, BACKGROUND, eps)
    sure = np.ones((view.height, view.width), bool)
    for name, smooth in (("REACH", 2e-4), ("DEPTH", 2e-3)):
        for factor in (1 - 1e-4, 1 + 1e-4):
            with pytest.MonkeyPatch.context() as changed:
                changed.setattr(point_reference, name, getattr(point_reference, name) * factor)
                other = point_reference.render_surfaces(splats, view, BACKGROUND, eps)
            for key, a in drawn.items():
                sure &= np.abs(other[key] - a).reshape(*sure.shape, -1).max(-1) < smooth
    return drawn, sure


@pytest.mark.parametrize("normals", [True, False])
@pytest.mark.parametrize("eps", [0.0, 1e-2])
def test_kernels_against_the_twin(isa, normals, eps):
    """A place is off by 100 px x 6e-8, the exponent by that times its slope, at most 3 / sqrt(0.3) a pixel: 4e-5."""
    drawn, sure = expected(normals, eps)
    assert sure.mean() > 0.97
    assert 0.2 < (drawn["opacity"] > 0.99).mean() < 0.99  # surfaces, and gaps between them
    found = splat_ops.render_points(cloud(700, normals), view_of_cube(100, 60), BACKGROUND, eps, splat_ops.OUTPUTS)
    for name, a in drawn.items():
        scale = 1 if name in ("rgb", "opacity", "normal") else 4.5  # distances
        assert np.abs(found[name] - a)[sure].max() < 2e-4 * scale, name


def test_discs_edge_on_and_specks(isa):
    """Of all shapes and directions, far below a pixel as well: numbers, and a whole of no more than 1."""
    splats = random_splats(3000, 1, 4)
    splats.log_scales[::3, 0] = -12.0
    splats.log_scales[::5] = -9.0
    found = splat_ops.render_points(splats, view_of_cube(), BACKGROUND, outputs=splat_ops.OUTPUTS)
    assert all(np.isfinite(a).all() for a in found.values())
    assert 0 <= found["opacity"].min() and found["opacity"].max() <= 1
    assert found["depth"].min() >= 0 and found["depth"].max() < 10


def test_the_same_bits_for_any_number_of_threads(isa, threads):
    splats, view, pictures = cloud(9000, True), view_of_cube(333, 222), []
    for n in (1, 2, 3):
        threads(n)
        pictures.append(splat_ops.render_points(splats, view, BACKGROUND, outputs=splat_ops.OUTPUTS))
    for other in pictures[1:]:
        assert all(np.array_equal(a, other[name]) for name, a in pictures[0].items())


def test_arguments():
    splats, view = random_splats(4, 4, 0), view_of_cube(16, 16)
    with pytest.raises(ValueError, match="degree 1"):
        splat_ops.render_points(splats, view)
    with pytest.raises(ValueError, match="outputs must be among"):
        splat_ops.render_points(splats.with_sh_degree(0), view, outputs=("colour",))


def test_no_points_at_all():
    empty = random_splats(4, 1, 0).select([])
    assert np.allclose(splat_ops.render_points(empty, view_of_cube(20, 20), BACKGROUND)["rgb"], BACKGROUND)
