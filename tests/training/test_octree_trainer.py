"""Coarse to fine: when leaves go and when they are split."""

import copy
import dataclasses
import weakref

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.config.octree import OctreeConfig
from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from nerfvol.kernels import ops
from nerfvol.measure.leaf_width import visible_widths
from nerfvol.octree.rows import DENSITY_SLOT, explin_inverse
from nerfvol.octree.topology import MAX_LEVEL
from nerfvol.octree.tree import Octree
from nerfvol.region import SceneBounds
from nerfvol.starts.fog import low_density_octree
from nerfvol.training import octree_schedule
from nerfvol.training.octree_trainer import OctreeTrainer
from nerfvol.views import render_image


def test_nothing_is_pruned_before_it_could_become_visible(tiny_scene):
    """A low-density start needs steps: however few the tiles and however short the stage, pruning waits for them."""
    config = OctreeConfig(
        levels=[4, 5], downscales=[4, 2], stage_ends=[0.001, 1.0], tiles=[4, 4], prunes=[1, 1], prune_steps=8
    )
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    leaves = tuner.octree.n_leaves
    for _ in range(8):
        tuner.step(0.5)
        assert tuner.octree.n_leaves == leaves and tuner.stage == 0
    tuner.step(0.5)
    assert tuner.prunings == 1 and tuner.octree.n_leaves < leaves


@pytest.mark.parametrize("steps, waits", [(60, 10), (300, 15), (4000, 20)])
def test_a_short_run_comes_to_its_finest_stage(tiny_scene, steps, waits):
    """Where a machine is slow, a time budget holds few steps: each stage then has a pruning after fewer of them."""
    config = OctreeConfig(
        levels=[4, 5, 5], downscales=[4, 2, 1], stage_ends=[0.1, 0.3, 1.0], tiles=[4, 4, 4], prunes=[1, 1, 1],
        prune_steps=20,
    )  # fmt: skip
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    for step in range(60):
        tuner.step(step / steps)
    assert octree_schedule.prune_steps(config, tuner._steps_in_all()) == pytest.approx(waits, rel=0.02)
    assert tuner.stage == (2 if steps == 60 else 1 if steps == 300 else 0)


def test_splitting_stays_within_the_memory(tiny_scene, capsys):
    """Where memory allows fewer leaves than a stage wants, it splits those with the largest error, and says so."""
    config = OctreeConfig(
        levels=[4, 5], downscales=[2, 1], stage_ends=[0.01, 1.0], tiles=[16, 16], prunes=[0, 0], prune_steps=4
    )
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    tuner.max_leaves = 6000
    for _ in range(9):
        tuner.step(0.5)
    assert tuner.stage == 1 and tuner.octree.n_leaves <= 6000
    assert "memory allows 6,000 leaves" in capsys.readouterr().out


def finished_trainer(tiny_scene, weight_of_needed: float) -> tuple[OctreeTrainer, np.ndarray]:
    """A trainer after some steps, a third of its leaves emptied, and which of them are needed.

    The empty ones claim a largest weight of 0.015, the others ``weight_of_needed``.
    """
    config = OctreeConfig(levels=[4], downscales=[2], stage_ends=[1.0], tiles=[16], prunes=[0], prune_steps=8)
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    for _ in range(30):
        tuner.step(0.5)
    octree = tuner.octree
    needed = octree.leaf_ijk[:, 0] < 11
    octree.density[octree.corners[~needed]] = -60.0
    tuner.state.max_weight[:] = np.where(needed, weight_of_needed, 0.015)
    return tuner, needed


def test_the_last_pruning_takes_what_no_picture_misses(tiny_scene):
    """The largest threshold that costs nothing: 0.04 would take what is needed, 0.02 takes the rest, 0.01 nothing."""
    tuner, needed = finished_trainer(tiny_scene, 0.03)
    assert ((tuner.finish().query(tuner.octree.leaf_centers()) >= 0) == needed).all()


