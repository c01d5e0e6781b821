"""Photographs on their canvases and back through the lens, against pictures that are known at every position."""

import math

import numpy as np
import pytest

from nerfvol.cameras import warp
from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.cameras.canvas import canvas_of, is_pinhole, source_grid
from nerfvol.cameras.through_lens import through_lens
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import FACTORS, Photographs, estimate_bytes, level_camera, undistorted
from nerfvol.errors import InputError
from nerfvol.region import SceneBounds

PINHOLE = Intrinsics(90, 70, 80.0, 82.0, 44.0, 36.0)
BARREL = Intrinsics(120, 90, 100.0, 98.0, 61.0, 44.0, k1=-0.2, k2=0.05, p1=0.003, p2=-0.002)
CUSHION = Intrinsics(120, 90, 150.0, 150.0, 58.0, 46.0, k1=0.15, k2=-0.02)
FISHEYE = Intrinsics(120, 100, 75.0, 75.0, 60.0, 50.0, k1=0.03, k2=-0.01, fisheye=True)
WIDE = Intrinsics(140, 140, 44.0, 44.0, 70.0, 70.0, fisheye=True)  # 91 degrees to each side, 129 in the corners
POSE = look_at((0.3, -2.0, 0.5), (0, 0, 0), (0, 0, 1))
LENSES = {"barrel": BARREL, "cushion": CUSHION, "fisheye": FISHEYE}


def sky(directions):
    """A smooth colour (n, 3) in [0.1, 0.9] of unit directions (n, 3)."""
    x, y, z = directions.T
    waves = [np.sin(7 * x + 2 * z), np.sin(6 * y - 3 * x + 1), np.sin(5 * z + 4 * y + 2)]
    return 0.5 + 0.4 * np.stack(waves, axis=1)


def picture(camera):
    """What the camera shows of the sky, float (h, w, 3)."""
    k = camera.intrinsics
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    return sky(camera.rays_at(np.stack([x.ravel(), y.ravel()], axis=1))[1]).reshape(k.height, k.width, 3)


def as_bytes(image):
    return np.rint(255 * image).astype(np.uint8)


def dataset(lenses, alpha=None, images=None, cube=True):
    cameras = [Camera(lens, POSE) for lens in lenses]
    images = images or [as_bytes(picture(camera)) for camera in cameras]
    if alpha is not None:
        images = [np.concatenate([image, a[..., None]], axis=2) for image, a in zip(images, alpha, strict=True)]
    box = np.array([[-1.0] * 3, [1.0] * 3])
    scene = SceneBounds(box, 16 * box if cube else None, alpha is not None)
    return Dataset(cameras, images, [f"v{i}" for i in range(len(lenses))], scene, "made here")


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_photographs_are_what_a_pinhole_shows(name):
    photographs = Photographs(dataset([LENSES[name]]))
    view = photographs.view(0, 1)
    camera = view.camera
    assert is_pinhole(camera.intrinsics) and view.image.shape == (camera.intrinsics.height, camera.intrinsics.width, 4)
    shown = view.image[..., 3] == 255
    assert 0.6 < shown[: view.height, : view.width].mean() <= 1
    assert not shown[view.height :].any() and not shown[:, view.width :].any()
    away = np.abs(view.image[..., :3] / 255 - picture(camera)).max(axis=2)[shown]
    # Two roundings to bytes, and what a bicubic loses of waves some 20 pixels long; edges repeat half a pixel.
    assert np.percentile(away, 98) < 1.3 / 255 and away.max() < 6 / 255


@pytest.mark.parametrize("name", LENSES)
def test_the_canvas_holds_every_pixel_of_the_photograph(name):
    lens = LENSES[name]
    canvas = canvas_of(lens)
    assert not canvas.cropped
    x, y = np.meshgrid(np.linspace(0, lens.width, 61), np.linspace(0, lens.height, 61))
    directions = lens.directions_at(np.stack([x.ravel(), y.ravel()], axis=1))
    where = canvas.camera.project(directions)
    assert (where > -0.02).all() and (where < (canvas.camera.width + 0.02, canvas.camera.height + 0.02)).all()
    # and no more than it needs: less than a pixel is free on each side
    assert (where.min(axis=0) < 1).all() and (
        where.max(axis=0) > (canvas.camera.width - 1, canvas.camera.height - 1)
    ).all()


