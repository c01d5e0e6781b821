"""Octrees of photographs that begin as splats: leaves as fine as pixels, what is resumed, exposures, lenses, memory."""

import re
import shutil
import time
import tracemalloc

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.cameras.lens import BrownConrady
from nerfvol.config.octree import OctreeConfig
from nerfvol.config.training import Config
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.files.checkpoint import load_checkpoint
from nerfvol.native import native
from nerfvol.region import SceneBounds
from nerfvol.splats.points import dc_of_colour
from nerfvol.splats.splats import Splats
from nerfvol.starts.leaves import PIXELS
from nerfvol.training import begin, convert, octree_start, session, surface_stages, train, tuning
from nerfvol.training.appearance import Appearance
from nerfvol.training.memory.octree import OctreePlan
from nerfvol.training.memory.splats import LOOK_BYTES, SURFACE_BYTES, surface_leaves
from tests.fixtures.rooms import HALF, draw, facing_cameras, room_cameras, trace_planes, trace_room, write_photographs
from tests.fixtures.runs import metrics_of, product, run_of, settings, start

pytestmark = pytest.mark.skipif(native() is None, reason="the reference path takes minutes")
LENS = Intrinsics(48, 36, 45.0, 45.0, 24.0, 18.0, lens=BrownConrady(k1=0.03))
SHORT = {
    "octree": {"steps": 12, "prune_steps": 2}, "splats": {"steps": 20, "grow_every": 8}, "representation": "octree",
    "init": "splats", "compare_views": 1,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Nine photographs of three planes through a lens, by turns a fifth brighter and darker."""
    cameras = facing_cameras(9, LENS)
    gains = (0.8, 1.0, 1.25)
    pictures = [
        np.clip(draw(c, trace_planes, 1) * gains[i % 3], 0, 255).astype(np.uint8) for i, c in enumerate(cameras)
    ]
    return write_photographs(tmp_path_factory.mktemp("planes") / "scene", cameras, pictures)


# ---------------------------------------------------------------- how fine leaves are
def discs(distance: float, half: float, side: float) -> Splats:
    """A wall of discs at z = -distance, (2 half)^2 large, each as wide as ``side``."""
    x, y = (axis.reshape(-1) for axis in np.meshgrid(*[np.arange(-half, half, 0.7 * side)] * 2))
    means = np.column_stack([x, y, np.full(len(x), -distance)])
    n, scales = len(means), np.log([side, side, 0.1 * side])
    return Splats(means, np.tile(scales, (n, 1)), np.tile([1.0, 0, 0, 0], (n, 1)), np.full(n, 4.0),
                  dc_of_colour(np.full((n, 3), 0.5)))  # fmt: skip


@pytest.mark.parametrize("is_unbounded", [False, True])
def test_leaves_are_as_wide_as_the_pixels_that_see_them(is_unbounded):
    """Walls of discs much finer than pixels at the middle of the scene, at distance D, and at D / 2, where pixels are half as
    wide. The scene is so large that PIXELS pixels at its middle are exactly leaves of level n: there leaves are PIXELS wide to
    the rounding of levels, and, with one level more, before it too: twice as wide without, as in an object."""
    n, far, focal = 8, 8.0, 200.0
    pixel = far / focal
    half = PIXELS * pixel * 2**n / 2
    box = np.array([[-half, -half, -far - half], [half, half, -far + half]])
    bounds = SceneBounds(
        box, np.array([box.mean(0) - 4 * half, box.mean(0) + 4 * half]) if is_unbounded else None, False
    )
    lens = Intrinsics(80, 80, focal, focal, 40.0, 40.0)
    cameras = [Camera(lens, look_at((x, 0.0, 0.0), (x, 0.0, -1.0), (0.0, 1.0, 0.0))) for x in (-0.1, 0.0, 0.1)]
    for distance, finest in ((far, n), (far / 2, n + is_unbounded)):
        octree = convert.surfaces_of(
            discs(distance, 0.1 * distance, 0.4 * distance / focal), bounds, cameras, (1, 1, 1)
        )
        widths = octree.leaf_sizes() * focal / np.linalg.norm(octree.leaf_centers() - [0, 0, 0], axis=1)
        expected = PIXELS * (1 if finest == n + (distance < far) else 2)
        # Directions up to 0.15 off the axis lengthen distances by 1 %; a leaf's middle lies up to its side before or behind.
        np.testing.assert_allclose(np.median(widths), expected, rtol=0.05)
        assert octree.max_level - bounds.n_shells == finest


def test_a_camera_in_the_middle_asks_for_the_finest_leaves():
    """In a room, or where all photographs are taken from one place: what is there has pixels of no width."""
    box = np.array([[-1.0] * 3, [1.0] * 3])
    for x in (0.0, 1e-200, 1e-9):
        camera = Camera(LENS, look_at((x, 0.0, 0.0), (x, 1.0, 0.0)))
        assert surface_stages.finest_level(SceneBounds(box, 16 * box, False), [camera]) == surface_stages.MOST_LEVEL


@pytest.mark.parametrize("rays, factor", [
    (100 * 640 * 480, 1), (99 * 640 * 480, 2), (25 * 640 * 480, 2), (24 * 640 * 480, 4), (1, 4),
])  # fmt: skip
def test_photographs_are_as_large_as_each_pixel_can_be_drawn(rays, factor):
    """A hundred of 640x480; an eighth would be less than SMALLEST pixels wide."""
    lens = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    assert surface_stages.EPOCHS == 1 and 640 / 8 < surface_stages.SMALLEST
    assert surface_stages.image_factor([Camera(lens, np.eye(4))] * 100, rays) == factor


def test_photographs_are_reduced_until_their_leaves_fit():
    """... and the level follows the size that is left; MOST_FACTOR is the end where nothing fits."""
    cameras = [Camera(Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0), np.eye(4))] * 10
    box = np.array([[-1.0] * 3, [1.0] * 3]) + [0.0, 0.0, -5.0]
    bounds = SceneBounds(box, np.array([box.mean(0) - 4, box.mean(0) + 4]), False)
    config, seconds = OctreeConfig(), 2.0 * 10 * 640 * 480 / surface_stages.RAYS_PER_SECOND
    for least in (1, 4, 16):
        level = surface_stages.finest_level(bounds, [camera.scaled(least) for camera in cameras]) + (least > 1)
        stage = surface_stages.stage_for(bounds, cameras, config, seconds, lambda factor, least=least: factor >= least)
        assert stage == (level, least)
    for shrunk, most in ((1, surface_stages.MOST_FACTOR), (4, 64)):  # 480 and 120 pixels are halved while one is left
        small = [camera.scaled(shrunk) for camera in cameras]
        assert (surface_stages.stage_for(bounds, small, config, seconds, lambda factor: False) or (0, 0))[1] == most


def test_what_a_time_or_steps_are_worth():
    config = OctreeConfig(steps=30)
    assert surface_stages.rays_of(config, None) == 30 * 320 * 64
    assert surface_stages.rays_of(config, 20.0) == 2 * surface_stages.rays_of(config, 10.0) > 0
    assert not surface_stages.has_stages_of_its_own(config)
    assert surface_stages.has_stages_of_its_own(OctreeConfig(levels=[5, 6, 7, 8, 8, 9, 9]))


@pytest.mark.parametrize("seconds, one", [(0.1, True), (7.6, True), (7.8, False), (None, False)])
def test_a_cut_out_object_is_looked_at_as_it_is(seconds, one):
    """In one stage of whole pictures, until each pixel could be drawn three times (7.68 s); then in those of the settings."""
    cameras = [Camera(Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0), np.eye(4))] * 10
    bounds = SceneBounds(np.array([[-1.0] * 3, [1.0] * 3]) + [0.0, 0.0, -5.0], None, True)
    stage = surface_stages.stage_for(bounds, cameras, OctreeConfig(), seconds)
    assert stage == ((surface_stages.finest_level(bounds, cameras), 1) if one else None)


@pytest.mark.parametrize("seconds, factor", [(24.0, 1), (22.0, 1), (7.0, 2), (1.0, 4)])
def test_a_conversion_that_is_trained_is_as_fine_as_its_time(monkeypatch, seconds, factor):
    """Ten photographs of 640x480 and a clock that stands; leaves as the cameras so reduced ask for, and one level finer where
    each pixel is drawn three times."""
    cameras, seen = [Camera(Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0), np.eye(4))] * 10, []
    box = np.array([[-1.0] * 3, [1.0] * 3]) + [0.0, 0.0, -5.0]
    bounds = SceneBounds(box, np.array([box.mean(0) - 4, box.mean(0) + 4]), False)
    dataset = Dataset(cameras, [np.zeros((480, 640, 3), np.uint8)] * 10, list("abcdefghij"), bounds, "ten")
    monkeypatch.setattr(tuning, "process_seconds", lambda: 0.0)
    monkeypatch.setattr(
        tuning, "surfaces_of", lambda splats, scene, cameras, background, level: seen.append((cameras, level))
    )
    assert 7.5 * surface_stages.RAYS_PER_SECOND < 10 * 640 * 480 < 8 * surface_stages.RAYS_PER_SECOND
    _, config = tuning.surfaces_to_train(discs(5.0, 0.1, 0.1), dataset, (1, 1, 1), Config(time_budget=seconds))
    level = surface_stages.finest_level(bounds, [camera.scaled(factor) for camera in cameras]) + (
        seconds in (7.0, 24.0)
    )
    assert seen[0][1] == level and seen[0][0][0].intrinsics.width == 640 // factor
    assert (config.octree.levels, config.octree.downscales) == ([level], [factor])
    tuning.surfaces_to_train(discs(5.0, 0.1, 0.1), dataset, (1, 1, 1), Config(time_budget=seconds), level=6)
    assert seen[1][1] == 6 and seen[1][0] is cameras  # what is asked for stays


@pytest.mark.parametrize("row, reason", [
    ({"level": 17, "images": 1}, "level 17"), ({"level": "9", "images": 1}, "level '9'"),
    ({"level": 9, "images": 0}, "images /0"), ({"level": 9, "images": 3}, "power of two"),
    ({"level": 9, "images": 512}, "power of two"), ({"images": 2}, "level None"),
])  # fmt: skip
def test_a_damaged_stage_is_refused(row, reason):
    with pytest.raises(InputError, match=reason):
        surface_stages.stage_in({"converted": row})
    assert surface_stages.stage_in({}) is None and surface_stages.stage_in({"converted": {"leaves": 3}}) is None
    assert surface_stages.stage_in({"converted": {"level": 9, "images": 4}}) == (9, 4)


# ---------------------------------------------------------------- whole runs
@pytest.fixture(scope="module")
def whole(tmp_path_factory, scene):
    """An uninterrupted run with colour maps, copies of its checkpoints by phase and step, and what it said."""
    folder, checkpoints, said = tmp_path_factory.mktemp("whole"), {}, []
    save = session.Run.save

    def save_and_keep(self, phase):
        save(self, phase)
        kept = folder / f"{phase.name}{phase.steps_done}"
        shutil.copy(self.folder / run_folder.CHECKPOINT, kept)
        checkpoints[phase.name, phase.steps_done] = kept

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session.Run, "save", save_and_keep)
        run = start(settings_of(scene, folder / "run"), say=said.append)
    return run, checkpoints, said


def settings_of(scene, out, **more):
    """Without the stages that the other tests' settings choose."""
    config = settings(scene, out, **{**SHORT, "appearance": "on", **more})
    plain = OctreeConfig()
    names = ("levels", "downscales", *surface_stages.STAGE)
    for name in names:
        setattr(config.octree, name, getattr(plain, name))
    return config


@pytest.mark.parametrize("phase, step", [("splats", 13), ("octree", 1), ("octree", 7), ("octree", 12)])
def test_resumed_in_either_phase_the_octree_is_the_same(whole, tmp_path, scene, phase, step):
    run, checkpoints, _ = whole
    out = tmp_path / "run"
    out.mkdir()
    shutil.copy(run / run_folder.CONFIG, out)
    shutil.copy(checkpoints[phase, step], out / run_folder.CHECKPOINT)
    start(settings_of(scene, out, resume=True, checkpoint_every=1000))
    assert product(out) == product(run)
    assert metrics_of(out)["steps"] == metrics_of(run)["steps"] == {"splats": 20, "octree": 12}


def test_the_octree_goes_on_with_the_splats_colour_maps(whole):
    """Measured once, before the splats; the octree's first step sees photographs of one exposure."""
    _, checkpoints, said = whole
    last = load_checkpoint(checkpoints["splats", 20])["trainer"]["appearance"]
    first = load_checkpoint(checkpoints["octree", 1])["trainer"]["appearance"]
    assert int(last["active"]) == int(first["active"]) == 1
    gains = np.array(first["maps"])[:, range(3), range(3)].mean(1)
    assert gains.max() / gains.min() > 1.3
    assert any("each gets a colour map" in line for line in said)
    asked, found = Appearance(2), Appearance(2)
    found.decided = True
    asked.go_on_from(found)
    assert asked.decided and not asked.active and not asked.due(1.0)


def test_the_run_says_what_it_came_to(whole):
    """Steps on each size of the images, and how wide the leaves are that are seen in the end."""
    _, _, said = whole
    sentence = next(line for line in said if line.startswith("steps: "))
    assert re.match(
        r"steps: 12 on (whole images|images /\d+); the leaves that are seen are [0-9.]+ pixels wide", sentence
    )


def test_no_more_leaves_come_of_splats_than_are_announced():
    """Three walls one behind the other, each as wide as the views: without what is known of splats too few are announced. And
    what is announced to make them suffices for the arrays that are."""
    far, focal = 8.0, 200.0
    lens = Intrinsics(160, 120, focal, focal, 80.0, 60.0)
    cameras = [Camera(lens, look_at((x, 0.0, 0.0), (x, 0.0, -1.0), (0.0, 1.0, 0.0))) for x in (-0.1, 0.0, 0.1)]
    box = np.array([[-4.0, -4.0, -12.0], [4.0, 4.0, -4.0]])
    bounds = SceneBounds(box, np.array([[-16.0, -16.0, -24.0], [16.0, 16.0, 8.0]]), False)
    walls = [discs(distance, 0.42 * distance, 0.008 * distance) for distance in (0.7 * far, far, 1.3 * far)]
    splats = Splats(*(np.concatenate([getattr(wall, name) for wall in walls])
                      for name in ("means", "log_scales", "quats", "logits", "sh")))  # fmt: skip
    dataset = Dataset(cameras, [np.zeros((120, 160, 3), np.uint8)] * 3, ["a", "b", "c"], bounds, "walls")
    pixels = lens.width * lens.height
    leaves = surface_leaves(splats.n, pixels)
    config = Config(representation="octree", init="splats").for_scene(bounds)
    sentences = [OctreePlan(config, dataset, 0, 1, n).sentence() for n in (0, leaves)]
    before, now = (int(re.search(r"up to ([\d,]+) leaves", line)[1].replace(",", "")) for line in sentences)
    tracemalloc.start()
    try:
        octree = convert.surfaces_of(splats, bounds, cameras, (1, 1, 1))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    print(splats.n, octree.n_leaves / pixels, octree.n_leaves / splats.n, peak / octree.n_leaves)
    assert before < octree.n_leaves <= now == leaves
    assert peak <= LOOK_BYTES * 3 * pixels + SURFACE_BYTES * leaves


@pytest.mark.parametrize("own", [False, True])
def test_stages_of_ones_own_split_what_splats_became(tmp_path, scene, monkeypatch, own):
    """Leaves of a first stage of level 6 alone are more than photographs of 1,728 pixels ask splats for."""

    class Announced(Exception):
        """What comes after is not asked."""

    def announce(run, sentence):
        raise Announced(sentence)

    config = settings_of(scene, tmp_path)
    if own:
        config.octree.levels = [6, 6, 7, 7, 8, 8, 9]
    monkeypatch.setattr(begin, "announce", announce)
    run = run_of(config)
    plan = octree_start.prepare_splats(run)
    with pytest.raises(Announced) as said:
        begin.begin_octree(run, train.optimise)
    leaves = int(re.search(r"up to ([\d,]+) leaves", str(said.value))[1].replace(",", ""))
    assert (plan.stage is None) == own
    assert leaves == (8**6 if own else plan.leaves) and plan.leaves < 8**6


def test_leaves_all_around_are_announced(tmp_path):
    """Discs as wide as pixels on all walls of a room, of which a view shows a part."""
    lens = Intrinsics(48, 36, 30.0, 30.0, 24.0, 18.0)
    views = room_cameras(12, lens)
    folder = write_photographs(tmp_path / "room", views, [draw(camera, trace_room, 1) for camera in views])
    config = settings_of(folder, tmp_path)
    config.scene = "room"
    run = run_of(config)
    stage, announced = octree_start._how_fine(run, 10**6)
    assert stage is not None
    means, scales, side = [], [], 0.03
    for axis in range(3):
        across = np.meshgrid(*[np.arange(-half, half, 0.7 * side) for half in np.delete(HALF, axis)])
        for sign in (-1, 1):
            wall = np.stack([a.reshape(-1) for a in across], 1)
            means.append(np.insert(wall, axis, sign * HALF[axis], axis=1))
            scales.append(np.tile(np.where(np.arange(3) == axis, 0.1 * side, side), (len(wall), 1)))
    means, scales = np.concatenate(means), np.log(np.concatenate(scales))
    n, data = len(means), run.data.training
    walls = Splats(means, scales, np.tile([1.0, 0, 0, 0], (n, 1)), np.full(n, 4.0), dc_of_colour(np.full((n, 3), 0.5)))
    cameras = [camera.scaled(stage[1]) for camera in data.cameras]
    octree = convert.surfaces_of(walls, data.scene, cameras, (1, 1, 1), stage[0])
    view = surface_leaves(n, lens.width * lens.height // stage[1] ** 2)
    assert view < octree.n_leaves <= announced


def test_a_lens_that_cannot_be_undone_leaves_low_density(tmp_path, scene, monkeypatch):
    """... where nobody asked for splats."""

    def folded(*arguments, **keywords):
        raise InputError("the lens distortion cannot be undone")

    monkeypatch.setattr(octree_start, "Photographs", folded)
    said = []
    config = settings_of(scene, tmp_path / "auto", init="auto", time_budget=30.0)
    out = start(config, started=time.perf_counter() - 100, say=said.append)
    assert any(line.startswith("start: low density, for there can be no splats first: the lens") for line in said)
    assert list(metrics_of(out)["steps"]) == ["octree"] and metrics_of(out)["init"] == "auto"
    with pytest.raises(InputError, match="cannot be undone"):
        start(settings_of(scene, tmp_path / "asked"))
