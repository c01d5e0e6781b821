"""The plane sweep finds surfaces whose depth is known, and says nothing where nothing can be known."""

import numpy as np
import pytest

from nerfvol.cameras import Camera, Intrinsics, look_at
from nerfvol.starts import plane_sweep as sweep
from nerfvol.starts import sweep_reference
from nerfvol.starts.plane_sweep import SweepView, depth_maps, neighbours_of, plane_sweep, sweep_factor

LENS = Intrinsics(96, 72, 90.0, 92.0, 47.0, 37.0)
PHASES = np.random.default_rng(5).random((24, 4))


def texture(points, amount=1.0):
    """A smooth colour that is nowhere the same: (n, 3) in [0, 1] of points (n, 3)."""
    out = np.full((len(points), 3), 0.5)
    for i, phase in enumerate(PHASES):
        direction = phase[:3] - 0.5
        wave = np.sin(points @ (22 * direction / np.linalg.norm(direction)) + 20 * phase[3])
        out[:, i % 3] += amount * 0.1 * wave
    return np.clip(out, 0, 1)


def plane_depth(origin, directions):
    """Distances to the plane z = -4 - x / 4."""
    normal = np.array([0.25, 0, 1.0])
    return (-4 - origin @ normal) / (directions @ normal)


def sphere_depth(origin, directions, radius=1.6):
    """Distances to a sphere before a wall."""
    to = np.array([0, 0, -4.0]) - origin
    along = directions @ to
    under = along**2 - (to @ to - radius**2)
    with np.errstate(invalid="ignore"):
        return np.where(under > 0, along - np.sqrt(under), (-9 - origin[2]) / directions[:, 2])


def view(camera, depth, colour=texture):
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    origin, directions = camera.rays_at(np.stack([x.ravel(), y.ravel()], axis=1))
    t = depth(origin, directions)
    hit = np.isfinite(t)
    rgb = np.zeros((len(t), 4), np.uint8)
    rgb[hit, :3] = np.rint(255 * colour(origin + np.where(hit, t, 0)[:, None] * directions))[hit]
    rgb[hit, 3] = 255
    return SweepView(rgb.reshape(k.height, k.width, 4), camera)


