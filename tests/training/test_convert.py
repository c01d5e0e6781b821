"""Converting there and back: a sphere of discs becomes an octree of the same radius, whose leaves show it again."""

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, orbit
from nerfvol.config.octree import PHOTOGRAPHS_FROM_SURFACES, OctreeConfig
from nerfvol.config.training import Config
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.measure.metrics import psnr
from nerfvol.region import SceneBounds
from nerfvol.rotations import turning_z_to
from nerfvol.splats.points import dc_of_colour
from nerfvol.splats.splats import Splats
from nerfvol.starts.gaussians import splats_of_leaves
from nerfvol.training import convert, finishing, tuning
from nerfvol.training.convert import cameras_around, discs_of, octree_of, seen_by
from nerfvol.views import OctreeModel, SplatModel
from tests.fixtures.tiny import TINY_RADIUS, sphere_colour

WHITE = (1.0, 1.0, 1.0)
SCENE = SceneBounds(np.array([[-1.0] * 3, [1.0] * 3]), None, False)
LEVEL = 5
SIDE = 2 / 2**LEVEL


def sphere_of_discs(n: int = 1200) -> SplatModel:
    """Discs evenly on the sphere of TINY_RADIUS, so wide that it is closed."""
    k = np.arange(n) + 0.5
    z, turn = 1 - 2 * k / n, k * np.pi * (1 + np.sqrt(5))
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], 1)
    apart = TINY_RADIUS * np.sqrt(4 * np.pi / n)
    scales = np.tile([0.6 * apart, 0.6 * apart, 0.1 * apart], (n, 1))
    colours = sphere_colour(TINY_RADIUS * normals)
    return SplatModel(
        Splats(TINY_RADIUS * normals, np.log(scales), turning_z_to(normals), np.full(n, 3.0), dc_of_colour(colours))
    )


def cameras(n: int, elevation: float):
    lens = Intrinsics(64, 64, 90, 90, 32, 32)
    return orbit(n, center=(0, 0, 0), radius=3.2, elevation_deg=elevation, intrinsics=lens)


