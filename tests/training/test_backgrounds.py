"""Few cut-out pictures before two backgrounds: what has the colour of the first is found by the second."""

import dataclasses

import numpy as np
import pytest

from nerfvol.config.field import FieldConfig
from nerfvol.config.octree import OctreeConfig
from nerfvol.config.splats import SplatConfig
from nerfvol.config.training import Config
from nerfvol.datasets.averages import composite_average
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.photographs import Photographs
from nerfvol.starts.cloud import splats_of_cloud
from nerfvol.starts.random import random_points
from nerfvol.training import tuning
from nerfvol.training.backgrounds import farthest, second_background
from nerfvol.training.compiled_field import CompiledFieldTrainer
from nerfvol.training.field_phase import domain_of
from nerfvol.training.memory.octree import OctreePlan
from nerfvol.training.memory.splats import photographs_held
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.training.splat_schedule import Schedule
from nerfvol.training.splat_trainer import SplatTrainer
from nerfvol.views import render_image
from tests.training.test_compiled_field import SMALL
from tests.training.test_field_trainer import ball_dataset

WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)
OCTREE = OctreeConfig(levels=[4], downscales=[1], stage_ends=[1.0], tiles=[64], prunes=[0])


@pytest.fixture(scope="module")
def white_ball() -> Dataset:
    """What cannot be seen before white."""
    dataset = ball_dataset()
    return dataclasses.replace(dataset, images=[np.maximum(i, i[..., 3:]) for i in dataset.images])


def splat_trainer(dataset: Dataset, two: bool) -> SplatTrainer:
    """Of faint splats anywhere in the box."""
    photographs = Photographs(dataset, WHITE, second=second_background(dataset, WHITE, two))
    cloud = random_points(dataset.scene, 600)
    splats = splats_of_cloud(cloud, photographs.cameras, 3.5, 0, "mip", 0.1)
    config = SplatConfig(sh_degree=0).for_scene(dataset.scene)
    return SplatTrainer(photographs, splats, config, Schedule((2, 1), (0.5, 1.0), 600, 0.6), 3.5, WHITE)


@pytest.mark.parametrize("given, other", [
    (WHITE, BLACK), (BLACK, WHITE), ((0.5, 0.4, 0.6), (0.0, 1.0, 0.0)), ((0.0, 0.7, 1.0), (1.0, 0.0, 0.0)),
])  # fmt: skip
def test_the_second_is_the_farthest_colour(white_ball, given, other):
    corners = np.stack(np.meshgrid(*[[0.0, 1.0]] * 3), -1).reshape(-1, 3)
    distances = np.linalg.norm(corners - given, axis=1)
    assert farthest(given) == other and np.linalg.norm(np.subtract(other, given)) == distances.max()
    assert second_background(white_ball, given, True) == other
    assert second_background(white_ball, given, False) is None
    opaque = dataclasses.replace(white_ball, images=[i[..., :3] for i in white_ball.images])
    assert second_background(opaque, given, True) is None
    painted = [np.dstack([i[..., :3], np.full_like(i[..., 3], 255)]) for i in white_ball.images[:1]]
    assert (
        second_background(dataclasses.replace(white_ball, images=[*painted, *white_ball.images[1:]]), given, True)
        is None
    )


@pytest.mark.parametrize("two", [False, True])
def test_a_white_ball_before_white(compiled, white_ball, two):
    """An octree, a field and splats have its silhouette, to a quarter of opacity on average, with two backgrounds; with one
    what is in the ball is worth as much as what is beside it."""
    splats = splat_trainer(white_ball, two)
    tuner = OctreeTrainer(white_ball, WHITE, dataclasses.replace(OCTREE, two_backgrounds=two), 0)
    field = CompiledFieldTrainer(
        white_ball, domain_of(white_ball.scene), dataclasses.replace(SMALL, few_views=8 * two), 0, WHITE
    )
    for k in range(80):
        tuner.step(k / 80)
        field.step(k / 80)
        splats.step(k / 80)
    camera, truth = white_ball.cameras[3], white_ball.images[3][..., 3] == 255
    drawn = (
        render_image(tuner.octree, camera, outputs=("opacity",)),
        field.trained_field().render(camera, WHITE, ["opacity"]),
        splats.take_model({}).render(camera, WHITE, outputs=("opacity",)),
    )
    for found in (views["opacity"] for views in drawn):
        contrast = found[truth].mean() - found[~truth].mean()
        assert contrast > 0.5 if two else contrast < 0.25


def test_runs_of_few_views_have_two(white_ball):
    """As other settings for few views: where nobody said."""
    scene = white_ball.scene
    for n, said, has in ((8, None, True), (17, None, False), (8, False, False), (17, True, True)):
        config = Config(data="d", out="o", octree=dataclasses.replace(OctreeConfig(), two_backgrounds=said))
        settled = config.for_views(n, scene).for_scene(scene)
        assert settled.octree.two_backgrounds is has


