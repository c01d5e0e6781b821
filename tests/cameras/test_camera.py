"""Cameras: pixel centres, axes, unit directions, lenses both ways, and poses that are refused.

The expected values are worked out here from the definitions in docs/data.md, not with the code under test.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfvol.cameras.calibration import CAMERA_MODELS, lens_keys, read_calibration
from nerfvol.cameras.camera import Camera, look_at, orbit, tile_pixels, tile_rays
from nerfvol.cameras.further_lenses import FieldOfView, Rational
from nerfvol.cameras.intrinsics import Intrinsics, _DirectionCache
from nerfvol.cameras.lens import PINHOLE as NO_DISTORTION
from nerfvol.cameras.lens import BrownConrady, Fisheye, Lens
from nerfvol.cameras.pose import rigid_pose
from nerfvol.errors import InputError

EPS32, EPS64 = 2.0**-23, 2.0**-52
PINHOLE = Intrinsics(61, 47, 70.0, 72.0, 29.5, 24.25)
PHONE = Intrinsics(
    1080, 1920, 1375.52, 1374.49, 554.558, 965.268, k1=0.0578421, k2=-0.0805099, p1=-0.000980296, p2=0.00015575
)
LENSES = {
    "pinhole": PINHOLE,
    "phone": PHONE.scaled(20),
    "barrel": Intrinsics(64, 48, 40.0, 41.0, 30.0, 25.0, k1=-0.2, k2=0.03, k3=0.004, k4=-0.001, p1=0.002, p2=-0.003),
    "pincushion": Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0, k1=0.3, k2=0.1),
    "rational": Intrinsics(
        64, 48, 40.0, 41.0, 30.0, 25.0, Rational(0.1, 0.04, 0.003, 0.15, 0.002, -0.001, 0.03, 0.001)
    ),
    "field of view": Intrinsics(64, 48, 40.0, 41.0, 30.0, 25.0, FieldOfView(0.9)),
    "fisheye": Intrinsics(64, 48, 20.0, 20.5, 31.0, 25.0, k1=0.02, k2=-0.01, k3=0.003, k4=-0.0004, fisheye=True),
}


def pose(seed=0):
    generator = np.random.default_rng(seed)
    rotation = np.linalg.qr(generator.normal(size=(3, 3)))[0]
    out = np.eye(4)
    out[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    out[:3, 3] = generator.normal(size=3)
    return out


def pixel_centres(intrinsics):
    rows, columns = np.mgrid[: intrinsics.height, : intrinsics.width]
    return np.stack([columns.ravel() + 0.5, rows.ravel() + 0.5], axis=1)


def test_known_points_land_where_geometry_says():
    camera = Camera(PINHOLE, np.eye(4))  # at the origin, looking down -z, y up
    points = [[0, 0, -1], [1, 2, -4], [-0.5, 0.25, -2]]
    expected = [[29.5, 24.25], [29.5 + 70 / 4, 24.25 - 72 * 2 / 4], [29.5 - 70 / 4, 24.25 - 72 / 8]]
    np.testing.assert_allclose(camera.project(points), expected, rtol=4 * EPS64)


def test_a_moved_camera_sees_known_points():
    c2w = np.array([[0, 0, 1, 5.0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])  # at (5, 0, 0), looking at the origin
    camera = Camera(PINHOLE, c2w)
    expected = [[29.5, 24.25], [29.5 + 70 / 5, 24.25 - 72 * 2 / 5]]
    np.testing.assert_allclose(camera.project([[0, 0, 0], [0, 1, 2]]), expected, rtol=8 * EPS64)
    np.testing.assert_array_equal(camera.position, [5, 0, 0])
    np.testing.assert_array_equal(camera.forward, [-1, 0, 0])


def test_points_behind_a_pinhole_are_nan():
    assert np.isnan(Camera(PINHOLE, np.eye(4)).project([[0, 0, 1], [0.1, 0, 0]])).all()


def test_rays_pass_through_pixel_centres():
    origin, directions = Camera(PINHOLE, np.eye(4)).rays()
    assert origin.dtype == directions.dtype == np.float32
    assert directions.shape == (61 * 47, 3)
    for i, j in [(0, 0), (60, 0), (0, 46), (17, 31)]:
        d = np.array([(i + 0.5 - 29.5) / 70, -(j + 0.5 - 24.25) / 72, -1.0])
        np.testing.assert_allclose(directions[j * 61 + i], d / np.linalg.norm(d), atol=2 * EPS32)


@pytest.mark.parametrize("lens", LENSES)
def test_directions_have_unit_length(lens):
    directions = Camera(LENSES[lens], pose()).rays()[1].astype(np.float64)
    # rounding of three products, two sums and three conversions, each at most eps/2 of the length
    assert np.abs(np.linalg.norm(directions, axis=1) - 1).max() < 6 * EPS32


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("depth", [0.1, 7.0])
def test_rays_project_back_onto_their_pixels(lens, depth):
    camera = Camera(LENSES[lens], pose(1))
    pixels = pixel_centres(camera.intrinsics)
    origin, directions = camera.rays_at(pixels)
    # Newton's 1e-12 on the plane times the focal length, and the rounding of a point near a far camera
    tolerance = 100 * (1e-12 + 32 * EPS64 / depth)
    assert np.abs(camera.project(origin + depth * directions) - pixels).max() < tolerance
    single = camera.rays()[1]
    assert np.abs(single - directions).max() < 4 * EPS32


def sphere_outline(intrinsics, center, radius, row):
    """Columns (2,) where the outline of a sphere at ``center``, camera axes, crosses an image row: tangents."""
    y = -(row - intrinsics.cy) / intrinsics.fy
    # (d . c)^2 = (|c|^2 - R^2) |d|^2 for d = (x, y, -1), a quadratic in x
    m = center @ center - radius**2
    rest = y * center[1] - center[2]
    roots = np.roots([center[0] ** 2 - m, 2 * center[0] * rest, rest**2 - m * (y * y + 1)])
    return np.sort(roots.real) * intrinsics.fx + intrinsics.cx


def test_silhouette_of_a_sphere():
    intrinsics = Intrinsics(400, 300, 500.0, 480.0, 203.7, 148.2)
    camera = Camera(intrinsics, pose(2))
    center, radius = np.array([0.3, -0.2, -4.0]), 0.8
    world = camera.c2w[:3, :3] @ center + camera.c2w[:3, 3]
    origin, directions = camera.rays()
    toward = (world - origin.astype(np.float64)) @ directions.astype(np.float64).T
    inside = (toward**2 - (center @ center - radius**2)).reshape(300, 400)  # positive where the ray meets the sphere
    checked = 0
    for j in range(300):
        crossings = np.flatnonzero(np.diff(np.sign(inside[j])))
        expected = sphere_outline(intrinsics, center, radius, j + 0.5)
        if len(crossings) != 2 or expected[1] - expected[0] < 60:
            continue  # near the top and bottom the outline runs along the row
        a, b = inside[j, crossings], inside[j, crossings + 1]
        found = crossings + 0.5 + a / (a - b)
        assert np.abs(found - expected).max() < 0.01
        checked += 1
    assert checked > 150


def forward_pinhole(x, y, k1, k2, k3, k4, p1, p2):
    r2 = x**2 + y**2
    scale = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    return x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * scale + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y


@pytest.mark.parametrize("index", range(6))
def test_each_coefficient_means_what_opencv_says(index):
    coefficients = [0.0] * 6
    coefficients[index] = 0.05
    x, y = 0.3, -0.45
    lens = BrownConrady(*coefficients)
    found = lens.distort(np.array([[2 * x, 2 * y, 2.0]]))
    np.testing.assert_allclose(found[0], forward_pinhole(x, y, *coefficients), rtol=8 * EPS64)
    direction = lens.undistort(found)[0]
    np.testing.assert_allclose(direction[:2] / direction[2], [x, y], atol=2e-12)


@pytest.mark.parametrize("index", range(8))
def test_each_rational_coefficient_means_what_opencv_says(index):
    k1, k2, k3, k4, p1, p2, k5, k6 = (0.05 if i == index else 0.0 for i in range(8))
    x, y = 0.3, -0.45
    s = x * x + y * y
    radial = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
    expected = [x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y]
    lens = Rational(k1, k2, k3, k4, p1, p2, k5, k6)
    found = lens.distort(np.array([[2 * x, 2 * y, 2.0]]))
    np.testing.assert_allclose(found[0], expected, rtol=8 * EPS64)
    direction = lens.undistort(found)[0]
    np.testing.assert_allclose(direction[:2] / direction[2], [x, y], atol=2e-12)


def test_where_a_rational_lens_turns_back():
    # r / (1 + s) has its summit, 1 / 2, at r = 1; r / (1 - s) has a pole there and turns nowhere before it
    assert math.isclose(Rational(k4=1.0).max_angle, math.atan(1.0))
    assert math.isclose(Rational(k4=-1.0).max_angle, math.atan(1.0))
    assert Rational(k1=0.1).max_angle == math.pi / 2
    with pytest.raises(InputError, match="rational lens distortion"):
        Rational(k4=1.0).undistort(np.array([[0.6, 0.0]]))


def test_a_field_of_view_lens_ends_where_its_radius_does():
    lens = FieldOfView(1.0)
    np.testing.assert_allclose(lens.distort(np.array([[0.0, 2.0, 2.0]])), [[0.0, math.atan(2 * math.tan(0.5))]])
    assert not lens.undistort_where(np.array([[math.pi / 2, 0.0]]))[1].any()
    np.testing.assert_array_equal(FieldOfView(0.0).distort(np.array([[1.0, 2.0, 2.0]])), [[0.5, 1.0]])
    with pytest.raises(InputError, match="omega must be from 0 to below pi"):
        FieldOfView(-0.1)


def test_fisheye_angles():
    lens = Fisheye(0.05, -0.02, 0.004, -0.001)
    theta = np.array([0.0, 0.3, 1.2, 1.7])  # the last is behind the image plane: 97 degrees from the axis
    expected = theta * (1 + 0.05 * theta**2 - 0.02 * theta**4 + 0.004 * theta**6 - 0.001 * theta**8)
    directions = np.stack([np.sin(theta) * 0.6, np.sin(theta) * 0.8, np.cos(theta)], axis=1)
    plane = lens.distort(3 * directions)
    np.testing.assert_allclose(plane, expected[:, None] * [0.6, 0.8], atol=8 * EPS64)
    np.testing.assert_allclose(lens.undistort(plane), directions, atol=2e-12)


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(-0.4, 0.4), min_size=4, max_size=4),
    st.lists(st.floats(-0.03, 0.03), min_size=2, max_size=2),
    st.booleans(),
    st.floats(0.1, 1.2),
)
def test_distortion_round_trip_or_a_clear_refusal(radial, tangential, fisheye, reach):
    lens = Fisheye(*radial) if fisheye else BrownConrady(*radial, *tangential)
    steps = np.linspace(-reach, reach, 9)
    plane = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    try:
        directions = lens.undistort(plane)
    except InputError as error:
        assert "cannot be undone" in str(error)
        return
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=4 * EPS64)
    np.testing.assert_allclose(lens.distort(directions), plane, atol=1e-11)


def test_a_lens_that_folds_over_is_refused():
    # r (1 - r^2) never exceeds 0.385, so nothing is seen at 0.6 focal lengths from the axis
    with pytest.raises(InputError, match=r"\(k1=-1\) cannot be undone"):
        BrownConrady(-1.0).undistort(np.array([[0.1, 0.0], [0.6, 0.0]]))
    # r - 2 r^3 + 1.6 r^5 turns back at r = 0.5 and comes forward again: r = 1 gives 0.6, but no lens folds twice
    with pytest.raises(InputError, match="cannot be undone"):
        BrownConrady(-2.0, 1.6).undistort(np.array([[0.6, 0.0]]))
    with pytest.raises(InputError, match="fisheye"):
        Fisheye().undistort(np.array([[3.3, 0.0]]))  # more than 180 degrees from the axis


def test_how_far_from_the_axis_a_lens_reaches():
    assert NO_DISTORTION.max_angle == math.pi / 2 and Fisheye().max_angle == math.pi
    assert math.isclose(BrownConrady(-1.0).max_angle, math.atan(math.sqrt(1 / 3)))  # r (1 - r^2) turns at 1 / sqrt(3)
    assert math.isclose(Fisheye(-0.1).max_angle, math.sqrt(1 / 0.3))


def test_a_lens_is_given_as_one_or_by_its_coefficients():
    size = (64, 48, 40.0, 41.0, 30.0, 25.0)
    for by_name, lens in [
        ({}, NO_DISTORTION), ({"k1": 0.1, "p2": 0.01}, BrownConrady(k1=0.1, p2=0.01)),
        ({"k1": 0.1, "p1": 0.0, "fisheye": True}, Fisheye(k1=0.1)),
    ]:  # fmt: skip
        intrinsics = Intrinsics(*size, **by_name)
        assert intrinsics == Intrinsics(*size, lens) and hash(intrinsics) == hash(Intrinsics(*size, lens))
        assert intrinsics.fisheye == isinstance(lens, Fisheye)
        assert {name: getattr(intrinsics, name) for name in lens.names()} == lens.coefficients
        assert read_calibration(lens_keys(lens)).lens == lens
    assert Intrinsics(*size, fisheye=True) != Intrinsics(*size)  # same coefficients, another lens
    barrel = Intrinsics(*size, BrownConrady(k1=-0.1, k2=0.02))
    assert replace(barrel, k1=-0.2).lens == BrownConrady(k1=-0.2, k2=0.02)
    assert replace(barrel, fisheye=True).lens == Fisheye(k1=-0.1, k2=0.02)
    assert replace(barrel, cx=1.0).lens is barrel.lens
    with pytest.raises(TypeError, match="has no argument 'k7'"):
        Intrinsics(*size, k7=0.0)
    with pytest.raises(TypeError, match="takes a lens, or its coefficients by name"):
        Intrinsics(*size, 0.1)


@dataclass(frozen=True)
class Stereographic(Lens):
    """What a further model takes: the angle theta lands at 2 a tan(theta / 2)."""

    KIND = "stereographic"

    a: float = 1.0

    @property
    def max_angle(self):
        return math.pi

    def distort(self, points):
        depth = np.linalg.norm(points, axis=1) + points[:, 2]
        return 2 * self.a * points[:, :2] / depth[:, None]

    def _undistort(self, plane):
        half = plane / (2 * self.a)
        s = (half * half).sum(axis=1, keepdims=True)
        return np.concatenate([2 * half, 1 - s], axis=1) / (1 + s)


def test_a_further_model_is_a_class_and_a_row(monkeypatch):
    monkeypatch.setitem(CAMERA_MODELS, "STEREOGRAPHIC", Stereographic)
    keys = {"w": 40, "h": 30, "fl_x": 20.0, "camera_model": "STEREOGRAPHIC", "a": 0.9, "k1": 7}
    intrinsics = read_calibration(keys).intrinsics(40, 30)
    assert intrinsics.lens == Stereographic(0.9) and intrinsics.k1 == 0
    assert lens_keys(intrinsics.lens) == {"a": 0.9, "camera_model": "STEREOGRAPHIC"}
    pixels = pixel_centres(intrinsics)
    np.testing.assert_allclose(intrinsics.project(3 * intrinsics.directions_at(pixels)), pixels, atol=1e-12)
    assert replace(intrinsics, a=0.8).lens == Stereographic(0.8)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("k", [1, 2, 3, 5])
def test_scaled_cameras_look_through_the_middle_of_their_blocks(lens, k):
    full = LENSES[lens]
    scaled = full.scaled(k)
    assert (scaled.width, scaled.height) == (full.width // k, full.height // k)
    middles = k * pixel_centres(scaled)
    np.testing.assert_allclose(scaled.directions().reshape(-1, 3), full.directions_at(middles), rtol=0, atol=EPS32)


def test_resized_keeps_the_field_of_view_across():
    camera = Intrinsics(100, 50, 80.0, 80.0, 48.0, 27.0, k1=0.1).resized(300, 300)
    assert (camera.width, camera.height, camera.fx, camera.fy) == (300, 300, 240.0, 240.0)
    assert (camera.cx, camera.cy) == (144.0, 156.0)  # 2 pixels off the middle become 6


def test_directions_are_cached_and_bounded():
    assert PINHOLE.directions() is Intrinsics(61, 47, 70.0, 72.0, 29.5, 24.25).directions()
    cache = _DirectionCache(limit=3 * 10 * 10 * 12)
    made = [Intrinsics(10, 10, 10.0 + n, 10.0, 5.0, 5.0) for n in range(5)]
    for intrinsics in made:
        cache.get(intrinsics)
    assert list(cache._kept) == made[2:] and cache._bytes == 3 * 10 * 10 * 12


@pytest.mark.parametrize("width,height", [(16, 8), (17, 9), (7, 30), (1, 1)])
def test_tiles_hold_every_pixel_once(width, height):
    tiles = tile_pixels(width, height)
    assert tiles.dtype == np.int64 and tiles.shape == (-(-width // 8) * -(-height // 8), 64)
    assert sorted(tiles[tiles >= 0]) == list(range(width * height))
    per_row = -(-width // 8)
    for t, tile in enumerate(tiles):
        for n in (0, 7, 8, 27, 63):
            column, row = 8 * (t % per_row) + n % 8, 8 * (t // per_row) + n // 8
            assert tile[n] == (row * width + column if column < width and row < height else -1)
            assert tile_rays(width, height)[t, n] == min(row, height - 1) * width + min(column, width - 1)


def test_orbit_looks_at_its_middle():
    center, up = np.array([1.0, -2.0, 0.5]), np.array([0.0, 3.0, 4.0])
    cameras = orbit(7, center=center, radius=2.5, elevation_deg=20, intrinsics=PINHOLE, up=up)
    assert len(cameras) == 7
    for camera in cameras:
        outward = camera.position - center
        assert math.isclose(np.linalg.norm(outward), 2.5, rel_tol=1e-12)
        assert math.isclose(outward @ up / 5 / 2.5, math.sin(math.radians(20)), rel_tol=1e-12)
        np.testing.assert_allclose(camera.project([center]), [[29.5, 24.25]], atol=1e-10)
        above = camera.project([center + 0.1 * up])[0]
        assert abs(above[0] - 29.5) < 1e-10 and above[1] < 24.25  # straight up in the image
    gaps = [np.linalg.norm(a.position - b.position) for a, b in zip(cameras, cameras[1:] + cameras[:1], strict=True)]
    np.testing.assert_allclose(gaps, 2 * 2.5 * math.cos(math.radians(20)) * math.sin(math.pi / 7), rtol=1e-12)


def test_impossible_views_are_refused():
    with pytest.raises(InputError, match="cannot look"):
        look_at([0, 0, 1], [0, 0, 0], [0, 0, 1])
    for bad in ({"n": 0}, {"radius": 0.0}, {"elevation_deg": 90.0}):
        with pytest.raises(InputError, match="an orbit needs"):
            orbit(**{"n": 3, "center": [0, 0, 0], "radius": 1.0, "elevation_deg": 0.0, "intrinsics": PINHOLE, **bad})


def test_a_slightly_rounded_pose_becomes_exactly_rigid():
    exact = pose(3)
    found = rigid_pose(np.round(exact, 4))
    np.testing.assert_allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=8 * EPS64)
    np.testing.assert_allclose(found, exact, atol=2e-4)
    np.testing.assert_array_equal(rigid_pose(exact[:3])[3], [0, 0, 0, 1])


def broken_pose(kind):
    c2w = pose(4)
    if kind == "nan":
        c2w[1, 3] = np.nan
    elif kind == "infinite":
        c2w[0, 0] = np.inf
    elif kind == "scaled":
        c2w[:3, :3] *= 1.01
    elif kind == "mirrored":
        c2w[:3, 0] *= -1
    elif kind == "sheared":
        c2w[:3, 0] += 0.01 * c2w[:3, 1]
    elif kind == "projective":
        c2w[3, 0] = 0.5
    else:
        c2w = c2w[:2]
    return c2w


@pytest.mark.parametrize("kind,sentence", [
    ("nan", "finite"), ("infinite", "finite"), ("scaled", "rigid.*lengths 1.01 1.01 1.01"), ("mirrored", "mirrored"),
    ("sheared", "orthonormal only to 0.01"), ("projective", "last row"), ("cut", r"shape \(2, 4\)"),
])  # fmt: skip
def test_poses_that_are_not_rigid_are_refused(kind, sentence):
    with pytest.raises(InputError, match=sentence):
        Camera(PINHOLE, broken_pose(kind))


@pytest.mark.parametrize("change,sentence", [
    ({"fx": 0.0}, "positive"), ({"fy": -3.0}, "positive"), ({"fy": 1e-320}, "positive"),
    ({"fx": math.nan}, "fx must be a finite"),
    ({"cx": math.inf}, "cx must be a finite"), ({"k3": math.nan}, "k3 must be a finite"),
    ({"width": 0}, "at least 1x1"), ({"fisheye": True, "p1": 0.1}, "no coefficient p1"),
])  # fmt: skip
def test_singular_intrinsics_are_refused(change, sentence):
    values = {"width": 10, "height": 10, "fx": 10.0, "fy": 10.0, "cx": 5.0, "cy": 5.0}
    with pytest.raises(InputError, match=sentence):
        Intrinsics(**{**values, **change})


def test_nothing_left_of_a_small_image_is_refused():
    with pytest.raises(InputError, match="nothing is left"):
        PINHOLE.scaled(48)
    with pytest.raises(InputError, match="positive integer"):
        PINHOLE.scaled(0)
