"""The command line: what a person types, what comes back, and one sentence with exit code 2 for everything unusable."""

import json
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

import nerfvol
from nerfvol.cli import main
from nerfvol.cli.command import set_threads
from nerfvol.config.assemble import run_settings
from nerfvol.config.training import Config
from nerfvol.errors import InputError
from nerfvol.octree.io import save_octree
from nerfvol.training.prepare import check_folder, claim_folder
from tests.fixtures.tiny import make_sphere_octree, write_scene

ROOT = Path(nerfvol.__file__).parents[1]


def run(*arguments, **keywords):
    """The command line in a process of its own."""
    command = [sys.executable, "-m", "nerfvol.cli", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=6000, **keywords)


# ---------------------------------------------------------------- help and mistakes
def imported_by(code):
    """The top-level modules that a process has imported after ``code``."""
    program = f"import sys\n{code}\nprint(*{{name.split('.')[0] for name in sys.modules}})"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


HEAVY = {"torch", "numpy", "numba", "imageio", "PIL", "data_synth"}


def test_importing_the_package_imports_nothing_heavy():
    assert not HEAVY & imported_by("import nerfvol")


@pytest.mark.parametrize("arguments", [["--help"], ["train", "--help"]])
def test_help_imports_nothing_heavy(arguments):
    """Why it answers at once: torch alone takes seconds."""
    assert not HEAVY & imported_by(f"from nerfvol.cli import main\nmain.main({arguments!r})")


def test_a_mistake_is_told_without_the_synthetic_scenes():
    """Their compiler takes a second to load, and they did not raise it."""
    mistake = "from nerfvol.cli import main\nassert main.main(['info', 'no-such-run']) == 2"
    assert not {"data_synth", "numba", "torch"} & imported_by(mistake)


def test_help_names_every_command():
    done = run("--help")
    assert done.returncode == 0
    for word in ("train", "eval", "render", "info", "synth", "bench"):
        assert word in done.stdout


@pytest.mark.parametrize("name", ["train", "eval", "render", "info", "bench"])
def test_every_command_has_help(name, command):
    code, out, _ = command(name, "--help")
    assert code == 0 and out.startswith(f"usage: nerfvol {name}")


def test_no_arguments_and_version(command):
    assert command()[:1] == (0,)
    assert command("--version") == (0, f"nerfvol {nerfvol.__version__}\n", "")


@pytest.mark.parametrize(
    "arguments, reason",
    [
        (["paint"], "invalid choice: 'paint'"),
        (["train", "--out", "x"], "needs --data"),
        (["train", "--data", "."], "needs --out"),
        (["train", "--data", "nowhere", "--out", "x"], "--data nowhere: no such folder or file"),
        (["train", "--data", ".", "--out", "x", "--time-buget", "5s"], "did you mean --time-budget?"),
        (["train", "--data", ".", "--out", "x", "--time-budget", "soon"], "time_budget: expected a duration"),
        (
            ["train", "--data", ".", "--out", "x", "--init", "nothing"],
            "init: expected auto, direct, mlp, splats, points, sweep, points+sweep, hull, random or "
            "a file of splats or an octree",
        ),
        (["train", "--data", ".", "--out", "x", "--config", "none.yaml"], "no such file: none.yaml"),
        (["train", "--data", ".", "--out", "x", "--seed", "one"], "seed: expected a whole number, got 'one'"),
        (["train", "--data", ".", "--out", "x", "--set", "octree.stepz=3"], "did you mean 'octree.steps'?"),
        (["train", "--data", ".", "--out", "x", "--set", "octree"], "--set expects KEY=VALUE"),
        (["train", "--data", ".", "--out", "x", "--downscale"], "expected one argument"),
        (["train", "--data", ".", "--out", "x", "--resume"], "nothing to resume"),
        (["train", "--data", ".", "--out", "file"], "it is a file, not a folder"),
        (["train", "--data", ".", "--out", "x", "more"], "unknown argument 'more'"),
        (["info", "none"], "no such run folder or model file"),
        (["bench"], "needs RUN|FILE"),
        (["bench", "file"], "not a usable model file"),
    ],
)
def test_one_sentence_and_code_2(tmp_path, command, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("x")
    code, out, err = command(*arguments)
    assert code == 2 and out == ""
    assert err.startswith("nerfvol: error: ") and err.count("\n") == 1
    assert reason in err, err


def test_unknown_config_key_names_the_nearest(tmp_path, command):
    (tmp_path / "c.yaml").write_text("octree:\n  sh_degre: 2\n")
    code, _, err = command("train", "--data", tmp_path, "--out", tmp_path / "x", "--config", tmp_path / "c.yaml")
    assert code == 2 and "unknown key 'octree.sh_degre'; did you mean 'octree.sh_degree'?" in err
    assert not (tmp_path / "x").exists()


# ---------------------------------------------------------------- how commands end
@pytest.mark.parametrize(
    "raised, code, text",
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (InputError("a\nb"), 2, "nerfvol: error: a b\n"),
        (OSError(28, "No space left on device", "log.jsonl"), 2, "log.jsonl: no space is left on the device"),
        (MemoryError(), 2, "memory is used up"),
        (BrokenPipeError(), 141, ""),
    ],
)
def test_endings(raised, code, text, capfd):
    def fail():
        raise raised

    assert main.guard(fail) == code
    assert text in capfd.readouterr().err


