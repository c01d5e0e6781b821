"""The trainer by compiled kernels: it learns, resumes to the same bits with any threads, empties space, and is chosen."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from nerfvol.config.field import DistillConfig, FieldConfig, FieldShape
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.kernels.field_state import FieldState
from nerfvol.native import native
from nerfvol.region import SceneBounds
from nerfvol.starts.field import distill
from nerfvol.training import field_looks, field_schedule
from nerfvol.training.compiled_field import CompiledFieldTrainer, Pixels
from nerfvol.training.field_start import make_field_trainer
from nerfvol.training.field_trainer import FieldTrainer
from tests.training.test_field_trainer import ball_dataset

SMALL = FieldConfig(
    shape=FieldShape(width=16, hash_levels=4, hash_log2_table=10, hash_min=4, hash_max=24),
    steps=400, march_steps=(64,), samples_per_step=2048, grid_resolution=32, few_views=0,
)  # fmt: skip
WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return ball_dataset()


def trainer_of(dataset: Dataset, config: FieldConfig = SMALL, seed: int = 1) -> CompiledFieldTrainer:
    trainer = make_field_trainer(dataset, config, seed, WHITE)
    assert isinstance(trainer, CompiledFieldTrainer)
    return trainer


def assert_same_bits(a: CompiledFieldTrainer, b: CompiledFieldTrainer) -> None:
    for name in (*FieldState.ARRAYS, "updates"):
        assert getattr(a.state, name).tobytes() == getattr(b.state, name).tobytes(), name
    for name, array in a.occupancy.state_dict().items():
        assert array.tobytes() == b.occupancy.state_dict()[name].tobytes(), name
    assert (a.steps_done, a.n_rays) == (b.steps_done, b.n_rays)


def test_learns_the_ball(compiled, dataset: Dataset) -> None:
    """Better than any constant image by 12 dB within 400 steps; most of the region is found empty."""
    trainer = trainer_of(dataset)
    reports = [trainer.step() for _ in range(257)]
    assert reports[0].samples * reports[0].n_rays <= 4 * SMALL.samples_per_step
    # The ball fills 0.8**3 pi / 6 of the cube over its bounds of 1.1, a shell of it is seen; all cells at the edge count.
    assert 0.02 < trainer.occupancy.fraction < 0.5
    assert reports[-1].n_rays > 2 * reports[0].n_rays
    reports += [trainer.step() for _ in range(143)]
    assert abs(np.mean([r.samples * r.n_rays for r in reports[-40:]]) / SMALL.samples_per_step - 1) < 0.1
    truth = np.stack([dataset.composited(i, WHITE) for i in range(len(dataset))])
    constant = -10 * math.log10(((truth - truth.mean((0, 1, 2))) ** 2).mean())
    pictures = np.stack([trainer.picture(camera) for camera in dataset.cameras])
    assert -10 * math.log10(((pictures - truth) ** 2).mean()) > constant + 12


def test_the_same_bits_with_any_number_of_threads_and_resumed(threads, dataset: Dataset, tmp_path: Path) -> None:
    """Across sweeps, a round of probes and a thinning, occupancy included; stopped through a checkpoint file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(field_looks, "SWEEPS", (8, 16))
        patch.setattr(field_looks, "PROBE_EVERY", 8)
        patch.setattr(field_looks, "THINNED", (21,))
        runs = []
        for n in (1, 2, 3):
            threads(n)
            runs.append(trainer_of(dataset))
            reports = [runs[-1].step().loss for _ in range(28)]
        first = trainer_of(dataset)
        for _ in range(19):
            first.step()
        save_checkpoint(tmp_path / "c.safetensors", first.state_dict())
        second = trainer_of(dataset)
        second.load_state_dict(load_checkpoint(tmp_path / "c.safetensors"))
        assert [second.step().loss for _ in range(9)] == reports[19:]
    for other in (*runs[1:], second):
        assert_same_bits(runs[0], other)
    assert trainer_of(dataset, seed=2).step().loss != reports[0]


def test_photographs_are_drawn_alike_by_a_resumed_run_without_a_step(compiled, dataset: Dataset) -> None:
    """Whose budget is over: with the steps along rays that the last step trained with, not the finest."""
    box = dataset.scene.aabb
    place = dataclasses.replace(dataset, scene=SceneBounds(box, 4 * box, False))
    first, second = trainer_of(place), trainer_of(place)
    for _ in range(3):
        first.step()
    state = first.state_dict()
    second.load_state_dict(state)
    assert second.trained_field().march.n_steps == first.trained_field().march.n_steps < SMALL.march_steps[0]
    camera = place.cameras[0]
    assert second.picture(camera).tobytes() == first.picture(camera).tobytes()
    second.load_state_dict(
        {name: value for name, value in state.items() if name != "march_steps"}
    )  # as versions before
    with pytest.raises(InputError, match="has 65 steps along a ray, expected 1 to 64"):
        second.load_state_dict({**state, "march_steps": 65})