def test_the_last_pruning_leaves_what_pictures_miss(tiny_scene):
    """In thick media every leaf weighs little: all claim too small a weight, and none may go for it."""
    tuner, _ = finished_trainer(tiny_scene, 0.001)
    tuner.state.max_weight[::2] = 1.0  # half would stay
    assert tuner.finish() is tuner.octree


def test_the_last_pruning_has_the_memory_to_itself(tiny_scene, monkeypatch):
    """Two octrees are in memory while they are compared: moments, statistics and tiles are released before."""
    tuner, _ = finished_trainer(tiny_scene, 0.03)
    held = [weakref.ref(part) for part in (tuner.state, tuner.state.moments, tuner.bank, tuner.bank.pixels[0])]
    alive = []

    def prune(octree, keep):
        alive.append([part() is not None for part in held])
        return pruned(octree, keep)

    pruned = Octree.prune
    monkeypatch.setattr(Octree, "prune", prune)
    tuner.finish()
    assert alive and not np.any(alive)


def test_the_last_pruning_needs_to_have_seen_enough(tiny_scene):
    """Right after a pruning nothing is known of what rays need."""
    tuner, _ = finished_trainer(tiny_scene, 0.03)
    tuner.tiles_seen = 0
    assert tuner.finish() is tuner.octree


def test_the_last_pruning_of_a_resumed_run_without_a_step_is_the_same(tiny_scene):
    """A short run's rays have seen enough sooner; how short it was is in its checkpoint."""
    config = OctreeConfig(levels=[4], downscales=[2], stage_ends=[1.0], tiles=[16], prunes=[0], prune_steps=10**6)
    first, again = (OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None) for _ in range(2))
    for step in range(30):
        first.step((step + 1) / 30)
    empty = first.octree.leaf_ijk[:, 0] >= 11
    first.octree.density[first.octree.corners[empty]] = -60.0
    first.state.max_weight[:] = np.where(empty, 0.0, 1.0)
    first.state.footprint[:] = 1.0
    again.load_state_dict(first.state_dict())
    whole, resumed = first.finish(), again.finish()
    assert whole.n_leaves < first.octree.n_leaves and resumed.n_leaves == whole.n_leaves
    with pytest.raises(ValueError, match="progress nan"):
        again.load_state_dict(
            {**OctreeTrainer(first.dataset, (1, 1, 1), config).state_dict(), "progress": float("nan")}
        )


def test_one_stage_of_a_given_octree_is_the_last(tiny_scene):
    """What begins with surfaces has one, and would never come to another."""
    config = OctreeConfig(
        levels=[4], downscales=[2], stage_ends=[1.0], tiles=[16], prunes=[0], sh_degree=1, final_sh_degree=2
    )
    dataset = load_dataset(tiny_scene, "train")
    given = low_density_octree(dataset, 4, 1)
    tuner, again = (OctreeTrainer(dataset, (1, 1, 1), config, 0, given) for _ in range(2))
    for _ in range(3):
        tuner.step(0.5)
    assert tuner.octree.sh_degree == 2 and tuner.octree.sh[:, :, 4:].any()
    again.load_state_dict(tuner.state_dict())
    assert np.array_equal(again.octree.values, tuner.octree.values)


def test_the_last_stage_has_more_bands(tiny_scene):
    """They begin at zero, so the picture does not change; then they learn, and a resumed run has them too."""
    config = OctreeConfig(
        levels=[4, 4, 4], downscales=[2, 2, 2], stage_ends=[0.1, 0.2, 1.0], tiles=[16, 16, 16], prunes=[0, 0, 0],
        prune_weight=0.0, sh_degree=1, final_sh_degree=2,
    )  # fmt: skip
    dataset = load_dataset(tiny_scene, "train")
    tuner = OctreeTrainer(dataset, (1, 1, 1), config, 0, None)
    for _ in range(5):
        tuner.step(0.0)
    tuner.next_stage()
    before, moments = tuner.octree, tuner.state.moments
    tuner.next_stage()
    assert (before.sh_degree, tuner.octree.sh_degree) == (1, 2)
    for camera in dataset.cameras[:2]:
        assert np.array_equal(*(render_image(octree, camera)["rgb"] for octree in (before, tuner.octree)))
    density = [values[:, DENSITY_SLOT] for values in (moments, tuner.state.moments)]
    assert density[0].any() and np.array_equal(*density)
    for _ in range(3):
        tuner.step(0.5)
    assert tuner.octree.sh[:, :, 4:].any()
    again = OctreeTrainer(dataset, (1, 1, 1), config, 0, None)
    again.load_state_dict(tuner.state_dict())
    for trainer in (tuner, again):
        trainer.step(0.6)
    assert np.array_equal(again.octree.values, tuner.octree.values)


