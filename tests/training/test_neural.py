"""Fields as models: the file, views with any frame and number of threads, densities at points, commands, hostile files."""

import dataclasses
import json
import time

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from nerfvol.cameras.camera import Camera
from nerfvol.config import field as config_field
from nerfvol.config import training
from nerfvol.config.field import FieldConfig, FieldShape
from nerfvol.config.training import LARGE_TABLES_FROM
from nerfvol.errors import InputError
from nerfvol.files import run_folder
from nerfvol.kernels.field_model import EARLY_STOP
from nerfvol.measure.scores import evaluate
from nerfvol.models import describe_file, load_model
from nerfvol.neural import FieldModel
from nerfvol.region import SceneBounds
from nerfvol.training.compiled_field import CompiledFieldTrainer
from nerfvol.training.field_start import make_final_trainer
from nerfvol.training.memory import field_memory, gib
from nerfvol.training.saved import field_begun
from tests.fixtures.runs import TINY, metrics_of, settings, start
from tests.training.test_field_trainer import ball_dataset

WHITE = (1.0, 1.0, 1.0)
SMALL = FieldConfig(
    shape=FieldShape(width=16, hash_levels=4, hash_log2_table=10, hash_min=4, hash_max=24),
    steps=330, march_steps=(64,), samples_per_step=2048, grid_resolution=32, few_views=0,
)  # fmt: skip


@pytest.fixture(scope="module")
def trainer() -> CompiledFieldTrainer:
    out = make_final_trainer(ball_dataset(), SMALL, 1, WHITE)
    for _ in range(SMALL.steps):
        out.step()
    return out


@pytest.fixture(scope="module")
def model(trainer) -> FieldModel:
    return trainer.take_model({"background": list(WHITE)})


@pytest.fixture
def saved(model, tmp_path):
    path = tmp_path / "field.safetensors"
    assert model.save(path) == path.stat().st_size
    return path


def moved(camera: Camera, origin, scale) -> Camera:
    pose = camera.c2w.copy()
    pose[:3, 3] = pose[:3, 3] * scale + origin
    return dataclasses.replace(camera, c2w=pose)


def test_a_file_draws_what_its_trainer_draws(trainer, model, saved, threads):
    """Bit for bit, with any number of threads, through the one opener of files; saved again, the same bytes."""
    loaded = load_model(saved)
    assert isinstance(loaded, FieldModel) and loaded.metadata == model.metadata
    truth = trainer.picture(trainer.dataset.cameras[3])

    def drawn(of):
        return of.render(trainer.dataset.cameras[3], early_stop_eps=EARLY_STOP)["rgb"].clip(0, 1)

    for n in (1, 2, 3):
        threads(n)
        for of in (model, loaded):
            np.testing.assert_array_equal(drawn(of), truth)
    again = saved.with_name("again.safetensors")
    loaded.save(again)
    assert again.read_bytes() == saved.read_bytes()
    np.testing.assert_array_equal(loaded.field.march.occupancy.cells(), model.field.march.occupancy.cells())
    np.testing.assert_array_equal(loaded.field.march.occupancy.coarse, model.field.march.occupancy.coarse)


def test_views_hold_the_ball(model):
    """Radius 0.8, seen from 3.5: depth of the middle, the silhouette, normals towards the camera; the box."""
    camera = ball_dataset().cameras[0]
    out = model.render(camera, (0.0, 0.0, 0.0), ("rgb", "opacity", "depth", "normal"))
    middle = (slice(14, 18), slice(14, 18))
    assert out["opacity"][middle].min() > 0.9 and out["opacity"][:2].max() < 0.1
    # What is seen lies between the ball's front and its middle, whose colours all views agree on.
    assert (np.abs(out["depth"][middle] / out["opacity"][middle] - 3.1) < 0.4).all()
    np.testing.assert_allclose(np.linalg.norm(out["normal"][middle], axis=-1), out["opacity"][middle], rtol=1e-5)
    low, high = model.aabb()
    assert (low < -0.75).all() and (high > 0.75).all() and (np.abs([low, high]) <= 1.1 + 1e-6).all()
    with pytest.raises(InputError, match="not as median_depth"):
        model.render(camera, outputs=("median_depth",))