def test_haze_that_is_gone_does_not_stay_occupied(compiled, dataset: Dataset) -> None:
    """A thinning looks at every occupied cell and at no other: what was remembered halves where nothing is left."""
    trainer = trainer_of(dataset)
    trainer.state.network[-13] = -8.0  # nearly empty everywhere: e^-9 a unit
    grid, half = trainer.occupancy, len(trainer.occupancy.sigmas) // 2
    grid.sigmas[:half], grid.sigmas[half:] = 100.0, 1e-3
    grid.refresh()
    assert grid.cells().reshape(-1)[:half].all() and not grid.cells().reshape(-1)[half:].any()
    trainer.steps_done = field_looks.THINNED[0] - 1
    trainer.step()
    assert (grid.sigmas[:half] == 50.0).all() and (grid.sigmas[half:] == np.float32(1e-3)).all()


def test_a_thinning_looks_at_no_more_cells_than_it_may(compiled, dataset: Dataset, monkeypatch) -> None:
    """Of 32,768 occupied cells every seventh where 5,000 may be looked at: photographs have millions of hazy ones."""
    monkeypatch.setattr(field_looks, "MOST_LOOKED", 5000)
    trainer = trainer_of(dataset)
    trainer.state.network[-13] = -8.0
    grid = trainer.occupancy
    grid.sigmas[...] = 100.0
    grid.refresh()
    field_looks.look(trainer.state, grid, 1, field_looks.THINNED[0])
    looked = np.flatnonzero(grid.sigmas == 50.0)
    assert len(looked) in (4681, 4682) and (np.diff(looked) == 7).all()
    first = looked[0]
    for step in field_looks.THINNED[1:9]:
        grid.sigmas[...] = 100.0
        field_looks.look(trainer.state, grid, 1, step)
        if np.flatnonzero(grid.sigmas == 50.0)[0] != first:
            return
    pytest.fail("always the same cells")


def test_steps_along_rays_become_finer(compiled, dataset: Dataset) -> None:
    """Coarse first, as set in the end, and the same for a step whatever was before it."""
    config = dataclasses.replace(SMALL, march_steps=(384,))
    assert [field_schedule.march_steps(config, 0, step) for step in (0, 50, 300, 1000, 5000)] == [
        64,
        128,
        192,
        256,
        384,
    ]
    assert field_schedule.march_steps(dataclasses.replace(SMALL, march_steps=(9,)), 0, 0) == 8
    trainer = trainer_of(dataset)
    trainer.steps_done = 5000
    trainer.step()
    assert trainer.march.n_steps == 64
    trainer.steps_done = 0
    trainer.step()
    assert trainer.march.n_steps == 10 and trainer.trained_field().march.n_steps == 64


def test_a_picture_is_drawn_anew_where_cells_change_and_not_where_rays_do(compiled, dataset: Dataset) -> None:
    """A run asks ``size`` whether what scoring takes must be measured again."""
    trainer = trainer_of(dataset)
    trainer.final = True
    asked = [(trainer.size(), trainer.n_rays) for _ in range(3) if trainer.step()]
    assert len({rays for _, rays in asked}) == 3 and len({size for size, _ in asked}) == 1
    trainer.occupancy.coarse[...] = 1  # one group of cells of 64
    assert trainer.size() != asked[0][0]
    trainer.final = False  # its octree will be scored
    hazy = trainer.size()
    trainer.occupancy.coarse[...] = 255
    assert trainer.size() == hazy


def test_a_checkpoint_of_another_network_is_refused(compiled, dataset: Dataset) -> None:
    state = trainer_of(dataset).state_dict()
    wider = dataclasses.replace(SMALL, shape=dataclasses.replace(SMALL.shape, width=24))
    with pytest.raises(InputError, match="does not fit"):
        trainer_of(dataset, wider).load_state_dict(state)
    with pytest.raises(InputError, match="does not fit"):
        trainer_of(dataset, dataclasses.replace(SMALL, grid_resolution=16)).load_state_dict(state)


def test_collapse_to_empty_space_is_reported(compiled, dataset: Dataset) -> None:
    """A field that no picture could show: an error at the next look, not a silent empty result."""
    trainer = trainer_of(dataset)
    trainer.state.network[-13] = -30.0  # the raw density's bias, before those of 12 coefficients
    trainer.steps_done = field_looks.SWEEPS[0] - 1
    with pytest.raises(InputError, match="collapsed to empty space"):
        trainer.step()


def test_rays_are_the_cameras_and_colours_the_images(compiled, dataset: Dataset) -> None:
    """Every ray drawn is some pixel's: origin, direction and colour, at a scale of 2; all views are drawn from."""
    background = (0.25, 0.5, 0.75)
    batch = Pixels(dataset, background, 2).sample(4000, seed=3, step=7)
    images = dataset.pyramid(background, 2)
    origins = np.stack([camera.position for camera in dataset.cameras]).astype(np.float32)
    view = (batch.rays_o[:, None] == origins).all(-1).argmax(1)
    # 4000 / 8 = 500 each, binomial deviation 21.
    assert (np.abs(np.bincount(view, minlength=8) - 500) < 5 * 21).all()
    for i, camera in enumerate(dataset.cameras):
        rows = view == i
        _, directions = camera.scaled(2).rays()
        apart = ((batch.rays_d[rows][:, None] - directions) ** 2).sum(-1)
        pixel = apart.argmin(1)
        assert apart.min(1).max() < 1e-12
        np.testing.assert_array_equal(np.rint(batch.target[rows] * 255), images[i].reshape(-1, 3)[pixel])
        assert len(np.unique(pixel)) > 150  # of 256: 500 draws hit 86 % of them
    assert 0 <= batch.jitter.min() and batch.jitter.max() < 1 and abs(batch.jitter.mean() - 0.5) < 5 * 0.289 / 63
    assert not np.array_equal(Pixels(dataset, background, 2).sample(4000, 3, 8).jitter, batch.jitter)