@pytest.mark.parametrize(
    "setting, expected",
    [
        ("sh_degree=7", "sh_degree: expected a number from 0 to 3, got 7"),
        ("final_sh_degree=4", "final_sh_degree: expected a number from 0 to 3, got 4"),
        ("rate_decay=0", "rate_decay: expected a number above 0 and at most 1, got 0.0"),
        ("decay_from=1.0", "decay_from: expected a number from 0 to 0.999, got 1.0"),
        ("levels=[5, 40]", f"levels: expected a number from 1 to {MAX_LEVEL}, got 40"),
        ("tiles=[0]", "tiles: expected a number from 1 to 1048576, got 0"),
        ("tiles=[8]", "tiles must have one entry per stage, as many as octree.levels (7), got 1"),
        (
            "coverage=0.5",
            "coverage is no longer a setting: pruning always waits until half of the foreground tiles were seen",
        ),
    ],
)
def test_settings_that_mean_nothing_are_refused(tiny_scene, tmp_path, command, setting, expected):
    code, _, err = command("train", "--data", tiny_scene, "--out", tmp_path / "run", "--set", f"octree.{setting}")
    assert code == 2 and err.strip().endswith(f"octree.{expected}") and len(err.strip().splitlines()) == 1


def test_photographs_have_settings_of_their_own(tiny_scene):
    """Where nothing else is said; a scene with background shells is one of photographs."""
    objects, photographs = (dataset.scene for dataset in of_both_kinds(tiny_scene))
    automatic = [f.name for f in dataclasses.fields(OctreeConfig) if f.default is None]
    chosen = [dataclasses.asdict(OctreeConfig().for_scene(scene)) for scene in (objects, photographs)]
    for name in automatic:
        assert chosen[0][name] is not None
        # whether there is a second background is a matter of how many views there are
        assert (chosen[0][name] == chosen[1][name]) == (name == "two_backgrounds")
    assert [(c["sh_degree"], c["decay_from"], c["growing_error"]) for c in chosen] == [(1, 0.8, 0.0), (2, 0.35, 0.5)]
    said = OctreeConfig(**dict.fromkeys(automatic, 0.25) | {"sh_degree": 0, "tv_from": 7, "two_backgrounds": True})
    assert said.for_scene(photographs) == said == said.for_scene(objects)


def of_both_kinds(tiny_scene) -> list[Dataset]:
    """The scene as an object and, with background shells, as one of photographs."""
    dataset = load_dataset(tiny_scene, "train")
    around = dataclasses.replace(dataset.scene, background_cube=8 * dataset.scene.aabb)
    return [dataset, dataclasses.replace(dataset, scene=around)]


def test_a_run_has_the_settings_of_its_scene(tiny_scene):
    config = OctreeConfig(levels=[3], downscales=[4], stage_ends=[1.0], tiles=[8], prunes=[0])
    for images, degree in zip(of_both_kinds(tiny_scene), (1, 2), strict=True):
        trainer = OctreeTrainer(images, (1, 1, 1), config, 0, None)
        assert trainer.octree.sh_degree == degree


