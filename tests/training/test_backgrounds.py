"""Few cut-out pictures before two backgrounds: what has the colour of the first is found by the second."""

import dataclasses

import numpy as np
import pytest

from nerfvol.config.field import FieldConfig
from nerfvol.config.octree import OctreeConfig
from nerfvol.config.training import Config
from nerfvol.datasets.dataset import Dataset
from nerfvol.training.backgrounds import farthest, second_background
from nerfvol.training.compiled_field import CompiledFieldTrainer
from nerfvol.training.field_phase import domain_of
from nerfvol.training.memory import OctreePlan
from nerfvol.training.octree_trainer import OctreeTrainer
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
    """An octree and a field have its silhouette, to a quarter of opacity on average, with two backgrounds; with one what is in
    the ball is worth as much as what is beside it."""
    tuner = OctreeTrainer(white_ball, WHITE, dataclasses.replace(OCTREE, two_backgrounds=two), 0)
    field = CompiledFieldTrainer(
        white_ball, domain_of(white_ball.scene), dataclasses.replace(SMALL, few_views=8 * two), 0, WHITE
    )
    for k in range(80):
        tuner.step(k / 80)
        field.step(k / 80)
    camera, truth = white_ball.cameras[3], white_ball.images[3][..., 3] == 255
    drawn = (
        render_image(tuner.octree, camera, outputs=("opacity",)),
        field.trained_field().render(camera, WHITE, ["opacity"]),
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


@pytest.mark.parametrize("two, init, few, held", [
    (False, "mlp", 16, 2), (False, "direct", 16, 1), (True, "direct", 0, 2), (False, "mlp", 0, 1),
])  # fmt: skip
def test_memory_counts_the_backgrounds_of_field_and_octree(white_ball, two, init, few, held):
    """The field of few views has both, whatever is said of the octree."""
    sections = {"octree": OctreeConfig(two_backgrounds=two), "field": FieldConfig(few_views=few)}
    plan = OctreePlan(Config(data="d", out="o", init=init, **sections), white_ball, 0)
    assert plan._other.backgrounds == held


def test_the_same_bits_resumed_after_an_odd_step(compiled, white_ball):
    config = dataclasses.replace(OCTREE, two_backgrounds=True)
    whole, first, second = (OctreeTrainer(white_ball, WHITE, config, 0) for _ in range(3))
    for k in range(6):
        whole.step(k / 6)
    for k in range(3):
        first.step(k / 6)
    second.load_state_dict(first.state_dict())
    for k in range(3, 6):
        second.step(k / 6)
    assert whole.octree.values.tobytes() == second.octree.values.tobytes()