def test_pixels_of_pictures_of_all_sizes(compiled) -> None:
    """What is drawn belongs together, and every picture has its share: each number here tells its picture and pixel."""
    kernels = native()
    assert kernels is not None
    sizes = [(1, 1), (70, 90), (3, 2), (1, 1), (8, 200), (5, 1)]
    pictures, tables = [], []
    for view, (height, width) in enumerate(sizes):
        pixel = np.arange(height * width)
        pictures.append(np.stack([np.full_like(pixel, view), pixel // 256, pixel % 256], 1).astype(np.uint8))
        tables.append(np.stack([np.full_like(pixel, view), pixel, -pixel], 1).astype(np.float32))
    rotations = np.tile(np.eye(3, dtype=np.float32), (len(sizes), 1, 1))
    origins = np.repeat(np.arange(len(sizes), dtype=np.float32), 3).reshape(-1, 3)
    shaped = [a.reshape(*size, 3) for a, size in zip(pictures, sizes, strict=True)]
    n = 50_000
    o, d, target = (np.empty((n, 3), np.float32) for _ in range(3))
    kernels.field_draw(
        kernels.FieldPixels(shaped, tables, rotations, origins), 5, o, d, target, np.empty(n, np.float32)
    )
    seen = np.rint(255 * target)
    assert np.array_equal(seen[:, 0], o[:, 0]) and np.array_equal(seen[:, 0], d[:, 0])
    assert np.array_equal(256 * seen[:, 1] + seen[:, 2], d[:, 1])
    shares = np.array([height * width for height, width in sizes]) / sum(h * w for h, w in sizes)
    drawn = np.bincount(o[:, 0].astype(int), minlength=len(sizes))
    assert (np.abs(drawn - n * shares) < 5 * np.sqrt(n * shares)).all() and drawn.all()


def test_few_views_have_no_view_dependence(compiled, dataset: Dataset) -> None:
    trainer = trainer_of(dataset, dataclasses.replace(SMALL, few_views=8))
    assert trainer.state.shape.sh_degree == 0 and trainer.state.shape.width == 64 > SMALL.shape.width
    assert trainer.few and not trainer_of(dataset).few
    fine = dataclasses.replace(SMALL, shape=dataclasses.replace(SMALL.shape, hash_min=12))
    coarsest = {
        few: trainer_of(dataset, dataclasses.replace(fine, few_views=few)).state.shape.hash_min for few in (0, 8)
    }
    assert coarsest == {0: 12, 8: 8} and trainer.state.shape.hash_min == SMALL.shape.hash_min == 4
    config, schedule = trainer.config, field_schedule
    assert (
        schedule.rates_at(config, True, 0, 0.0).table_decay
        == SMALL.few_decay
        > schedule.rates_at(config, False, 0, 0.0).table_decay
    )
    assert (
        schedule.loss_at(config, True, WHITE, 0.5).entropy
        == SMALL.few_entropy
        > schedule.loss_at(config, False, WHITE, 0.5).entropy
        == 0
    )
    assert trainer_of(dataset).state.shape.sh_degree == 1


@pytest.mark.parametrize("change", [
    {"sampler": "importance"}, {"trainer": "torch"}, {"sparsity_weight": 0.01},
    {"shape": dataclasses.replace(SMALL.shape, hash_features=3)},
])  # fmt: skip
def test_what_the_kernels_have_not_trains_in_torch(dataset: Dataset, change: dict) -> None:
    assert isinstance(make_field_trainer(dataset, dataclasses.replace(SMALL, **change)), FieldTrainer)


def test_without_kernels_it_trains_in_torch(dataset: Dataset, monkeypatch) -> None:
    monkeypatch.setattr("nerfvol.kernels.field_ops.native", lambda: None)
    assert isinstance(make_field_trainer(dataset, SMALL), FieldTrainer)


def test_what_is_distilled_is_what_is_drawn(compiled, dataset: Dataset) -> None:
    """Octree and field of a run that takes a second show the ball alike: better than any constant picture by 12 dB."""
    trainer = trainer_of(dataset)
    for _ in range(300):
        trainer.step()
    settings = DistillConfig(level=6, coarse_level=4, sh_degree=1)
    _, report = distill(trainer.trained_field(), trainer.domain, dataset, WHITE, settings, trainer.picture)
    assert report.field_psnr > 25 and report.octree_psnr > 25