@pytest.mark.parametrize("progress, begins", [(0.7, False), (0.3, True)])
def test_a_coarse_stage_needs_steps_for_its_prunings(tiny_scene, monkeypatch, progress, begins):
    """Two prunings of a short run take 20 steps: 30 in seven tenths of it leave 12, in three tenths 70."""
    monkeypatch.setattr(octree_schedule, "COVERAGE", 0)
    config = OctreeConfig(levels=[3, 4], downscales=[4, 4], stage_ends=[0.1, 1.0], tiles=[8, 8], prunes=[0, 2])
    steps_taken(monkeypatch)
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    for _ in range(30):
        tuner.step(0.05)
    with_error_in(tuner, np.arange(512) % 100 == 0)
    tuner.step(progress)
    assert tuner.stage == begins


def steps_taken(monkeypatch) -> list[ops.LossOptions]:
    """Options of the steps to come, which do nothing."""
    seen = []

    def train_step(octree, state, batch, options, *rest):
        seen.append(options)
        return ops.StepReport(0.1, 1.0)

    monkeypatch.setattr(ops, "train_step", train_step)
    return seen


def test_terms_of_the_loss_fade_and_smoothness_waits(tiny_scene, monkeypatch):
    config = OctreeConfig(
        levels=[3], downscales=[4], stage_ends=[1.0], tiles=[8], prunes=[0], colour_weight=0.5, distortion=0.25, tv_density=1.0,
        tv_sh=2.0, tv_from=2, sparsity=0.75, regulariser_decay=0.01,
    )  # fmt: skip
    seen = steps_taken(monkeypatch)
    trainer = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    for progress in (0.0, 0.5, 0.5, 1.0):
        trainer.step(progress)
    found = [(o.colour, o.distortion, o.tv_density, o.tv_sh) for o in seen]
    expected = [(0.5, 0.25, 0, 0), (0.05, 0.025, 0, 0), (0.05, 0.025, 0.1, 0.2), (0.005, 0.0025, 0.01, 0.02)]
    assert np.allclose(found, expected, rtol=1e-12, atol=0)
    # Rises until the rates fall, of objects at 0.8, and stays: surfaces that are left alone become haze again.
    assert [o.sparsity for o in seen] == [0, 0.75 * 0.5 / 0.8, 0.75 * 0.5 / 0.8, 0.75]


def test_photographs_have_another_colour_behind_them_each_step(tiny_scene, monkeypatch):
    """The same ones in a run that was stopped and resumed; objects have their background."""
    options = steps_taken(monkeypatch)
    config = OctreeConfig(levels=[3], downscales=[4], stage_ends=[1.0], tiles=[8], prunes=[0])
    objects, photographs = of_both_kinds(tiny_scene)
    for resumed in (False, True):
        for dataset in (objects, photographs):
            trainer = OctreeTrainer(dataset, (1, 1, 0.5), config, 3, None)
            for step in range(4):
                if resumed and step == 2:
                    state, trainer = trainer.state_dict(), OctreeTrainer(dataset, (1, 1, 0.5), config, 3, None)
                    trainer.load_state_dict(state)
                trainer.step(0.1)
    seen = [o.background for o in options]
    assert seen[:8] == seen[8:] and seen[:4] == [(1, 1, 0.5)] * 4
    colours = np.array(seen[4:8])
    assert ((colours >= 0) & (colours < 1)).all() and (np.ptp(colours, axis=0) > 0.1).all()


def with_error_in(tuner: OctreeTrainer, few: np.ndarray) -> None:
    """All leaves were met, are large and needed; nearly all of the error is in a few."""
    tuner.state.max_weight[:] = 1.0
    tuner.state.footprint[:] = 100.0
    tuner.state.error[:] = np.where(few, 1.0, 1e-6)


def test_a_coarse_stage_splits_what_holds_the_error(tiny_scene):
    """Down to its level; what is around it, haze that will be pruned, stays as it is."""
    config = OctreeConfig(
        levels=[3, 5], downscales=[4, 4], stage_ends=[0.1, 1.0], tiles=[8, 8], prunes=[0, 0], coarse_error=0.99
    )
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    few = np.arange(512) % 100 == 0
    with_error_in(tuner, few)
    centers = tuner.octree.leaf_centers()
    tuner.next_stage()
    assert tuner.octree.n_leaves == 512 - 6 + 6 * 64
    assert (tuner.octree.leaf_level[tuner.octree.query(centers + 1e-6)] == np.where(few, 5, 3)).all()