def cameras(n=9):
    """Three by three cameras around the origin that look at (0, 0, -4)."""
    places = [(0.45 * (i % 3 - 1), 0.4 * (i // 3 - 1), 0.05 * i) for i in range(n)]
    return [Camera(LENS, look_at(place, (0, 0, -4), (0, 1, 0))) for place in places]


def errors(maps, views, depth):
    """Inverse depths found less the true ones, in planes apart, at the confident pixels."""
    out = []
    for m in maps:
        camera = views[m.view].camera
        rows, columns = np.nonzero(m.confident)
        origin, directions = camera.rays_at(np.stack([columns + 0.5, rows + 0.5], axis=1))
        z = depth(origin, directions) * (directions @ camera.forward)
        out.append((m.inverse_depth[rows, columns] - 1 / z) / ((1 / 2 - 1 / 12) / (sweep.PLANES - 1)))
    return np.concatenate(out)


@pytest.mark.parametrize("depth,share", [(plane_depth, 0.6), (sphere_depth, 0.3)])
def test_a_textured_surface_is_found_to_a_fraction_of_a_plane(depth, share):
    views = [view(camera, depth) for camera in cameras()]
    maps = depth_maps(views, 2.0, 12.0)
    assert len(maps) == 9 and np.mean([m.confident.mean() for m in maps]) > share
    apart = np.abs(errors(maps, views, depth))
    # A parabola finds the top of a smooth peak to a tenth; greys of 8 bits and slanted windows add to that. Within three
    # pixels of an edge a window sees two depths.
    edges = 0.85 if depth is sphere_depth else 0.97
    assert np.median(apart) < 0.25 and np.mean(apart < 1) > edges


def test_points_lie_on_the_surface_and_have_its_colour():
    views = [view(camera, plane_depth) for camera in cameras()]
    cloud, sentence = plane_sweep(views, 2.0, 12.0, points=1000)
    assert 1100 < len(cloud) < 1200 and str(len(cloud)) in sentence  # 15 % more, and a point more a picture
    off = np.abs(cloud.positions @ [0.25, 0, 1] + 4)
    assert np.percentile(off, 85) < 0.12  # a plane apart is 0.11 deep there; fill points may lie anywhere
    assert np.percentile(np.abs(cloud.colours - texture(cloud.positions)), 80) < 0.1


def flat(points):
    return np.full((len(points), 3), 0.6)


def ramp(points):
    """Shading without texture: what a wall with a lamp looks like."""
    return np.clip(0.5 + 0.05 * points[:, :1] * np.ones(3), 0, 1)


def noisy(seed):
    rng = np.random.default_rng(seed)
    return lambda points: flat(points) + rng.normal(0, 1.5 / 255, (len(points), 3))


def stripes(points):
    """Level stripes, seen by cameras on a level line: the same at every depth."""
    return np.repeat(0.5 + 0.4 * np.sin(9 * points[:, 1:2]), 3, axis=1)


@pytest.mark.parametrize("colour", [flat, ramp, "noise"])
def test_walls_without_texture_give_no_points(colour):
    views = [view(c, plane_depth, noisy(i) if colour == "noise" else colour) for i, c in enumerate(cameras())]
    cloud, sentence = plane_sweep(views, 2.0, 12.0)
    assert len(cloud) == 0 and "too little texture" in sentence


def test_what_looks_the_same_at_every_depth_gives_no_points():
    line = [Camera(LENS, look_at((0.3 * i, 0, 0), (0.3 * i, 0, -4), (0, 1, 0))) for i in range(-3, 4)]
    views = [view(camera, plane_depth, lambda p: stripes(p / -p[:, 2:])) for camera in line]
    assert len(plane_sweep(views, 2.0, 12.0)[0]) == 0


def test_one_photograph_says_nothing():
    cloud, sentence = plane_sweep([view(cameras()[0], plane_depth)], 2.0, 12.0)
    assert len(cloud) == 0 and "two photographs" in sentence
    same = [view(cameras()[0], plane_depth)] * 5  # all from one place
    assert len(plane_sweep(same, 2.0, 12.0)[0]) == 0


def test_the_same_bits_for_any_number_of_threads():
    kernels = pytest.importorskip("_nerfvol_kernels")
    views, found = [view(camera, sphere_depth) for camera in cameras()], []
    before = kernels.get_threads()
    try:
        for threads in (1, 2, 3, 5):
            kernels.set_threads(threads)
            cloud = plane_sweep(views, 2.0, 12.0, points=500)[0]
            found.append((cloud.positions.tobytes(), cloud.colours.tobytes()))
    finally:
        kernels.set_threads(before)
    assert len(set(found)) == 1
    assert plane_sweep(views, 2.0, 12.0, points=500, seed=1)[0].positions.tobytes() != found[0][0]


def test_kernels_of_every_kind_agree_with_numpy(monkeypatch):
    kernels = pytest.importorskip("_nerfvol_kernels")
    monkeypatch.setattr(sweep, "PLANES", 12)
    views = [view(camera, sphere_depth) for camera in cameras(4)]
    views[1] = SweepView(views[1].image[:60, :80], Camera(LENS.cropped(0, 0, 80, 60), views[1].camera.c2w))
    seen = {}
    monkeypatch.setattr(sweep, "native", lambda: None)
    seen["numpy"] = depth_maps(views, 2.0, 12.0)
    monkeypatch.undo()
    monkeypatch.setattr(sweep, "PLANES", 12)
    before = kernels.isa()
    try:
        for isa in kernels.available_isas():
            kernels.set_isa(isa)
            seen[isa] = depth_maps(views, 2.0, 12.0)
    finally:
        kernels.set_isa(before)
    for isa, maps in seen.items():
        for found, expected in zip(maps, seen["numpy"], strict=True):
            # float32 sums of 49 greys under a floor of 4e-5: textured pixels agree far better than flat ones.
            np.testing.assert_allclose(found.score, expected.score, atol=4e-3, err_msg=isa)
            sure = expected.confident & (expected.score > 0.9)
            close = np.abs(found.inverse_depth - expected.inverse_depth)[sure] < 1e-3
            assert sure.sum() > 200 and close.mean() > 0.995, isa
            assert (found.confident == expected.confident).mean() > 0.99, isa


def test_neighbours_stand_on_several_sides():
    line = [Camera(LENS, look_at((x, 0, 0), (x, 0, -4), (0, 1, 0))) for x in (0, 0.4, 0.41, 0.42, -0.5, 1.3, -1.3)]
    chosen = neighbours_of(line, 0, 4.0)
    assert chosen[0] in (1, 2, 3) and len({1, 2, 3} & set(chosen.tolist())) == 1 and len(set(chosen.tolist())) == 4
    away = [*line[:2], Camera(LENS, look_at((0.4, 0.1, 0), (0.4, 0.1, 4), (0, 1, 0)))]
    assert neighbours_of(away, 0, 4.0).tolist() == [1, -1, -1, -1]  # who looks the other way sees nothing of it


def test_the_size_that_is_swept():
    sizes = (504, 378), (800, 533), (540, 960), (1080, 1920), (100, 100)
    assert [sweep_factor(*size) for size in sizes] == [4, 4, 4, 8, 1]
    with pytest.raises(ValueError, match="near < far"):
        depth_maps([view(cameras()[0], plane_depth)] * 2, 3.0, 2.0)


def test_the_reference_finds_windows_sums():
    a = np.random.default_rng(0).random((9, 11))
    found = sweep_reference._window_sums(a)
    for y, x in ((0, 0), (4, 5), (8, 10), (2, 9)):
        part = a[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4]
        np.testing.assert_allclose(found[y, x], part.sum())