def test_normals_are_those_of_the_density(model):
    """Against differences of the model's own density where the view says that the mean depth is."""
    camera = ball_dataset().cameras[2]
    out = model.render(camera, outputs=("opacity", "depth", "normal"))
    origin, directions = camera.rays()
    row = 16 * 32 + 13
    share = float(out["opacity"].reshape(-1)[row])
    place = origin + directions[row] * float(out["depth"].reshape(-1)[row]) / share
    step = 4 * 1.1 / 32
    apart = [model.density(np.stack([place - step * axis, place + step * axis])) for axis in np.eye(3)]
    slope = np.array([before - behind for before, behind in apart])
    if (np.array(apart) > 0).all():  # else a cell is taken for empty, which normals do not ask for
        np.testing.assert_allclose(out["normal"].reshape(-1, 3)[row] / share, slope / np.linalg.norm(slope), atol=1e-3)


def test_another_frame_is_another_unit(model, tmp_path):
    """A field trained near the origin and brought to map coordinates: the same pictures; depth, density and box in units."""
    origin, scale = np.array([4.0e5, -5.0e6, 300.0]), 16.0  # powers of two, and float64 holds the rest to 1e-9
    far = FieldModel(model.field, model.metadata, origin, scale)
    far.save(tmp_path / "far.safetensors")
    far = FieldModel.load(tmp_path / "far.safetensors")
    camera = ball_dataset().cameras[1]
    near, out = (
        m.render(c, outputs=("rgb", "depth")) for m, c in ((model, camera), (far, moved(camera, origin, scale)))
    )
    np.testing.assert_allclose(out["rgb"], near["rgb"], atol=1e-3)
    np.testing.assert_allclose(out["depth"], scale * near["depth"], atol=scale * 1e-3)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3))
    np.testing.assert_allclose(
        far.density(origin + scale * points), model.density(points) / scale, rtol=1e-3, atol=1e-3
    )
    np.testing.assert_allclose(far.aabb(), model.aabb() * scale + origin)


def test_points_agree_with_views(model):
    """The optical depth of a ray, by the midpoint rule through ``density``, is the opacity that is drawn."""
    camera = ball_dataset().cameras[5]
    opacity = model.render(camera, outputs=("opacity",), early_stop_eps=0.0)["opacity"].reshape(-1)
    origin, directions = camera.rays()
    for row in (16 * 32 + 5, 9 * 32 + 9, 16 * 32 + 7):
        t = np.linspace(1.5, 5.5, 8001)
        t = (t[1:] + t[:-1]) / 2
        tau = model.density(origin + directions[row] * t[:, None]).sum() * (t[1] - t[0])
        # Steps of the march are 2 sqrt(3) 1.1 / 64 = 0.06 long; the field changes by less than half between two.
        assert abs(-np.expm1(-tau) - opacity[row]) < 0.05, row
    assert model.density(np.array([[5.0, 0, 0], [1.05, 1.05, 1.05]])).tolist() == [0, 0]
    colours = model.colour(np.array([[5.0, 0, 0]]))
    assert colours.shape == (1, 3) and not colours.any()


@pytest.fixture(scope="module")
def run(tmp_path_factory, tiny_scene):
    field = {**TINY["field"], "steps": 400, "downscales": [1], "stage_ends": [1.0], "march_steps": [64]}
    folder = tmp_path_factory.mktemp("field") / "run"
    return start(settings(tiny_scene, folder, representation="field", field=field, checkpoint_every=1000))