@pytest.mark.parametrize("share, leaves", [(0.0, 512), (0.99, 512 + 6 * 7)])
def test_a_stage_grows_where_the_error_is(tiny_scene, monkeypatch, share, leaves):
    """At its prunings, also where there is nothing to prune, once each time and where asked for; and then looks again."""
    monkeypatch.setattr(octree_schedule, "COVERAGE", 0)
    config = OctreeConfig(
        levels=[3, 5], downscales=[4, 4], stage_ends=[0.1, 1.0], tiles=[8, 8], prunes=[0, 1], prune_steps=1,
        coarse_error=0.0, growing_error=share,
    )  # fmt: skip
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    tuner.stage = 1
    tuner.step(0.1)
    with_error_in(tuner, np.arange(512) % 100 == 0)
    tuner.step(0.9)
    assert tuner.octree.n_leaves == leaves and tuner.prunings == 1 and tuner.tiles_seen == 8


@pytest.mark.parametrize("share, prunes", [(0.04, False), (0.06, True)])
def test_a_pruning_that_takes_little_is_left_out(tiny_scene, share, prunes):
    """Two octrees would be in memory for nothing; what rays need is noted again all the same."""
    config = OctreeConfig(levels=[4], downscales=[2], stage_ends=[1.0], tiles=[16], prunes=[1], prune_steps=8)
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    for _ in range(30):
        tuner.step(0.0)
    octree, n = tuner.octree, tuner.octree.n_leaves
    tuner.state.max_weight[:] = np.where(np.arange(n) < share * n, 0.0, 1.0)
    tuner.step(0.9)
    assert tuner.prunings == 1 and tuner.tiles_seen == 16 and tuner.state.max_weight.max() < 1
    assert (tuner.octree is not octree) == prunes
    assert tuner.octree.n_leaves == (n - np.ceil(share * n) if prunes else n)


def test_what_no_ray_has_met_yet_is_kept(tiny_scene):
    """Until every tile was drawn for certain: what is seen at the rim of a few pictures would be lost for good."""
    config = OctreeConfig(levels=[4], downscales=[2], stage_ends=[1.0], tiles=[16], prunes=[1], prune_steps=8)
    tuner = OctreeTrainer(load_dataset(tiny_scene, "train"), (1, 1, 1), config, 0, None)
    for _ in range(10):
        tuner.step(0.0)
    third = np.arange(tuner.octree.n_leaves) % 3
    tuner.state.max_weight[:] = np.where(third == 0, 0.5, 0.001)
    tuner.state.footprint[:] = np.where(third == 2, 0.0, 1.0)  # not met
    epoch = len(tuner.bank.foreground_tiles)
    for seen, kept in [
        (0, third != 1),
        (2 * epoch, third != 1),
        (2.5 * epoch, third == 0),
    ]:  # four fifths are foreground
        tuner.tiles_seen = int(seen)
        assert np.array_equal(tuner._needed(0.005), kept)
    centers = tuner.octree.leaf_centers()
    tuner.tiles_seen = 2 * epoch
    tuner.prune()
    assert np.array_equal(tuner.octree.query(centers) >= 0, third != 1) and tuner.tiles_seen == 0


