"""The field trainer: it learns, resumes exactly, skips empty space, and says so when it collapses."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from nerfvol.cameras.camera import Intrinsics, orbit
from nerfvol.config.field import FieldConfig, FieldShape
from nerfvol.datasets.dataset import Dataset
from nerfvol.errors import InputError
from nerfvol.field.rendering import importance_samples, render_field
from nerfvol.field.sampling import intersect_aabb, step_generator
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.region import SceneBounds
from nerfvol.training.field_phase import domain_of
from nerfvol.training.field_trainer import FieldTrainer
from nerfvol.training.pixel_bank import PixelBank

TINY = FieldConfig(
    shape=FieldShape(width=16, hash_levels=4, hash_log2_table=10, hash_min=4, hash_max=24),
    steps=60, downscales=(4, 2), stage_ends=(0.3, 1.0), march_steps=(32, 48), samples_per_step=2048,
    grid_resolution=16, rate=0.01, colour_weight=0.0,
)  # fmt: skip


def ball_dataset(n: int = 8, size: int = 32, blank: bool = False) -> Dataset:
    """Views of a ball, red on one side and blue on the other, over transparent black."""
    camera_lens = Intrinsics(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2)
    cameras = orbit(n, center=(0, 0, 0), radius=3.5, elevation_deg=20, intrinsics=camera_lens)
    images = []
    for camera in cameras:
        o, d = camera.rays()
        b = d @ o
        disc = b * b - (o @ o - 0.8**2)
        hit = o + d * (-b - np.sqrt(np.maximum(disc, 0)))[:, None]
        colour = np.where(hit[:, :1] > 0, [220.0, 60, 40], [40.0, 60, 220])
        rgba = np.concatenate([colour, np.full((len(d), 1), 255.0)], 1) * (disc > 0)[:, None] * (not blank)
        images.append(np.rint(rgba).astype(np.uint8).reshape(size, size, 4))
    scene = SceneBounds(np.array([[-1.1, -1.1, -1.1], [1.1, 1.1, 1.1]]), None, True)
    return Dataset(cameras, images, [f"v{i}" for i in range(n)], scene, "test")


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return ball_dataset()


@pytest.mark.parametrize("sampler", ["occupancy", "importance"])
def test_learns_the_ball(dataset: Dataset, sampler: str) -> None:
    """Better than any constant image by 6 dB after a second or two, and with far fewer samples than a full march."""
    config = dataclasses.replace(TINY, steps=160, sampler=sampler, n_coarse=24, n_fine=24, bfloat16=False)
    trainer = FieldTrainer(dataset, config, seed=1)
    untouched = trainer.grid.sigmas.clone()
    metrics = [trainer.step()]
    # What the samples of the very first step saw is noted; the importance sampler needs no grid.
    assert bool((trainer.grid.sigmas != untouched).any()) == (sampler == "occupancy")
    metrics += [trainer.step() for _ in range(config.steps - 1)]
    assert metrics[0].downscale == 4 and metrics[-1].downscale == 2
    truth = np.concatenate([dataset.composited(i, (1, 1, 1)).reshape(-1, 3) for i in range(4)])
    constant = -10 * math.log10(((truth - truth.mean(0)) ** 2).mean())
    assert np.mean([m.psnr for m in metrics[-10:]]) > constant + 6
    camera = dataset.cameras[0].scaled(2)
    o, d = (torch.from_numpy(a) for a in camera.rays())
    image = trainer.render(o, d, chunk=100)
    np.testing.assert_allclose(trainer.picture(camera).reshape(-1, 3), image["rgb"], atol=1e-6)
    target = dataset.pyramid((1, 1, 1), 2)[0].reshape(-1, 3) / 255.0
    assert -10 * math.log10(((image["rgb"].numpy() - target) ** 2).mean()) > constant + 6
    inside = torch.from_numpy((target < 0.99).any(1))
    assert float(image["opacity"][inside].mean()) > 0.5 and float(image["opacity"][~inside].mean()) < 0.2
    if sampler == "occupancy":
        assert trainer.grid.fraction < 0.7
        assert metrics[-1].samples < 0.5 * max(m.samples for m in metrics[:20])
    else:
        assert metrics[-1].samples == 48


@pytest.mark.parametrize("extra", [{}, {"sampler": "importance"}, {"sparsity_weight": 0.01, "colour_weight": 0.03}])
def test_resumes_to_the_same_numbers(dataset: Dataset, tmp_path: Path, extra: dict) -> None:
    """Interrupted at step 11, through a checkpoint file, and on to the same weights bit for bit."""
    config = dataclasses.replace(TINY, steps=24, n_coarse=16, n_fine=16, **extra)
    whole = FieldTrainer(dataset, config, seed=3)
    losses = [whole.step().loss for _ in range(24)]
    first = FieldTrainer(dataset, config, seed=3)
    for _ in range(11):
        first.step()
    save_checkpoint(tmp_path / "c.safetensors", first.state_dict())
    second = FieldTrainer(dataset, config, seed=3)
    second.load_state_dict(load_checkpoint(tmp_path / "c.safetensors"))
    assert [second.step().loss for _ in range(13)] == losses[11:]
    for mine, other in zip(second.field.parameters(), whole.field.parameters(), strict=True):
        assert torch.equal(mine, other)
    assert torch.equal(second.grid.sigmas, whole.grid.sigmas)
    assert FieldTrainer(dataset, config, seed=4).step().loss != losses[0]


def test_a_checkpoint_of_another_network_is_refused(dataset: Dataset) -> None:
    state = FieldTrainer(dataset, TINY).state_dict()
    wider = dataclasses.replace(TINY, shape=dataclasses.replace(TINY.shape, width=24))
    with pytest.raises(InputError, match="does not fit"):
        FieldTrainer(dataset, wider).load_state_dict(state)


def test_collapse_to_empty_space_is_reported() -> None:
    """Images that show nothing but background: an error after some steps, not a silent empty result."""
    trainer = FieldTrainer(ball_dataset(blank=True), dataclasses.replace(TINY, rate=0.05), seed=0)
    with pytest.raises(InputError, match="collapsed to empty space"):
        for _ in range(400):
            trainer.step(0.1)


def test_rays_are_the_cameras_and_colours_the_images(dataset: Dataset) -> None:
    """Every pixel of every view: origin, direction and colour, at a scale of 2."""
    bank = PixelBank(dataset, (0.25, 0.5, 0.75), 2)
    pixels = torch.arange(len(bank.colours))
    o, d = bank.rays(pixels)
    images = dataset.pyramid((0.25, 0.5, 0.75), 2)
    for i, camera in enumerate(dataset.cameras):
        rows = slice(i * 256, (i + 1) * 256)
        origin, directions = camera.scaled(2).rays()
        np.testing.assert_allclose(d[rows], directions, atol=2e-7)
        np.testing.assert_array_equal(o[rows], np.broadcast_to(origin, (256, 3)))
        np.testing.assert_array_equal(bank.colours[rows], images[i].reshape(-1, 3))
    sampled_o, sampled_d, colours = bank.sample(4000, step_generator(0, 0))
    assert sampled_o.shape == sampled_d.shape == colours.shape == (4000, 3)
    assert float(colours.max()) <= 1
    # All views are drawn from: 4000 / 8 = 500 each, binomial deviation 21.
    counts = [(sampled_o == o[i * 256]).all(-1).sum().item() for i in range(8)]
    assert sum(counts) == 4000 and all(abs(c - 500) < 5 * 21 for c in counts)


class Slab:
    """sigma = 2 for |x| < 1/2, colour by direction: a field whose pixels are known."""

    def density(self, positions: torch.Tensor) -> torch.Tensor:
        return torch.where(positions[:, 0].abs() < 0.5, 2.0, 0.0)

    def __call__(self, positions: torch.Tensor, viewdirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.density(positions), viewdirs.abs()


def test_rendering_a_known_field() -> None:
    """Slab seen at an angle: opacity 1 - exp(-2 / cos), colour of the direction over the background; any chunk size."""
    n = 64
    angle = torch.linspace(0, 1, n)
    d = torch.stack([angle.cos(), angle.sin(), torch.zeros(n)], dim=-1)
    o = -2 * d
    box = torch.tensor([[-3.0] * 3, [3.0] * 3])

    def find(rays_o: torch.Tensor, rays_d: torch.Tensor):
        return importance_samples(Slab(), rays_o, rays_d, intersect_aabb(rays_o, rays_d, box), (128, 256))

    image = render_field(Slab(), o, d, (0.1, 0.2, 0.3), find, chunk=7)
    expected = 1 - torch.exp(-2 / angle.cos())
    # The faces are found to within one of the segments, at most 5 / 128 long before refinement.
    torch.testing.assert_close(image["opacity"], expected, rtol=0, atol=0.02)
    colour = expected[:, None] * d.abs() + (1 - expected[:, None]) * torch.tensor([0.1, 0.2, 0.3])
    torch.testing.assert_close(image["rgb"], colour, rtol=0, atol=0.02)
    again = render_field(Slab(), o, d, (0.1, 0.2, 0.3), find, chunk=1000)
    torch.testing.assert_close(again["rgb"], image["rgb"], rtol=0, atol=1e-6)


def test_importance_samples_go_where_the_weight_is() -> None:
    o, d = torch.tensor([[-2.0, 0, 0]]), torch.tensor([[1.0, 0, 0]])
    span = (torch.zeros(1), torch.full((1,), 5.0))
    samples = importance_samples(Slab(), o, d, span, (32, 96), step_generator(0, 0))
    middle = (samples.t_starts + samples.t_ends) / 2
    front = ((middle > 1.4) & (middle < 2.6)).float().mean()  # a quarter of the span, most of the weight
    assert float(front) > 0.6
    assert len(middle) == 128 and float(samples.t_starts[0]) == 0 and float(samples.t_ends[-1]) == 5
    torch.testing.assert_close(samples.t_ends[:-1], samples.t_starts[1:])


def test_domain_of_scenes() -> None:
    photo = SceneBounds(np.array([[-1.0, 0, 0], [3.0, 2, 2]]), np.array([[-15.0, -15, -15], [17.0, 17, 17]]), False)
    domain = domain_of(photo)
    assert domain.center == (1.0, 1.0, 1.0) and domain.half == 2 and domain.outer == pytest.approx(8)
    assert domain_of(SceneBounds(photo.aabb, None, True)).outer == 1


@pytest.mark.parametrize(
    "change",
    [{"downscales": (4, 2, 1)}, {"stage_ends": (0.5, 0.9)}, {"stage_ends": (1.0, 1.0), "downscales": (0, 1)},
     {"samples_per_step": 0}, {"grid_resolution": 30}, {"rate": 0.0}, {"rate_decay": 2.0}],
)  # fmt: skip
def test_refuses_impossible_settings(change: dict) -> None:
    with pytest.raises(InputError, match="field"):
        dataclasses.replace(TINY, **change)