@pytest.mark.parametrize("name", LENSES)
def test_positions_between_the_grids_nodes(name):
    lens = LENSES[name]
    canvas = canvas_of(lens)
    grid, step = source_grid(canvas, lens)
    x, y = np.meshgrid(np.arange(canvas.camera.width), np.arange(canvas.camera.height))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    exact = lens.project(canvas.camera.directions_at(pixels + 0.5))
    found = warp._taps(grid, pixels[:, 0] / step, pixels[:, 1] / step, cubic=False)
    plane = (pixels + 0.5 - (canvas.camera.cx, canvas.camera.cy)) / (canvas.camera.fx, canvas.camera.fy)
    on = (exact > 0).all(axis=1) & (exact < (lens.width, lens.height)).all(axis=1)
    on &= np.hypot(*plane.T) < canvas.radius
    assert step > 1 and on.mean() > 0.6
    assert np.abs(found - exact)[on].max() < 0.02


def test_a_lens_that_turns_back_shows_no_second_picture():
    lens = Intrinsics(60, 40, 60.0, 60.0, 30.0, 20.0, k1=-0.3)  # folds at 1.05, the corners reach 0.68
    canvas = canvas_of(lens)
    wide = Intrinsics(400, 400, 60.0, 60.0, 200.0, 200.0)
    larger = type(canvas)(wide, canvas.radius, False)
    image = undistorted(np.full((40, 60, 3), 200, np.uint8), larger, *source_grid(larger, lens))
    rows, columns = np.nonzero(image[..., 3])
    assert np.hypot(columns + 0.5 - 200, rows + 0.5 - 200).max() <= 60 * canvas.radius + 1


def test_wide_lenses_are_cropped_with_a_message():
    photographs = Photographs(dataset([WIDE, BARREL]))
    assert "1 of 2 photographs show more than 60 degrees" in photographs.messages[0]
    size = 2 * math.ceil(44 * math.tan(math.radians(60)))
    assert photographs.cameras[0].intrinsics.width == size
    view = photographs.view(0, 1)
    shown = view.image[: view.height, : view.width]
    assert (shown[..., 3] == 255).all()
    inside = np.s_[2 : view.height - 2, 2 : view.width - 2]
    assert np.abs(shown[..., :3] / 255.0 - picture(view.camera)[: view.height, : view.width])[inside].max() < 12 / 255
    assert Photographs(dataset([WIDE]), max_angle=math.radians(40)).cameras[0].intrinsics.width < size / 2
    with pytest.raises(InputError, match="80 degrees"):
        canvas_of(WIDE, math.radians(85))


def test_photographs_without_distortion_cost_nothing():
    data = dataset([PINHOLE, PINHOLE])
    photographs = Photographs(data)
    assert photographs._sources[0] is data.images[0] and photographs.held == set()
    view = photographs.view(0, 1)
    np.testing.assert_array_equal(view.image[:70, :90, :3], data.images[0])
    assert view.image.shape == (80, 96, 4) and (view.image[:70, :90, 3] == 255).all()
    assert not view.image[70:].any() and not view.image[:, 90:].any()
    k = view.camera.intrinsics
    assert (k.width, k.height, k.fx, k.fy, k.cx, k.cy) == (96, 80, 80.0, 82.0, 44.0, 36.0)
    assert photographs.view(0, 1).image is view.image