@pytest.mark.parametrize("representation", ["splats", "octree"])  # which may begin with splats
@pytest.mark.parametrize("n, degree", [(16, 1), (17, 2)])
def test_splats_of_all_cut_out_objects_have_two(white_ball, representation, n, degree):
    """Where nobody said; those of few views have little view dependence."""
    photographs = dataclasses.replace(white_ball.scene, background_cube=16 * white_ball.scene.aabb)
    for said, sh in ((None, None), (False, 0), (True, 3)):
        splats = SplatConfig(two_backgrounds=said, sh_degree=sh)
        config = Config(data="d", out="o", representation=representation, splats=splats)
        settled = config.for_views(n, white_ball.scene).for_scene(white_ball.scene).splats
        assert settled.two_backgrounds is (said is not False) and settled.sh_degree == (degree if sh is None else sh)
        assert config.for_views(n, photographs).for_scene(photographs).splats.two_backgrounds is (said is True)


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_photographs_before_two_backgrounds(white_ball, share):
    """Each at every size, what is kept of them within the bound that is stated."""
    second = second_background(white_ball, WHITE, True)
    stated, kept = photographs_held(white_ball, Photographs(white_ball, WHITE, second=second), (2, 1))
    bound = int(share * (stated - white_ball.nbytes))
    photographs = Photographs(white_ball, WHITE, most_bytes=bound if share < 1 else None, second=second)
    seen = {f: [photographs.view(3, f, second=which).image for which in (False, True, False, True)] for f in (2, 1)}
    for factor, views in seen.items():
        for view, colour in zip(views, (WHITE, BLACK) * 2, strict=True):
            truth = composite_average(white_ball.images[3], colour, factor)
            assert np.abs(view[: len(truth), : len(truth), :3].astype(int) - truth).max() <= (factor > 1)
    for factor in (2, 1):
        for which in (False, True):
            for i in range(len(photographs)):
                photographs.view(i, factor, which)
    assert kept == 1 and 0.9 * bound < photographs.nbytes <= bound
    assert white_ball.nbytes + photographs.nbytes == stated or share < 1
    photographs.drop(2)
    assert photographs.held <= {1} and photographs.nbytes < bound


@pytest.mark.parametrize("two, init, few, held", [
    (False, "mlp", 16, 2), (False, "direct", 16, 1), (True, "direct", 0, 2), (False, "mlp", 0, 1),
])  # fmt: skip
def test_memory_counts_the_backgrounds_of_field_and_octree(white_ball, two, init, few, held):
    """The field of few views has both, whatever is said of the octree."""
    sections = {"octree": OctreeConfig(two_backgrounds=two), "field": FieldConfig(few_views=few)}
    plan = OctreePlan(Config(data="d", out="o", init=init, **sections), white_ball, 0)
    assert plan._other.backgrounds == held


def six_steps_and_resumed_after_three(make):
    """Two trainers after six steps: one made them at once, the other three of them from the state of a third."""
    whole, first, resumed = make(), make(), make()
    for k in range(6):
        whole.step(k / 6)
    for k in range(3):
        first.step(k / 6)
    resumed.load_state_dict(first.state_dict())
    for k in range(3, 6):
        resumed.step(k / 6)
    return whole, resumed


def test_the_same_bits_resumed_after_an_odd_step(compiled, white_ball):
    config = dataclasses.replace(OCTREE, two_backgrounds=True)
    whole, resumed = six_steps_and_resumed_after_three(lambda: OctreeTrainer(white_ball, WHITE, config, 0))
    assert whole.octree.values.tobytes() == resumed.octree.values.tobytes()


def test_the_same_splats_resumed_after_an_odd_step(compiled, white_ball):
    whole, resumed = six_steps_and_resumed_after_three(lambda: splat_trainer(white_ball, True))
    assert whole.state.params.tobytes() == resumed.state.params.tobytes()


@pytest.mark.parametrize("few, said, degree", [(16, None, 1), (4, None, 2), (16, False, 1)])
def test_splats_that_a_conversion_trains_have_two(compiled, white_ball, monkeypatch, few, said, degree):
    seen: list[SplatTrainer] = []
    monkeypatch.setattr(tuning, "_run", lambda phase, *_: seen.append(phase))
    config = Config(data="d", out="o", field=FieldConfig(few_views=few), splats=SplatConfig(two_backgrounds=said))
    splats = splat_trainer(white_ball, False).state.splats()
    tuning.tuned_splats(splats, white_ball, WHITE, config)
    assert seen[0].photographs.second == (BLACK if said is None else None) and seen[0].config.sh_degree == degree