def test_defects_keep_their_traceback():
    def fail():
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        main.guard(fail)


def test_what_pillow_thinks_of_damaged_exif_is_not_shown():
    """A line of its source, once for each kind of damage, beside which the pictures are read all the same."""

    def warn():
        warnings.warn_explicit("Corrupt EXIF data.", UserWarning, "TiffImagePlugin.py", 1, module="PIL.TiffImagePlugin")
        return 0

    assert main.guard(warn) == 0
    with pytest.raises(UserWarning, match="other"):
        main.guard(lambda: warnings.warn_explicit("other", UserWarning, "x.py", 1, module="x") or 0)


def test_the_packages_share_one_kind_of_sentence(command):
    code, _, err = command("synth", "no-such-scene", "--out", "x")
    assert code == 2 and "no-such-scene" in err and "Traceback" not in err


def test_a_reader_that_leaves_is_no_error(tmp_path):
    save_octree(tmp_path / "o.safetensors", make_sphere_octree(3), {f"key{i}": "x" * 200 for i in range(2000)})
    code = f"{sys.executable} -m nerfvol.cli info {tmp_path / 'o.safetensors'} | head -n 1"
    done = subprocess.run(["sh", "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.stdout.startswith("file") and done.stderr == ""


# ---------------------------------------------------------------- info and run folders
def test_info(tmp_path, command):
    octree = make_sphere_octree(4)
    save_octree(tmp_path / "octree.safetensors", octree, {"provenance": {"seed": 7}})
    code, out, _ = command("info", tmp_path)
    assert code == 0 and f"{octree.n_leaves:,}" in out and "compute path" in out and '{"seed": 7}' in out
    code, out, _ = command("info", tmp_path / "octree.safetensors", "--json")
    record = json.loads(out)
    assert record["octree"]["leaves"] == octree.n_leaves
    assert record["octree"]["leaves_by_level"] == {"4": octree.n_leaves}
    assert record["octree"]["filled_share"] == pytest.approx(octree.n_leaves / 4096)
    assert record["file"]["aabb"] == [[-1, -1, -1], [1, 1, 1]]
    assert command("info")[0] == 0


def test_an_earlier_run_is_put_aside_once(tmp_path):
    config = Config(
        data=".",
        out=str(tmp_path / "run"),
    )
    check_folder(config)
    claim_folder(config)
    assert not (tmp_path / "run" / "previous").exists()
    for text in ("first", "second"):
        (tmp_path / "run" / "octree.safetensors").write_text(text)
        (tmp_path / "run" / "metrics.json").write_text(text)
        claim_folder(config)
        assert (tmp_path / "run" / "previous" / "octree.safetensors").read_text() == text
        assert not (tmp_path / "run" / "octree.safetensors").exists()
    config.resume = True
    (tmp_path / "run" / "octree.safetensors").write_text("third")
    claim_folder(config)
    assert (tmp_path / "run" / "octree.safetensors").read_text() == "third"


def test_threads_are_set_everywhere():
    import torch

    from nerfvol.kernels import ops

    before = ops.get_threads()
    try:
        assert set_threads(1) == 1 and ops.get_threads() == 1 and torch.get_num_threads() == 1
        assert set_threads(0) == len(os.sched_getaffinity(0)) == ops.get_threads()
    finally:
        ops.set_threads(before)


# ---------------------------------------------------------------- the whole way
TINY = """
time_budget: none
threads: 1
init: direct
octree:
  steps: 300
  levels: [4, 5, 5]
  downscales: [2, 1, 1]
  stage_ends: [0.2, 0.5, 1.0]
  tiles: [16, 16, 16]
  prunes: [1, 1, 1]
"""


@pytest.fixture(scope="module")
def trained(tmp_path_factory, tiny_scene):
    """A run folder made by the command line in a process of its own."""
    folder = tmp_path_factory.mktemp("trained")
    (folder / "tiny.yaml").write_text(TINY)
    done = run("train", "--data", tiny_scene, "--out", folder / "run", "--config", folder / "tiny.yaml", "--seed", 3)
    assert done.returncode == 0, done.stderr
    return folder / "run"


def test_train_leaves_a_whole_run_folder(trained):
    names = {path.name for path in trained.iterdir()}
    assert {"config.yaml", "octree.safetensors", "checkpoint.safetensors", "metrics.json", "log.jsonl"} <= names
    assert run_settings(trained)["seed"] == 3 and run_settings(trained)["octree"]["steps"] == 300
    for line in (trained / "log.jsonl").read_text().splitlines():
        json.loads(line)
    json.loads((trained / "metrics.json").read_text())


def test_train_eval_render_end_to_end(tmp_path, trained, command):
    code, *_ = command("eval", trained, "--split", "test", "--json", tmp_path / "s.json")  # data from the run's config
    assert code == 0
    record = json.loads((tmp_path / "s.json").read_text())
    assert record["psnr"] > 20  # a white picture scores 12
    code, *_ = command("render", trained, "--orbit", 2, "--out", tmp_path / "views")
    assert code == 0
    from PIL import Image

    picture = np.asarray(Image.open(tmp_path / "views" / "0000.png"))
    assert picture.shape[:2] == (40, 40)  # the size of the training images
    assert (picture != 255).any(axis=-1).mean() > 0.1  # the orbit looks at the scene


def test_config_of_a_run_reproduces_it_as_a_file(tmp_path, trained):
    from nerfvol.config.assemble import assemble, read_yaml, to_plain
    from nerfvol.config.training import Config

    settings = read_yaml(trained / "config.yaml")
    assert to_plain(assemble(Config, (settings, "config.yaml"))) == settings


@pytest.mark.parametrize("what", ["empty json", "no json", "truncated image", "transparent", "nan pose"])
def test_bad_data(tmp_path, command, what):
    """The loader's sentences reach the user through the command line."""
    scene = write_scene(tmp_path / "scene", {"train": 3, "val": 1}, size=24)
    listing, image = scene / "transforms_train.json", scene / "train" / "r_0.png"
    if what == "empty json":
        listing.write_text("")
    elif what == "no json":
        listing.unlink()
    elif what == "truncated image":
        image.write_bytes(image.read_bytes()[:60])
    elif what == "transparent":
        from nerfvol.files.pictures import write_png

        for path in (scene / "train").iterdir():
            write_png(path, np.zeros((24, 24, 4)))
    else:
        document = json.loads(listing.read_text())
        for frame in document["frames"]:
            frame["transform_matrix"][0][3] = float("nan")
        listing.write_text(json.dumps(document))
    code, _, err = command("train", "--data", scene, "--out", tmp_path / "run", "--time-budget", "5s")
    assert code == 2 and err.strip().splitlines()[-1].startswith("nerfvol: error: ")
    assert str(tmp_path / "scene") in err