@pytest.mark.parametrize("lens", [PINHOLE, BARREL])
@pytest.mark.parametrize("factor", [2, 4, 8])
def test_levels_are_means_of_blocks(lens, factor):
    photographs = Photographs(dataset([lens]))
    full, view = photographs.view(0, 1), photographs.view(0, factor)
    height, width = -(-full.height // factor), -(-full.width // factor)
    assert (view.height, view.width) == (height, width) and view.image.shape[0] % 16 == view.image.shape[1] % 16 == 0
    k, of = view.camera.intrinsics, full.camera.intrinsics
    assert (k.fx, k.fy, k.cx, k.cy) == (of.fx / factor, of.fy / factor, of.cx / factor, of.cy / factor)
    assert (k.height, k.width) == view.image.shape[:2]
    whole = np.zeros((height * factor, width * factor, 4))
    part = full.image[: height * factor, : width * factor].astype(float)
    whole[: part.shape[0], : part.shape[1]] = part
    blocks = whole.reshape(height, factor, width, factor, 4)
    alpha = blocks[..., 3].sum((1, 3))
    colour = (blocks[..., :3] * blocks[..., 3:]).sum((1, 3)) / np.maximum(alpha, 1)[..., None]
    found = view.image[:height, :width]
    np.testing.assert_allclose(found[..., 3], alpha / factor**2, atol=0.5)
    np.testing.assert_allclose(found[..., :3][alpha > 0], colour[alpha > 0], atol=0.5)
    assert not view.image[height:].any() and not view.image[:, width:].any()


def test_alpha_is_background_or_a_mask():
    alpha = np.zeros((70, 90), np.uint8)
    alpha[10:50, 20:60] = 255
    alpha[50:, :] = 100
    data = dataset([PINHOLE], [alpha], cube=False)
    over = Photographs(data, background=(1.0, 0.0, 0.0)).view(0, 1)
    assert (over.image[:70, :90, 3] == 255).all() and over.image[0, 0].tolist() == [255, 0, 0, 255]
    np.testing.assert_array_equal(over.image[10:50, 20:60, :3], data.images[0][10:50, 20:60, :3])
    masked = Photographs(data, alpha="mask").view(0, 1)
    np.testing.assert_array_equal(masked.image[:70, :90], data.images[0])
    lens = dataset([BARREL], [np.full((90, 120), 255, np.uint8) * (np.arange(120) < 60).astype(np.uint8)])
    halves = Photographs(lens, alpha="mask").view(0, 1).image
    assert halves[40, 20, 3] == 255 and halves[40, 90, 3] == 0


def test_bytes_are_what_the_estimate_says():
    data = dataset([PINHOLE, BARREL, WIDE])
    photographs = Photographs(data)
    for factor in FACTORS:
        photographs.level(factor)
    assert photographs.nbytes == estimate_bytes(data.cameras)
    before = photographs.nbytes
    photographs.drop(2)
    assert photographs.nbytes < before and photographs.held == {1, 4, 8}
    with pytest.raises(ValueError, match="power of two"):
        photographs.view(0, 3)
    assert level_camera(PINHOLE, 8).width == 16


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize(
    "lens,alpha,n", [(Intrinsics(24, 14, 20.0, 20.0, 12.0, 7.0), False, 150), (BARREL, False, 8), (PINHOLE, True, 8)]
)
def test_what_is_kept_stays_within_its_bound_and_what_is_not_has_the_same_bytes(lens, alpha, n, share):
    """Two epochs over 150 photographs of few pixels, all sizes in the order of a run; over few of other kinds. Bytes are
    counted."""
    image = np.random.default_rng(0).integers(0, 255, (lens.height, lens.width, 4 if alpha else 3), np.uint8)
    data = dataset([lens] * n, images=[image] * n)
    few = Photographs(dataset([lens], images=[image]))
    bound = int(share * estimate_bytes(data.cameras, (4, 2, 1)))
    photographs, most = Photographs(data, most_bytes=bound), 0
    for factor in (4, 2, 1):
        for _ in range(2):
            for i in range(n):
                view = photographs.view(i, factor)
                assert (view.image == few.view(0, factor).image).all()
            most = max(most, photographs.nbytes)
        photographs.drop(factor)
    assert most <= bound and (share == 0 or most > 0.4 * bound)
    photographs.drop(1)
    first = photographs.view(0, 1)
    assert (photographs.view(0, 1) is first) == (share == 1 or share > 0 and not alpha)


def test_the_same_bytes_for_any_number_of_threads():
    made = [Photographs(dataset([BARREL] * 5), threads=n).level(2) for n in (1, 4)]
    for a, b in zip(*made, strict=True):
        np.testing.assert_array_equal(a.image, b.image)


# ------------------------------------------------------------------ back through the lens
def drawn(camera):
    """A pinhole's pictures of the sky, of a wall at z = -3 with a hole, and of what is behind."""
    k = camera.intrinsics
    assert is_pinhole(k)
    x, y = np.meshgrid(np.arange(k.width) + 0.5, np.arange(k.height) + 0.5)
    directions = camera.rays_at(np.stack([x.ravel(), y.ravel()], axis=1))[1]
    shape = (k.height, k.width)
    return {
        "rgb": picture(camera), "opacity": sky(directions)[:, 0].reshape(shape), "normal": directions.reshape(*shape, 3),
        "depth": distance(directions).reshape(shape),
    }  # fmt: skip


def distance(directions):
    """Two surfaces that differ by half, and holes where nothing is."""
    x, y, z = directions.T
    return np.where(x > 0.3, 0.0, np.where(z > 0.05, 3.0, 4.5)) * (1 + 0.1 * y)


@pytest.mark.parametrize("name,lens", [*LENSES.items(), ("wide", WIDE), ("pinhole", PINHOLE)])
def test_through_a_lens_every_pixel_shows_its_own_direction(name, lens):
    camera, seen = Camera(lens, POSE), []

    def render(pinhole):
        seen.append(pinhole)
        return drawn(pinhole)

    out = through_lens(render, camera)
    assert (len(seen) > 1) == (name == "wide")
    if name == "wide":  # no face draws more than its 90 degrees and the bicubic's taps
        assert max(max(c.intrinsics.width, c.intrinsics.height) for c in seen) <= 2 * lens.fx + 8
    truth = picture(camera)
    assert out["rgb"].shape == truth.shape and out["rgb"].dtype == np.float32
    assert np.abs(out["rgb"] - truth).max() < 4e-3  # the bicubic's error, third order in 1 / 20 of a wave
    assert np.abs(out["opacity"] - truth[..., 0]).max() < 4e-3
    directions = camera.rays()[1].reshape(truth.shape)
    assert np.abs(out["normal"] - directions).max() < 2e-3
    exact = distance(directions.reshape(-1, 3).astype(float)).reshape(truth.shape[:2])
    close = np.abs(out["depth"] - exact) < 0.01
    # Only edges of surfaces move, by less than a pixel, and no distance is between two surfaces.
    assert close.mean() > 0.97
    y = 1 + 0.1 * directions[..., 1]
    assert (np.minimum(np.abs(out["depth"] - 3 * y), np.abs(out["depth"] - 4.5 * y))[out["depth"] != 0] < 0.02).all()


@pytest.mark.parametrize("name", LENSES)
def test_a_photograph_undistorted_and_drawn_back_is_itself(name):
    lens = LENSES[name]
    image = as_bytes(picture(Camera(lens, POSE)))
    photographs = Photographs(dataset([lens], images=[image]))
    view = photographs.view(0, 1)

    def render(pinhole):
        """The canvas itself, moved to where the pinhole has it."""
        k, of = pinhole.intrinsics, view.camera.intrinsics
        assert (k.fx, k.fy) == (of.fx, of.fy)
        left, top = round(of.cx - k.cx), round(of.cy - k.cy)
        rows = np.clip(np.arange(k.height) + top, 0, view.height - 1)
        columns = np.clip(np.arange(k.width) + left, 0, view.width - 1)
        return {"rgb": view.image[rows][:, columns, :3] / 255.0}

    away = np.abs(through_lens(render, Camera(lens, POSE))["rgb"] - image / 255.0)
    inner = away[3:-3, 3:-3]
    assert inner.max() < 4 / 255 and inner.mean() < 0.5 / 255


def test_holes_of_any_kind_stay_holes():
    def render(pinhole):
        k = pinhole.intrinsics
        depth = np.full((k.height, k.width), np.inf)
        depth[:, : k.width // 2] = 2.0
        depth[: k.height // 3] = np.nan
        return {"median_depth": depth}

    out = through_lens(render, Camera(BARREL, POSE))["median_depth"]
    assert set(np.unique(out[np.isfinite(out)])) == {np.float32(2.0)}
    assert np.isnan(out).any() and np.isinf(out).any()


# ------------------------------------------------------------------ compiled and numpy
def test_kernels_agree_with_numpy(monkeypatch):
    kernels = pytest.importorskip("_nerfvol_kernels")
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (37, 53, c)).astype(np.uint8) for c in (3, 4)]
    lens = Intrinsics(53, 37, 45.0, 45.0, 26.0, 19.0, k1=-0.15, k2=0.02)
    canvas = canvas_of(lens)
    grid, step = source_grid(canvas, lens)
    floats = rng.random((12, 9, 5)).astype(np.float32)
    places = rng.uniform(-3, 15, (400, 2)).astype(np.float32)
    places[:3, 0] = np.nan, np.inf, -np.inf

    def everything():
        return [
            *(undistorted(image, canvas, grid, step) for image in images),
            *(warp.reduce(image, k, (48, 64)) for image in images for k in (1, 2, 3, 8, 64)),
            *(warp.sample(floats, places, cubic) for cubic in (False, True)),
        ]

    with monkeypatch.context() as patch:
        patch.setattr(warp, "native", lambda: None)
        expected = everything()
    before = kernels.isa()
    try:
        for isa in kernels.available_isas():
            kernels.set_isa(isa)
            for found, want in zip(everything(), expected, strict=True):
                if want.dtype == np.uint8:  # a rounding may fall to the other side
                    apart = np.abs(found.astype(int) - want.astype(int))
                    assert apart.max() <= 1 and (apart > 0).mean() < 1e-3
                else:
                    np.testing.assert_allclose(found, want, atol=1e-5)
    finally:
        kernels.set_isa(before)


def test_blocks_are_weighted_and_rounded_once():
    image = np.array([[[10, 0, 255, 255], [20, 0, 255, 85]], [[99, 7, 0, 0], [99, 7, 0, 0]]], np.uint8)
    out = warp.reduce(image, 2, (1, 2))
    # (10 * 255 + 20 * 85) / 340 = 12.5 rounded up; 340 / 4 = 85
    assert out[0, 0].tolist() == [13, 0, 255, 85] and out[0, 1].tolist() == [0, 0, 0, 0]
    assert warp.reduce(image[1:], 2, (1, 1))[0, 0].tolist() == [99, 7, 0, 0]  # weightless: the plain mean