def test_commands(run, tiny_scene, command, tmp_path):
    """train, eval, info, render, export grid, convert both ways."""
    metrics = metrics_of(run)
    assert metrics["representation"] == "field" and metrics["psnr"] > 20 and metrics["parameters"] > 1000
    assert not (run / run_folder.OCTREE).exists() and load_model(run).kind == "field"
    code, out, err = command("eval", run)
    assert code == 0 and f"PSNR {metrics['psnr']:.2f}" in out, err
    code, out, err = command("info", run)
    assert code == 0 and "nerfvol field 1" in out and "occupied share" in out, err
    assert (
        command("render", run, "--orbit", 2, "--size", "20x20", "--out", tmp_path / "v", "--aov", "depth,normal")[0]
        == 0
    )
    code, _, err = command("export", run, "--out", tmp_path / "g.npz", "--resolution", 16)
    assert code == 0, err
    density = np.load(tmp_path / "g.npz")["density"]
    assert max(density.shape) == 16 and density.max() > 1
    for name, kind in (("o.safetensors", "octree"), ("s.ply", "splats")):
        code, out, err = command("convert", run, "--to", kind, "--level", 5, "--out", tmp_path / name)
        assert code == 0 and "dB lost" in out and load_model(tmp_path / name).kind == kind, err
    octree = load_model(tmp_path / "o.safetensors")
    from nerfvol.datasets.load import load_dataset

    held_out = load_dataset(tiny_scene, "val")
    assert evaluate(octree, held_out, WHITE)["psnr"] > 18


def test_resumes_and_repeats(run, tiny_scene, command, tmp_path):
    code, out, _ = command("train", "--resume", "--out", run)
    assert code == 0 and "is finished" in out
    code, _, err = command("train", "--data", tiny_scene, "--representation", "field", "--out", tmp_path / "r",
                           "--set", "field.trainer=torch")  # fmt: skip
    assert code == 2 and "compiled kernels alone: field.trainer is torch" in err and err.count("\n") == 1
    code, _, err = command("train", "--data", tiny_scene, "--representation", "field", "--init", "mlp", "--out", "r")
    assert code == 2 and "expected auto for field, got 'mlp'" in err


UNSAID = {**TINY["field"], "shape": {"width": 16, "hash_levels": 4, "hash_min": 4}}  # tables that nobody chose


@pytest.mark.parametrize("budget, more, tables", [
    (LARGE_TABLES_FROM, {}, (19, 512)), (LARGE_TABLES_FROM - 1, {}, (17, 256)), (None, {}, (17, 256)),
    (LARGE_TABLES_FROM, {"hash_log2_table": 12}, (12, 256)), (LARGE_TABLES_FROM, {"hash_max": 64}, (17, 64)),
])  # fmt: skip
def test_long_runs_have_larger_tables(budget, more, tables, tmp_path, tiny_scene):
    """... where nobody chose their size; the estimate of memory follows. Not of few views, photographs, or octrees' fields."""
    field = {**UNSAID, "shape": {**UNSAID["shape"], **more}}
    config = settings(tiny_scene, tmp_path, representation="field", time_budget=budget, field=field)
    config = dataclasses.replace(config, field=dataclasses.replace(config.field, shape=FieldShape(**field["shape"])))
    box = np.array([[-1.0] * 3, [1.0] * 3])
    shape = config.for_field(17, SceneBounds(box, None, True)).field.shape
    assert (shape.log2_table, shape.finest) == (shape.hash_log2_table, shape.hash_max) == tables
    # Numbers, two moments and gradients of four levels of pairs; the network and cells are less than a hundredth of a GiB.
    described = field_memory(ball_dataset(), dataclasses.replace(config.field, shape=shape, grid_resolution=16), 0)
    assert f"the field {gib(16 * 4 * 2 << tables[0])}" in described
    few = dataclasses.replace(config, field=dataclasses.replace(config.field, few_views=17))
    for other, scene in ((few, SceneBounds(box, None, True)), (config, SceneBounds(box, 4 * box, False))):
        kept = other.for_field(17, scene).field.shape
        assert (kept.log2_table, kept.finest) == (more.get("hash_log2_table", 17), more.get("hash_max", 256))
    octree = dataclasses.replace(config, representation="octree")
    assert octree.for_field(17, SceneBounds(box, None, True)) is octree