@pytest.fixture(scope="module")
def converted():
    """The discs, pictures of them and their octree."""
    discs = sphere_of_discs()
    seen = seen_by(discs, cameras(8, -30) + cameras(8, 30), SCENE, WHITE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(convert, "FITTED_STEPS", 80)
        octrees = []
        for threads in (1, 2):
            before = ops.get_threads()
            ops.set_threads(threads)
            octrees.append(octree_of(discs.splats, SCENE, seen.cameras, WHITE, LEVEL))
            ops.set_threads(before)
    return discs, seen, octrees


def test_the_octree_stands_where_the_splats_do(converted):
    """From cameras that it was not fitted to: closed, and half of the light is gone within a leaf's diagonal of the sphere."""
    discs, _, (octree, _) = converted
    for camera in cameras(3, 5):
        image = OctreeModel(octree).render(camera, WHITE, ("rgb", "opacity", "median_depth"), 0.0, 0.0)
        origin, directions = camera.rays_at(np.stack(np.meshgrid(*[np.arange(64) + 0.5] * 2), -1).reshape(-1, 2))
        b = directions @ origin
        miss = np.sqrt(np.maximum(origin @ origin - b * b, 0)).reshape(64, 64)
        distance = (-b - np.sqrt(np.maximum(b * b - origin @ origin + TINY_RADIUS**2, 0))).reshape(64, 64)
        facing = miss < 0.7 * TINY_RADIUS
        assert image["opacity"][facing].min() > 0.5 and image["opacity"][facing].mean() > 0.98
        assert image["opacity"][miss > TINY_RADIUS + 3 * SIDE].max(initial=0) < 0.05
        assert np.abs(image["median_depth"] - distance)[facing].max() < np.sqrt(3) * SIDE
        assert psnr(image["rgb"], discs.render(camera, WHITE)["rgb"]) > 25


def test_no_leaf_is_empty_space_and_no_visible_disc_is_without(converted):
    discs, _, (octree, _) = converted
    splats = discs.splats
    assert (octree.query(splats.means + splats.origin) >= 0).mean() > 0.98  # those at the poles may be in no picture
    beyond = np.abs(np.linalg.norm(octree.leaf_centers(), axis=1) - TINY_RADIUS)
    assert beyond.max() < 2 * np.exp(splats.log_scales[:, 2].max()) + np.sqrt(3) * 2 * SIDE


def test_the_same_octree_for_any_number_of_threads(converted):
    a, b = converted[2]
    np.testing.assert_array_equal(a.values, b.values)
    np.testing.assert_array_equal(a.leaf_ijk, b.leaf_ijk)


@pytest.mark.parametrize("way", ["as leaves", "as discs"])
def test_and_back(converted, way):
    """Splats of the octree show the sphere again, on its place."""
    _, seen, (octree, _) = converted
    model = SplatModel(splats_of_leaves(octree) if way == "as leaves" else discs_of(octree, seen, WHITE))
    opaque = model.splats.select(np.flatnonzero(model.splats.logits > 0))
    radius = np.linalg.norm(opaque.means + opaque.origin, axis=1)
    assert opaque.n > 500 and np.abs(radius - TINY_RADIUS).max() < 3 * SIDE
    camera = cameras(3, 5)[1]
    assert psnr(model.render(camera, WHITE)["rgb"], OctreeModel(octree).render(camera, WHITE)["rgb"]) > 23


def test_cameras_all_around_see_all_of_it():
    discs = sphere_of_discs(200)
    around = cameras_around(discs)
    corners = np.stack(np.meshgrid(*np.stack(discs.aabb()).T, indexing="ij"), -1).reshape(-1, 3)
    for camera in around:
        pixels = camera.project(corners)
        assert ((pixels >= 0) & (pixels <= (camera.intrinsics.width, camera.intrinsics.height))).all()
    directions = np.stack([c.position for c in around]) - discs.aabb().mean(0)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.abs(directions.mean(0)).max() < 0.02


class Ticking:
    """A phase on a clock of its own: a step takes a second, a picture two, writing three."""

    timed_at = 1

    def __init__(self, now: float) -> None:
        self.now, self.progress = now, []

    def picture(self, camera):
        self.now += 2

    def seconds_to_write(self) -> float:
        return 3.0

    def step(self, progress):
        self.now += 1
        self.progress.append(progress)

    def size(self) -> str:
        return "nothing"

    def outcome(self) -> None:
        return None


@pytest.mark.parametrize("begun, ends", [(10.0, 40 - 3 - 1.1 * 2 * 2), (50.0, None)])
def test_a_time_budget_is_that_of_the_whole_command(monkeypatch, begun, ends):
    """What came before the training counts, and what comes after it, writing and two views to score, is kept: it is over at
    most a step and a look at a picture later. Where nothing is left there is one step."""
    phase = Ticking(begun)
    monkeypatch.setattr(tuning, "process_seconds", lambda: phase.now)
    monkeypatch.setattr(finishing.time, "perf_counter", lambda: phase.now)
    tuning._run(phase, cameras(1, 0)[0], 40.0, 2, lambda sentence: None)
    assert phase.progress[0] == 0
    if ends is None:
        assert len(phase.progress) == 1
    else:
        assert ends <= phase.now < ends + 3 and phase.progress == sorted(phase.progress) and phase.progress[-1] > 0.8


def test_what_is_looked_at_are_the_pictures_of_the_fit(converted):
    """One drawing tells surfaces and is fitted to: its picture is the one that :func:`seen_by` takes, and the colours without
    background and the opacity beside it make it again, to half a level and a rounding of 1/255 where nothing is opaque."""
    discs, seen, _ = converted
    views, images = convert.looked_at(discs, seen.cameras, WHITE)
    for view, image, taken in zip(views, images, seen.images, strict=True):
        np.testing.assert_array_equal(image, taken)
        opacity = view.opacity[..., None]
        again = 255 * (view.rgb * opacity + (1 - opacity) * np.array(WHITE))
        assert np.abs(again - image).max() < 0.5 + 1
    assert [len(convert.evenly(range(n), 5)) for n in (3, 5, 9)] == [3, 5, 5]
    assert convert.evenly(range(9), 3) == [0, 4, 8]


def test_few_pictures_are_looks_and_all_are_fitted_to(converted, monkeypatch):
    discs, seen, _ = converted
    monkeypatch.setattr(convert, "LOOKS", 3)
    views, images = convert.looked_at(discs, seen.cameras, WHITE)
    assert [view.camera.position.tolist() for view in views] == [
        camera.position.tolist() for camera in convert.evenly(seen.cameras, 3)
    ]
    for image, taken in zip(images, seen.images, strict=True):
        np.testing.assert_array_equal(image, taken)


@pytest.mark.parametrize("is_unbounded", [False, True])
def test_photographs_are_tuned_with_settings_of_their_own(monkeypatch, is_unbounded):
    """Those that nobody chose; what was chosen stays, and objects have what they always have."""
    seen = []

    def trainer(dataset, background, settings, seed, octree):
        seen.append(settings)
        raise StopIteration

    monkeypatch.setattr(tuning, "OctreeTrainer", trainer)
    scene = SceneBounds(SCENE.aabb, np.array([[-4.0] * 3, [4.0] * 3]) if is_unbounded else None, False)
    dataset = Dataset(cameras(2, 0), [np.zeros((64, 64, 3), np.uint8)] * 2, ["a", "b"], scene, "two views")
    for config in (Config(), Config(octree=OctreeConfig(sparsity=0.5))):
        with pytest.raises(StopIteration):
            tuning.tuned_octree(None, dataset, WHITE, config)
    own = PHOTOGRAPHS_FROM_SURFACES if is_unbounded else {"sparsity": None, "decay_from": None}
    assert [(s.sparsity, s.decay_from) for s in seen] == [
        (own["sparsity"], own["decay_from"]),
        (0.5, own["decay_from"]),
    ]


@pytest.mark.parametrize("n", [16, 17])
def test_a_fit_to_few_pictures_is_as_smooth_as_training_on_few(monkeypatch, n):
    seen = []

    def trainer(dataset, background, settings, seed, octree):
        seen.append(settings)
        raise StopIteration

    monkeypatch.setattr(convert, "OctreeTrainer", trainer)
    with pytest.raises(StopIteration):
        octree_of(sphere_of_discs(50).splats, SCENE, cameras(n, 20), WHITE, 3)
    trained = Config(representation="octree").for_views(n, SCENE).octree
    assert (seen[0].tv_density, seen[0].tv_sh) == (trained.tv_density, trained.tv_sh)
    assert (seen[0].tv_density is None) == (n > 16)


@pytest.mark.parametrize("offset, scale", [((4e5, 5e6, 100.0), 1.0), ((0.0, 0.0, 0.0), 1e6)])
def test_where_the_scene_is_and_in_what_unit_changes_nothing(monkeypatch, offset, scale):
    """In map coordinates, where float32 tells no two rays apart, and in units a million times smaller."""
    monkeypatch.setattr(convert, "FITTED_STEPS", 20)
    discs, offset = sphere_of_discs(400).splats, np.array(offset)
    moved = Splats(
        scale * discs.means,
        discs.log_scales + np.log(scale),
        discs.quats,
        discs.logits,
        discs.sh,
        discs.origin + offset,
    )
    there = SceneBounds(scale * SCENE.aabb + offset, None, False)
    around = cameras(4, -30) + cameras(4, 30)
    placed = []
    for camera in around:
        pose = camera.c2w.copy()
        pose[:3, 3] = scale * pose[:3, 3] + offset
        placed.append(Camera(camera.intrinsics, pose))
    here, far = octree_of(discs, SCENE, around, WHITE, 4), octree_of(moved, there, placed, WHITE, 4)
    np.testing.assert_allclose(far.origin, scale * here.origin + offset, rtol=0, atol=1e-9 * scale)
    error = [
        psnr(OctreeModel(octree).render(camera, WHITE)["rgb"], discs_model.render(camera, WHITE)["rgb"])
        for octree, discs_model, camera in ((here, SplatModel(discs), around[1]), (far, SplatModel(moved), placed[1]))
    ]
    # What differs is rounding, which a fit of 20 steps carries on; rays that are not told apart lose tens of dB.
    assert abs(error[0] - error[1]) < 1 and error[0] > 25


def test_splats_that_no_leaf_shows_are_refused():
    discs = sphere_of_discs(50).splats
    discs.logits[:] = -9
    with pytest.raises(InputError, match="none of the splats is seen"):
        octree_of(discs, SCENE, cameras(4, 20), WHITE, 4)


def test_one_gaussian_alone_becomes_an_octree():
    one = sphere_of_discs(1).splats
    one.log_scales[:] = np.log(0.2)
    one.means[:], one.origin[:] = -0.1, 0.5  # places are relative to the splats' own origin
    octree = octree_of(one, SCENE, cameras(6, -30) + cameras(6, 30), WHITE, LEVEL)
    view = cameras(3, 5)[1]
    drawn = [model.render(view, WHITE, ("rgb", "opacity")) for model in (SplatModel(one), OctreeModel(octree))]
    assert psnr(drawn[1]["rgb"], drawn[0]["rgb"]) > 25
    assert abs(drawn[1]["opacity"].mean() - drawn[0]["opacity"].mean()) < 0.1 * drawn[0]["opacity"].mean()
    assert np.linalg.norm(octree.leaf_centers() - 0.4, axis=1).max() < 3 * 0.2
