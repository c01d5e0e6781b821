"""Fitting a medium under known suns: it finds extinction and albedo, is lit anew, resumes, and what the commands say."""

import json

import numpy as np
import pytest
from PIL import Image

from nerfvol.cli.main import main
from nerfvol.config.medium import MediumConfig
from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from nerfvol.files.checkpoint import load_checkpoint, save_checkpoint
from nerfvol.measure import truth
from nerfvol.measure.metrics import psnr
from nerfvol.measure.scores import evaluate
from nerfvol.medium.lighting import Lighting, load_lighting, parse_lighting
from nerfvol.medium.model import MediumModel
from nerfvol.models import load_model
from nerfvol.training.convert import cameras_around
from nerfvol.training.medium_trainer import MediumTrainer

SUNS = {"east": (0.8, 0.0, 0.6), "west": (-0.8, 0.1, 0.6), "north": (0.0, 0.9, -0.43), "held_out": (0.3, -0.8, 0.5)}
SMALL = MediumConfig(steps=100, resolutions=(6, 12), stage_ends=(0.3, 1.0), rays=512, lights=1)


def true_model() -> MediumModel:
    """A soft ball of optical depth 4 across, of an albedo that differs from side to side."""
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, 12)] * 3, indexing="ij")
    sigma = (6 * np.clip(0.85 - np.sqrt(x * x + y * y + z * z), 0, 0.5)).astype(np.float32)
    albedo = np.stack([0.8 + 0 * x, 0.55 + 0.3 * np.sign(x), 0.5 + 0.3 * z], -1).astype(np.float32)
    suns = {name: [{"towards": list(v), "irradiance": [12.0] * 3}] for name, v in SUNS.items()}
    lighting = parse_lighting({"lights": suns, "phase": [{"g": 0.3, "weight": 1.0}], "exposure": 1.5}, "suns")
    return MediumModel(sigma, albedo, np.array([[-1.0] * 3, [1.0] * 3]), lighting)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Pictures of :func:`true_model`: 24 under three suns to train on, 3 held-out views, 3 under another sun."""
    folder, model = tmp_path_factory.mktemp("lit"), true_model()
    cameras = [c.resized(20, 20) for c in cameras_around(model)]
    chosen = {"train": cameras[::3], "val": cameras[1::21][:3], "test": cameras[2::21][:3]}
    for split, seen in chosen.items():
        frames = []
        (folder / split).mkdir()
        for i, camera in enumerate(seen):
            name = "held_out" if split == "test" else list(SUNS)[i % 3]
            lit = type(camera)(camera.intrinsics, camera.c2w, name)
            drawn = [model.render(lit, colour, ("rgb", "opacity")) for colour in ((0.0,) * 3,)][0]
            alpha = drawn["opacity"][..., None]
            straight = np.clip(drawn["rgb"] / np.maximum(alpha, 1e-6), 0, 1)
            rgba = (np.concatenate([straight, alpha], -1) * 255 + 0.5).astype(np.uint8)
            Image.fromarray(rgba).save(folder / split / f"r_{i}.png")
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": camera.c2w.tolist(), "light": name})
        lens = seen[0].intrinsics
        angle = 2 * np.arctan(lens.width / 2 / lens.fx)
        document = {"camera_angle_x": float(angle), "aabb": model.box.tolist(), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    (folder / "lights.json").write_text(json.dumps(model.lighting.document()))
    return folder


def trainer_of(scene, config=SMALL, seed=0) -> MediumTrainer:
    return MediumTrainer(load_dataset(scene, "train"), load_lighting(scene / "lights.json"), config, seed)


@pytest.fixture(scope="module")
def fitted(scene) -> MediumModel:
    trainer = trainer_of(scene)
    for step in range(SMALL.steps):
        trainer.step(step / SMALL.steps)
    assert trainer.stages_left == 0
    return trainer.take_model({"background": [0.0, 0.0, 0.0]})


def test_views_under_a_light_that_was_never_seen(scene, fitted):
    """In the nearest light of the training the same medium has some 30 dB."""
    held_out = load_dataset(scene, "test")
    assert [camera.light for camera in held_out.cameras] == ["held_out"] * 3
    relit = evaluate(fitted, held_out, (0.0, 0.0, 0.0))["psnr"]
    in_old_light = [fitted.under(Lighting({"held_out": fitted.lighting.of("east")}, fitted.lighting.phase, 1.5))]
    assert relit > 36 and evaluate(in_old_light[0], held_out, (0.0, 0.0, 0.0))["psnr"] < relit - 6


def test_extinction_and_albedo_are_found(fitted):
    true = true_model()
    lo, hi = true.box
    grid = truth.Grid(true.sigma_t.astype(np.float64), lo, (hi - lo) / 11, lo, hi)
    scores = truth.compare_medium(fitted, grid, true.albedo.astype(np.float64))
    start = trainer_albedo_error(grid, true)
    assert 1e-3 < scores["opacity_relative_l1"] < 0.1 and scores["density_correlation"] > 0.95
    assert scores["albedo_error"] < 0.4 * start


def trainer_albedo_error(grid: truth.Grid, true: MediumModel) -> float:
    """That of the albedo before training."""
    weight = grid.sigma[..., None]
    return float((weight * np.abs(true.albedo - SMALL.first_albedo)).sum() / weight.sum() / 3)


def test_a_resumed_run_goes_on_exactly(scene, tmp_path):
    whole = trainer_of(scene)
    for step in range(12):
        if step == 9:
            save_checkpoint(tmp_path / "c.safetensors", whole.state_dict())
        whole.step(step / 15)
    resumed = trainer_of(scene)
    resumed.load_state_dict(load_checkpoint(tmp_path / "c.safetensors"))
    for step in range(9, 12):
        resumed.step(step / 15)
    for name, array in whole.state_dict().items():
        assert np.array_equal(array, resumed.state_dict()[name]), name
    other = MediumConfig(resolutions=(6, 14), stage_ends=(0.3, 1.0))
    with pytest.raises(InputError, match="does not fit the configured resolutions"):
        trainer_of(scene, other).load_state_dict(whole.state_dict())


def test_another_seed_is_another_run(scene):
    runs = []
    for seed in (0, 0, 1):
        trainer = trainer_of(scene, seed=seed)
        trainer.step(0.0)
        trainer.step(0.01)
        runs.append(trainer.state_dict()["density"])
    assert np.array_equal(runs[0], runs[1]) and not np.array_equal(runs[0], runs[2])


def test_threads_do_not_change_a_bit(scene):
    """Of a grid and batches large enough that torch shares them out."""
    import torch

    before, runs = torch.get_num_threads(), []
    large = MediumConfig(steps=100, resolutions=(32,), stage_ends=(1.0,), rays=2048, lights=1)
    try:
        for threads in (1, 2, 3):
            trainer = trainer_of(scene, large)
            torch.set_num_threads(threads)
            trainer.step(0.0)
            trainer.step(0.01)
            runs.append(trainer.state_dict())
    finally:
        torch.set_num_threads(before)
    for run in runs[1:]:
        for name, array in runs[0].items():
            assert np.array_equal(run[name], array), name


def test_white_that_was_cut_off_asks_for_no_less(scene):
    """A model brighter than white, where the picture is white, has no error; one below has."""
    import torch

    trainer = trainer_of(scene)
    truth_rgba = torch.tensor([[1.0, 0.5, 1.0, 1.0]])
    found = trainer._difference(torch.tensor([[1.7, 1.7, 0.9]]), torch.tensor([1.0]), truth_rgba)
    assert found[0].tolist() == pytest.approx([0.0, 1.2, -0.1, 0.0])


def test_commands(scene, tmp_path, capsys):
    run, light = tmp_path / "run", scene / "lights.json"
    small = ["--set", "medium.steps=12", "--set", "medium.resolutions=[6,8]", "--set", "medium.stage_ends=[0.5,1.0]",
             "--set", "medium.rays=256", "--threads", "1"]  # fmt: skip
    assert main(["train", "--data", str(scene), "--out", str(run), "--light", str(light), *small]) == 0
    assert "training medium (--light tells the light" in capsys.readouterr().out
    model = load_model(run)
    assert isinstance(model, MediumModel) and model.lighting == load_lighting(light)
    assert main(["eval", str(run), "--split", "test"]) == 0 and "3 test views" in capsys.readouterr().out
    assert main(["info", str(run)]) == 0 and "mean albedo" in capsys.readouterr().out
    pictures = []
    for k, given in enumerate(("west", f"{light}:east", str(light))):
        out = tmp_path / f"{k}.png"
        assert main(["render", str(run), "--orbit", "1", "--size", "16x16", "--light", given, "--out", str(out)]) == 0
        pictures.append(np.asarray(Image.open(out)).astype(float) / 255)
    assert psnr(pictures[0], pictures[1]) < 40 and np.array_equal(
        pictures[1], pictures[2]
    )  # a file's first light is east


@pytest.mark.parametrize("more,said", [
    (["--light", "nowhere.json"], "--light nowhere.json: no such file"),
    (["--representation", "medium"], "needs --light FILE"),
    (["--light", "LIGHTS", "--representation", "splats"], "expected no --representation splats"),
    (["--light", "OTHER"], "there is no light 'east', expected one of noon"),
])  # fmt: skip
def test_refusals(scene, tmp_path, capsys, more, said):
    other = tmp_path / "other.json"
    other.write_text(json.dumps({"lights": {"noon": [{"towards": [0, 0, 1], "irradiance": [1, 1, 1]}]}}))
    given = [{"LIGHTS": str(scene / "lights.json"), "OTHER": str(other)}.get(word) or word for word in more]
    assert main(["train", "--data", str(scene), "--out", str(tmp_path / "run"), *given]) == 2
    assert said in capsys.readouterr().err