def test_a_resumed_run_keeps_the_tables_it_began_with(tmp_path, tiny_scene, monkeypatch):
    """Whatever its budget: begun with a long one, gone on with without one, and the other way round."""
    monkeypatch.setattr(training, "LARGE_TABLES", {"hash_log2_table": 12, "hash_max": 48})
    monkeypatch.setattr(config_field, "LOG2_TABLE", 9)
    monkeypatch.setattr(config_field, "FINEST", 16)

    def interrupt(run, phase, began_stage):
        run.interrupted = True

    for first, then, tables in ((LARGE_TABLES_FROM, None, (12, 48)), (None, LARGE_TABLES_FROM, (9, 16))):
        field = {**UNSAID, "steps": 4}
        out, said = tmp_path / f"{first}", []
        config = settings(tiny_scene, out, representation="field", time_budget=first, field=field)
        shape = dataclasses.replace(config.field.shape, hash_log2_table=None, hash_max=None)
        config = dataclasses.replace(config, field=dataclasses.replace(config.field, shape=shape))
        with pytest.raises(KeyboardInterrupt):
            start(config, started=time.perf_counter(), watch=interrupt)
        with pytest.raises(KeyboardInterrupt):  # stopped once more: run.config's budget is the second one now
            start(
                dataclasses.replace(config, resume=True, time_budget=then), started=time.perf_counter(), watch=interrupt
            )
        start(dataclasses.replace(config, resume=True, time_budget=None), say=said.append)
        loaded = load_model(out / run_folder.FIELD)
        assert isinstance(loaded, FieldModel)
        shape = loaded.field.state.shape
        assert (shape.hash_log2_table, shape.hash_max) == tables
        assert not any("table" in sentence for sentence in said)


def test_a_damaged_shape_in_a_checkpoint_is_one_sentence(tmp_path):
    for shape, reason in (
        ([1], "is damaged"),
        ({"width": -1}, "its field's shape.*width"),
        ({"wide": 1}, "unknown key"),
    ):
        with pytest.raises(InputError, match=reason):
            field_begun({"phase": "field", "trainer": {"shape": shape}}, tmp_path)
    assert field_begun({"phase": "field", "trainer": {}}, tmp_path) is None  # of an earlier version


HOSTILE = {
    "newer version": ({"version": 2}, {}, "reads version 1"),
    "shape of text": ({"shape": "wide"}, {}, "shape|setting"),
    "unknown in shape": ({"shape": {"activation": "os.system"}}, {}, "unknown key"),
    "wide": ({"shape": {"width": 10**9}}, {}, "at most 1000 neurons"),
    "negative width": ({"shape": {"width": -1}}, {}, "width"),
    "another table": ({"shape": {"hash_log2_table": 24}}, {}, "'network' should be|'table' should be"),
    "no half": ({"half": 0}, {}, "its half is 0"),
    "half is true": ({"half": True}, {}, "its half is True"),
    "centre of two": ({"center": [0, 0]}, {}, "its center"),
    "resolution 30": ({"grid_resolution": 30}, {}, "a multiple of 4"),
    "no steps": ({"march_steps": 0}, {}, "its march_steps"),
    "huge outer": ({"outer": 1e300}, {}, "its outer"),
    "metadata is a list": ({"metadata": []}, {}, "metadata"),
    "missing table": ({}, {"table": None}, "'table' is missing"),
    "NaN": ({}, {"network": lambda a: a * np.nan}, "'network' are not finite"),
    "float64": ({}, {"table": lambda a: a.astype(np.float64)}, "should be float32"),
    "short bits": ({}, {"occupied": lambda a: a[:-1]}, "'occupied' should be"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_hostile_files_are_one_sentence(saved, case):
    document, arrays, reason = HOSTILE[case]
    whole, content = describe_file(saved) | document, load_file(saved)
    if "shape" in document and isinstance(document["shape"], dict):
        whole["shape"] = describe_file(saved)["shape"] | document["shape"]
    for name, change in arrays.items():
        if change is None:
            del content[name]
        else:
            content[name] = np.ascontiguousarray(change(content[name]))
    save_file(content, saved, {"nerfvol": json.dumps(whole)})
    with pytest.raises(InputError, match=reason) as error:
        load_model(saved)
    assert "field.safetensors" in str(error.value) and "\n" not in str(error.value)