@pytest.mark.parametrize("views, keeps", [(12, True), (20, False)])
def test_few_views_do_not_judge_what_is_solid_in_a_given_octree(tiny_scene, sphere_octree, views, keeps):
    """The inside of a ball that no ray needs stays; haze goes, and with views enough all of it; resumed alike."""
    dataset = load_dataset(tiny_scene, "train")
    numbers = [i % 12 for i in range(views)]
    dataset = dataclasses.replace(dataset, cameras=[dataset.cameras[i] for i in numbers], names=[str(i) for i in range(views)],
                                  images=[dataset.images[i] for i in numbers])  # fmt: skip
    config = OctreeConfig(levels=[5], downscales=[1], stage_ends=[1.0], tiles=[16], prunes=[1], prune_steps=1)
    trainer = OctreeTrainer(dataset, (1, 1, 1), config, 0, copy.deepcopy(sphere_octree))
    trainer.step(0.0)
    octree = trainer.octree
    side, third = octree.leaf_sizes()[0], np.arange(octree.n_leaves) % 3 == 0
    corners = np.zeros(octree.n_vertices, bool)
    corners[octree.corners[third].reshape(-1)] = True
    # Opacity 1 - exp(-0.3) = 0.26 along a side where it is solid, 1e-5 where it is haze.
    octree.density[:] = explin_inverse(np.where(corners, 0.3, 1e-5) / side / octree.density_scale)
    trainer.state.max_weight[:], trainer.state.footprint[:] = 0.0, 1.0
    solid = corners[octree.corners].any(1)
    assert 0.3 < solid.mean() and np.array_equal(trainer._needed(0.005), solid & keeps)
    again = OctreeTrainer(dataset, (1, 1, 1), config, 0, None)
    again.load_state_dict(trainer.state_dict())
    assert again.keeps_solid == keeps and not OctreeTrainer(dataset, (1, 1, 1), config).keeps_solid


def test_the_outcome_counts_the_steps_of_each_size_and_says_whether_more_would_pay(tiny_scene, sphere_octree):
    """Of a ball, seen in pictures in which its leaves are about as wide as pixels, and in some four times as large."""
    dataset = load_dataset(tiny_scene, "train")
    stages = {"levels": [5, 5, 5], "stage_ends": [0.2, 0.4, 1.0], "prunes": [0, 0, 0], "prune_steps": 0}
    config = OctreeConfig(downscales=[4, 1, 1], tiles=[1, 1, 1], rate_density=0.0, **stages)
    trainer = OctreeTrainer(dataset, (1, 1, 1), config, 0, None)
    for stage, steps in enumerate((3, 2, 4)):
        trainer.stage, trainer.bank = stage, None
        for _ in range(steps):
            trainer.step(0.0)
    again = OctreeTrainer(dataset, (1, 1, 1), config, 0, None)
    again.load_state_dict(trainer.state_dict())
    again.octree = sphere_octree
    verdicts = set()
    for factor in (1, 4):
        lenses = [
            {k: factor * getattr(c.intrinsics, k) for k in ("width", "height", "fx", "fy", "cx", "cy")}
            for c in dataset.cameras
        ]
        cameras = [Camera(Intrinsics(**lens), c.c2w) for lens, c in zip(lenses, dataset.cameras, strict=True)]
        again.dataset = dataclasses.replace(dataset, cameras=cameras)
        middle = np.median(visible_widths(sphere_octree, again.dataset.cameras))
        sentence = again.outcome()
        assert sentence is not None and sentence.startswith("steps: 3 on images /4, 6 on whole images; ")
        assert f" are {middle:.1f} pixels wide" in sentence
        assert ("more time would pay" in sentence) == (middle > 2) != ("more time would sharpen little" in sentence)
        verdicts.add(middle > 2)
    assert verdicts == {True, False}
    again.stage_steps[:] = 0  # a run whose other phases took all of its time
    sentence = again.outcome()
    assert sentence is not None and sentence.startswith(
        "steps: none, for there was no time left; the leaves that are seen"
    )
    assert sentence.endswith("more time would pay")


def test_the_last_pruning_keeps_what_no_ray_has_met_yet(tiny_scene):
    tuner, needed = finished_trainer(tiny_scene, 0.03)
    tuner.state.footprint[~needed] = 0.0
    tuner.tiles_seen = tuner.config.prune_steps * 16
    centers = tuner.octree.leaf_centers()
    assert tuner.config.foreground_share * tuner.tiles_seen < 2 * len(tuner.bank.foreground_tiles)
    assert (tuner.finish().query(centers) >= 0).all()


def slab(level: int, half: int) -> Octree:
    """A flat piece of leaves of this level around the middle of [-1, 1]^3, ``half`` to each side, two deep: opaque and grey."""
    middle = 1 << (level - 1)
    xy = np.arange(middle - half, middle + half)
    cells = np.stack(np.meshgrid(xy, xy, [middle - 1, middle], indexing="ij"), -1).reshape(-1, 3)
    octree = Octree.from_leaves(np.full(len(cells), level), cells, (-1, -1, -1), 2.0, 1, 150.0)
    octree.density[:] = explin_inverse(2.0 / octree.leaf_sizes()[0] / octree.density_scale)
    return octree


def coarse_share(n: int) -> float:
    """Share of the expected square of a piecewise linear function on n intervals, of independent values at their ends, that
    its projection to n / 2 intervals keeps; of products of such functions in two directions, the square of that."""
    mass = (np.diag([2.0] + [4.0] * (n - 1) + [2.0]) + np.eye(n + 1, k=1) + np.eye(n + 1, k=-1)) / 6
    coarse = np.maximum(0, 1 - np.abs(np.arange(n + 1)[:, None] - 2 * np.arange(n // 2 + 1)) / 2)
    onto = mass @ coarse
    return float(np.trace(onto @ np.linalg.solve(coarse.T @ onto, onto.T)) / np.trace(mass))


def test_pictures_of_more_than_a_thousand_pixels_are_trained_beyond_level_10(monkeypatch):
    """Of a piece with the detail of level 11, seen in pictures in which such a leaf is 1.2 pixels wide: the stage after the
    plain schedule's last is entered and splits its leaves, and the error falls below what the best field of level 10 would
    have; an older version's checkpoint, which knows nothing of that stage, gets a sentence."""
    monkeypatch.setattr(octree_schedule, "FINER_STEPS", 10)
    truth = slab(11, 32)
    coefficients = truth.sh
    coefficients[..., 0] = np.random.default_rng(0).uniform(-1.5, 1.5, (truth.n_vertices, 3))
    truth.sh = coefficients
    lens = Intrinsics(1024, 1024, 1500, 1500, 512, 512)
    cameras = [Camera(lens, look_at((0.1 * i - 0.1, 0.07 * i - 0.1, 1.2), (0, 0, 0), (0, 1, 0))) for i in range(3)]
    images = [
        np.rint(np.clip(render_image(truth, c, (1, 1, 1), lod=0)["rgb"], 0, 1) * 255).astype(np.uint8) for c in cameras
    ]
    scene = SceneBounds(np.array([[-1.0] * 3, [1.0] * 3]), None, False)
    dataset = Dataset(cameras, images, list("abc"), scene, "a piece")
    config = dataclasses.replace(OctreeConfig().for_pictures(1024), tiles=[24] * 8, prune_steps=4)
    assert config.levels[-2:] == [10, 11]
    trainer = OctreeTrainer(dataset, (1, 1, 1), config, 0, slab(10, 16))

    def error() -> float:
        shown = (render_image(trainer.octree, c, (1, 1, 1), lod=0)["rgb"] for c in cameras)
        return float(sum(((np.clip(a, 0, 1) - b / 255) ** 2).sum() for a, b in zip(shown, images, strict=True)))

    steps = 160
    for step in range(steps):
        trainer.step(step / steps)
        assert trainer.octree.max_level == (11 if trainer.stage == 7 else 10)
    assert trainer.stage == 7 and trainer.stage_steps[6:].min() > 0 and trainer.stage_steps.sum() == steps
    piece = np.concatenate([image[(image != 255).any(2)] / 255 for image in images])
    assert error() < 0.9 * (1 - coarse_share(64) ** 2) * ((piece - piece.mean(0)) ** 2).sum()
    state = trainer.state_dict()
    again = OctreeTrainer(dataset, (1, 1, 1), config, 0, slab(10, 16))
    again.load_state_dict(state)
    assert again.stage == 7 and np.array_equal(again.octree.values, trainer.octree.values)
    with pytest.raises(InputError, match="counts the steps of 7 stages, and the settings have 8"):
        again.load_state_dict({**state, "stage_steps": state["stage_steps"][:7]})
