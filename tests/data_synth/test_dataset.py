"""Cameras, pictures, the folder that is written, and the command line."""

import ast
import errno
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from data_synth import (
    Camera,
    InputError,
    Options,
    Viewpoints,
    files,
    look_at,
    media,
    render,
    scenes,
    surfaces,
    transmittance,
    write_dataset,
)
from data_synth.cli import main, render_task
from data_synth.dataset import split_cameras
from data_synth.image import Picture, linear_to_srgb, read_exr, srgb_to_linear, write_exr
from data_synth.scenes.showcase import Showcase, edge_pixels
from data_synth.views import render_view


@pytest.fixture(scope="module")
def showcase():
    return Showcase(smooth=1)


def test_look_at_is_opengl():
    c2w = look_at((4.0, 0.0, 0.0))
    assert np.allclose(c2w[:3, 2], [1, 0, 0]) and np.allclose(c2w[:3, 1], [0, 0, 1])  # looks down -z, y is up
    assert np.allclose(np.linalg.det(c2w[:3, :3]), 1)


def test_viewpoints_stay_in_their_band_and_do_not_repeat():
    band = Viewpoints(target=(0, 0, 0.5), radius=3.0, elevation=(10, 60))
    eyes = np.array([c.c2w[:3, 3] for c in band.spread(40, 8, 8, seed=1)]) - [0, 0, 0.5]
    elevation = np.degrees(np.arcsin(eyes[:, 2] / 3.0))
    assert np.allclose(np.linalg.norm(eyes, axis=1), 3.0) and elevation.min() >= 10 and elevation.max() <= 60
    gaps = np.linalg.norm(eyes[:, None] - eyes[None], axis=-1) + 9 * np.eye(40)
    assert gaps.min() > 0.25


def test_rays_go_through_pixel_centres():
    """A glowing ball 0.1 px wide lies behind the centre of pixel (5, 2): that pixel sees it, at the right distance."""
    c = Camera(9, 7, 12.0, look_at((0.5, -3.0, 1.0), (0.1, 0.2, 0.0)))
    d = np.array([(5 + 0.5 - 4.5) / 12.0, -(2 + 0.5 - 3.5) / 12.0, -1.0])
    centre = c.c2w[:3, 3] + 2.5 * (c.c2w[:3, :3] @ d) / np.linalg.norm(d)
    from data_synth import Emission, Scene, materials, surfaces

    r = 0.05 * 2.5 / 12.0
    scene = Scene(
        medium=media.homogeneous(centre - r, centre + r, 1e6, Le=1.0),
        shapes=[surfaces.sphere(0, centre, r)], materials=[materials.null()], bounded=True,
    )  # fmt: skip
    picture = Emission().render(scene, c)
    assert np.argwhere(picture.alpha > 0).tolist() == [[2, 5]]
    assert picture.distance[2, 5] == pytest.approx(2.5, abs=2 * r)


def test_showcase_haze_converges_to_itself(showcase):
    """Midpoint quadrature: the error against 16 times the steps falls at second order."""
    camera = showcase.viewpoints.camera(20, 25, 24, 24)
    pictures = {n: Showcase(steps=n, smooth=1).render(camera) for n in (48, 96, 768)}
    errors = [np.abs(pictures[n].rgb - pictures[768].rgb).mean() for n in (48, 96)]
    assert errors[0] / errors[1] > 3.0
    assert np.abs(pictures[96].rgb - pictures[768].rgb).max() < 0.01


def test_showcase_is_opaque_where_solid_and_clear_outside(showcase):
    picture = showcase.render(showcase.viewpoints.camera(20, 25, 64, 64))
    assert picture.alpha.min() == 0.0 and picture.alpha.max() == 1.0
    hazy = (picture.alpha > 0.02) & (picture.alpha < 0.98)
    assert 0.02 < hazy.mean() < 0.4
    assert np.allclose(picture.rgb[picture.alpha == 0], 0.0)


def test_gloss_depends_on_the_view(showcase):
    """The same surface point seen from two sides has two colours, a matt one would not."""
    from data_synth.jit import kernel
    from data_synth.scenes.showcase import surface_radiance

    @kernel
    def look(out):
        for k in range(2):
            x = 0.6 if k == 0 else -0.6
            out[k, 0], out[k, 1], out[k, 2] = surface_radiance(0, -0.62, -0.38, 0.09, x, 0.0, -0.8)

    out = np.empty((2, 3))
    look(out)
    assert np.abs(out[0] - out[1]).max() > 0.05


def test_edges_are_found():
    image = np.zeros((5, 6, 4))
    image[2:, 3:] = 1.0
    found = {tuple(p) for p in edge_pixels(image, 0.5)}
    assert (2, 3) in found and (1, 4) in found and (4, 2) in found and (0, 0) not in found and (4, 5) not in found


def test_pictures_are_straight_srgb():
    rgb = np.array([[[0.1, 0.2, 0.05], [0.0, 0.0, 0.0]]])
    pixels = Picture(rgb, np.array([[0.5, 0.0]]), np.zeros((1, 2))).rgba8()
    assert pixels[0, 0].tolist() == [*np.rint(255 * linear_to_srgb(rgb[0, 0] / 0.5)), 128]
    assert pixels[0, 1].tolist() == [0, 0, 0, 0]
    x = np.linspace(0, 1, 100)
    assert np.allclose(srgb_to_linear(linear_to_srgb(x)), x, atol=1e-12)


def test_dark_pixels_and_the_exposure_of_pictures():
    """Below 0.0031 the curve is a line; the exposure scales light, before it; alpha stays."""
    rgb, alpha = np.array([[[0.002, 0.0005, 0.2]]]), np.array([[0.5]])
    for exposure in (1.0, 0.25, 3.0):
        x = exposure * rgb[0, 0] / 0.5
        want = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
        found = Picture(rgb, alpha, np.zeros((1, 1))).rgba8(exposure)[0, 0]
        assert found.tolist() == [*np.rint(255 * np.clip(want, 0, 1)), 128]
    dark = np.array([0.0, 0.001, 0.02, 0.04])
    assert np.allclose(srgb_to_linear(dark), dark / 12.92)
    assert np.allclose(
        Picture(rgb, alpha, alpha).over((0.1, 0.2, 0.4))[0, 0], rgb[0, 0] + 0.5 * np.array([0.1, 0.2, 0.4])
    )


def test_held_out_cameras_are_not_on_the_training_spiral():
    """Neither in place nor in azimuth: each split's spiral is turned differently."""
    splits = split_cameras(scenes.make("slab"), 40, (8, 8), 5)
    assert {split: len(cameras) for split, cameras in splits.items()} == {"train": 40, "val": 2, "test": 5}
    azimuths = {
        split: np.array([np.arctan2(c.c2w[1, 3], c.c2w[0, 3]) for c in cameras]) for split, cameras in splits.items()
    }
    for a, b in (("train", "val"), ("train", "test"), ("val", "test")):
        apart = np.angle(np.exp(1j * (azimuths[a][:, None] - azimuths[b][None])))
        assert np.abs(apart).min() > 1e-4


def test_exr_round_trip(tmp_path):
    channels = {n: np.random.default_rng(k).random((5, 7)).astype(np.float32) for k, n in enumerate("RGBAZ")}
    write_exr(tmp_path / "a.exr", channels)
    back = read_exr(tmp_path / "a.exr")
    assert all(np.array_equal(channels[n], back[n]) for n in channels)


def test_dataset_has_the_nerf_synthetic_layout(tmp_path):
    scene = scenes.make("slab")  # not symmetric about an axis: other cameras make other pictures
    write_dataset(scene, tmp_path / "out", Options(views=3, size=(12, 10), seed=4, exr=True))
    for split, n in (("train", 3), ("val", 1), ("test", 2)):
        meta = json.loads((tmp_path / "out" / f"transforms_{split}.json").read_text())
        assert len(meta["frames"]) == n
        for frame in meta["frames"]:
            path = tmp_path / "out" / (frame["file_path"] + ".png")
            pixels = np.asarray(Image.open(path))
            assert pixels.shape == (10, 12, 4) and pixels.dtype == np.uint8
            assert "Z" in read_exr(path.with_suffix(".exr"))
            pose = np.array(frame["transform_matrix"])
            assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert meta["camera_angle_x"] == pytest.approx(np.radians(scene.viewpoints.fov))
    provenance = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert provenance["scene"] == "slab" and provenance["seed"] == 4
    # the same seed makes the same bytes
    write_dataset(scene, tmp_path / "again", Options(views=3, size=(12, 10), seed=4))
    for png in sorted((tmp_path / "out").rglob("*.png")):
        assert png.read_bytes() == (tmp_path / "again" / png.relative_to(tmp_path / "out")).read_bytes()


def _set(folder):
    return {
        str(p.relative_to(folder)): p.read_bytes()
        for p in folder.rglob("*")
        if p.is_file() and p.name != "provenance.json"
    }


SLAB = ("slab", "--views", "3", "--size", "8x6", "--exr")


def test_parts_of_a_set_are_the_bytes_of_the_whole(tmp_path):
    assert main([*SLAB, "--out", str(tmp_path / "whole")]) == 0
    parts = [*SLAB, "--out", str(tmp_path / "parts")]
    for frames in ("0-4/2", "3-5"):
        assert main([*parts, "--frames", frames]) == 0
        assert not list((tmp_path / "parts").glob("transforms*"))  # not complete yet
    assert main([*parts, "--frames", "0-5"]) == 0
    assert _set(tmp_path / "parts") == _set(tmp_path / "whole")
    before = (tmp_path / "parts" / "train" / "r_0.png").stat().st_mtime_ns
    assert main([*parts, "--frames", "0-5"]) == 0  # is complete: nothing is done
    assert (tmp_path / "parts" / "train" / "r_0.png").stat().st_mtime_ns == before


def test_a_set_that_was_stopped_goes_on_and_never_stands_beside_another_ones_transforms(tmp_path):
    out, whole = tmp_path / "set", tmp_path / "whole"
    assert main([*SLAB, "--seed", "5", "--out", str(whole)]) == 0
    assert main(["slab", "--views", "9", "--size", "8x6", "--out", str(out)]) == 0  # a larger set of another seed

    class Killed(Exception):
        pass

    def killed_after_two(pieces):
        for k, piece in enumerate(pieces):
            if k == 2:
                raise Killed
            yield render_task({"argv": [*SLAB, "--seed", "5"]}, {}, piece)

    with pytest.raises(Killed):
        main([*SLAB, "--seed", "5", "--out", str(out)], killed_after_two)
    assert not list(out.glob("transforms*")) and len(list(out.rglob("r_*.png"))) == 2
    kept = (out / "train" / "r_0.png").stat().st_mtime_ns
    assert main([*SLAB, "--seed", "5", "--out", str(out)]) == 0
    assert _set(out) == _set(whole) and (out / "train" / "r_0.png").stat().st_mtime_ns == kept


def test_what_killed_writers_left_is_removed_by_the_next_run(tmp_path):
    """Of processes of this machine that are gone; a set that is gone on with, and pictures alone."""
    gone = subprocess.run(
        [sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True
    ).stdout
    here = [files._machine(), "0" * 8]
    names = [
        f".r_0.{process}.{machine}{'1' * 8}.tmp.png" for machine in here for process in (gone.strip(), os.getpid())
    ]
    (tmp_path / "train").mkdir()
    for folder in (tmp_path, tmp_path / "train"):
        for name in names:
            (folder / name).touch()
    assert main([*SLAB, "--out", str(tmp_path)]) == 0
    for folder in (tmp_path, tmp_path / "train"):
        assert sorted(p.name for p in folder.glob(".*.tmp*")) == sorted(names[1:])
    (tmp_path / names[0]).touch()
    assert main(["slab", "--integrator", "emission", "--size", "8x6", "--picture", str(tmp_path / "one.png")]) == 0
    assert not (tmp_path / names[0]).exists()


def test_every_view_has_a_seed_of_its_own_whoever_renders_it(tmp_path, monkeypatch):
    seen = {}

    def watched(scene, camera, integrator=None, seed=0):
        seen.setdefault(camera.c2w.tobytes(), []).append(seed)
        return render_view(scene, camera, integrator, seed)

    monkeypatch.setattr("data_synth.views.render_view", watched)
    write_dataset(scenes.slab(), tmp_path / "all", Options(3, (4, 4), seed=2))
    write_dataset(scenes.slab(), tmp_path / "some", Options(3, (4, 4), seed=2, chosen=(1, 5, 2)))
    seeds = list(seen.values())
    assert len({seed for row in seeds for seed in row}) == len(seeds) == 6
    assert sorted(len(row) for row in seeds) == [1, 1, 1, 2, 2, 2] and all(len(set(row)) == 1 for row in seeds)


@pytest.mark.parametrize(
    ("frames", "message"),
    [("0-9", "there are the views 0-5"), ("2-1", "A up to B"), ("0-1/0", "S at least 1"), ("x", "expected A-B")],
)
def test_frames_that_make_no_sense_are_one_sentence(tmp_path, capsys, frames, message):
    assert main([*SLAB, "--out", str(tmp_path), "--frames", frames]) == 2 and message in capsys.readouterr().err


def test_a_shared_folder_of_another_set_is_refused(tmp_path, capsys):
    assert main([*SLAB, "--out", str(tmp_path)]) == 0
    assert main([*SLAB, "--seed", "1", "--out", str(tmp_path), "--frames", "0-1"]) == 2
    assert "another scene" in capsys.readouterr().err and list(tmp_path.glob("transforms*"))


def test_a_pixel_of_a_written_view_is_the_chord(tmp_path):
    """From the files alone: pose, angle and alpha of the homogeneous sphere satisfy alpha = 1 - exp(-sigma chord)."""
    write_dataset(scenes.make("sphere"), tmp_path, Options(views=1, size=(33, 33)))
    meta = json.loads((tmp_path / "transforms_train.json").read_text())
    pose = np.array(meta["frames"][0]["transform_matrix"])
    alpha = np.asarray(Image.open(tmp_path / "train" / "r_0.png"))[..., 3] / 255.0
    focal = 16.5 / np.tan(0.5 * meta["camera_angle_x"])
    for j, i in ((16, 16), (10, 12), (20, 25)):
        d = pose[:3, :3] @ np.array([(i - 16.0) / focal, -(j - 16.0) / focal, -1.0])
        d /= np.linalg.norm(d)
        b = np.dot(pose[:3, 3], d)
        h = 1.0 - (pose[:3, 3] @ pose[:3, 3] - b * b)
        want = np.mean(1 - np.exp(-1.6 * np.array([0.5, 0.8, 1.0]) * 2 * np.sqrt(max(h, 0.0))))
        assert alpha[j, i] == pytest.approx(want, abs=0.51 / 255)


def test_imported_volume_fills_the_scene(tmp_path):
    rho = np.zeros((9, 9, 9), np.float32)
    rho[4, 4, 4] = 7.0
    np.savez(tmp_path / "v.npz", density=rho)
    scene = scenes.make("smoke", volume=str(tmp_path / "v.npz"), density=3.0)
    centre = 0.5 * (np.array(scene.medium.lo) + scene.medium.hi)
    T = transmittance.sample_transmittance(scene.medium, centre - [0, 0, 1e-4], (0.0, 0.0, 1.0), 2e-4, "regular")
    assert -np.log(T[0, 0]) / 2e-4 == pytest.approx(3.0, rel=1e-2)


@pytest.mark.parametrize("name", [n for n in scenes.SCENES if n != "showcase"])
def test_no_surface_stands_in_the_box_of_a_written_density(name):
    """density.npz knows the medium alone: what is compared inside its box must be medium alone as well."""
    resolution = {"resolution": 16} if "resolution" in inspect.signature(scenes.SCENES[name]).parameters else {}
    scene = scenes.make(name, **resolution)
    if scene.medium is None or scene.medium.kind != media.GRID:
        return
    assert scene.triangles is None
    for kind, _, *corners in scene.shapes:
        assert kind == surfaces.BOX
        lo, hi = np.array(corners[:3]), np.array(corners[3:6])
        assert np.any(hi < np.array(scene.medium.lo) - 0.02) or np.any(lo > np.array(scene.medium.hi) + 0.02)


def test_command_line(tmp_path, capsys):
    assert main(["list"]) == 0
    listed = capsys.readouterr().out
    for name, line in zip(scenes.SCENES, listed.splitlines(), strict=True):  # one line and one thumbnail each
        assert line.startswith(name) and f"docs/gallery/{name}.jpg" in line
        with Image.open(Path(__file__).parents[2] / f"docs/gallery/{name}.jpg") as picture:
            shades = np.asarray(picture.convert("L"), float)
        assert min(shades.shape) >= 128 and shades.std() > 5, name  # a picture of something
    argv = ["slab", "--views", "1", "--size", "6x4", "--set", "sigma=2.0", "--out", str(tmp_path / "o")]
    assert main(argv) == 0
    assert json.loads((tmp_path / "o" / "provenance.json").read_text())["parameters"] == {"sigma": 2.0}
    assert main(["slab", "--picture", str(tmp_path / "p.jpg"), "--size", "8x8"]) == 0


@pytest.mark.parametrize(
    "argv, message",
    [
        (["clod", "--out", "x"], "did you mean cloud?"),
        (["slab", "--out", "x", "--set", "sigm=1"], "did you mean sigma?"),
        (["slab", "--out", "x", "--set", "sigma"], "KEY=VALUE"),
        (["slab", "--out", "x", "--set", "sigma=-1"], "sigma expects a number from 0"),
        (["slab", "--out", "x", "--set", "sigma=abc"], "sigma expects a number"),
        (["slab", "--out", "x", "--set", "sigma=nan"], "sigma expects a number"),
        (["slab", "--out", "x", "--set", "sigma=True"], "sigma expects a number"),
        (["slab", "--out", "x", "--size", "40"], "WxH"),
        (["slab", "--out", "x", "--size", "-8x8"], "--size"),
        (["slab", "--out", "x", "--views", "0"], "--views"),
        (["slab", "--out", "x", "--views", "two"], "--views"),
        (["slab", "--out", "x", "--veiws", "2"], "--veiws"),
        (["slab", "--out", "x", "--seed", "-1"], "--seed"),
        (["slab", "--out", "x", "--integrator", "deep"], "emission, path"),
        (["slab", "--out", "x", "--light", "sin"], "did you mean sun?"),
        (["slab", "--out", "x", "--light", ""], "--light"),
        (["slab", "--out", "x", "--spp", "4"], "--spp"),
        (["slab", "--out", "x", "--max-depth", "4"], "--max-depth"),
        (["slab", "--out", "x", "--integrator", "path", "--max-depth", "-1"], "--max-depth"),
        (["slab", "--out", "x", "--integrator", "path", "--spp", "0"], "--spp"),
        (["slab", "--out", "x", "--side", "0"], "--side"),
        (["slab", "--out", "x", "--step", "0"], "--step"),
        (["slab", "--out", "x", "--step", "nan"], "--step"),
        (["slab", "--out", "x", "--fov", "180"], "--fov"),
        (["slab", "--out", "x", "--exposure", "0"], "--exposure"),
        (["slab"], "--out"),
        (["slab", "--out", "x", "--picture", "y.png"], "both"),
        (["slab", "--picture", "nodir/a.png"], "a folder that exists"),
        (["slab", "--picture", "a.gif"], ".jpg or .png"),
        (["list", "--out", "x"], "nothing else"),
        (["cloud", "--out", "x", "--set", "seed=abc"], "whole number from 0"),
        (["cloud", "--out", "x", "--set", "resolution=-5"], "from 8 to 1024"),
        (["cloud", "--out", "x", "--set", "resolution=100000"], "from 8 to 1024"),
        (["cloud", "--out", "x", "--set", "resolution=16", "--fill", "swep"], "sweep, eager or lazy"),
        (["cloud", "--out", "x", "--set", "resolution=16", "--resolution", "1"], "--resolution"),
        (["showcase", "--out", "x", "--set", "steps=-1"], "from 1 to 100000"),
        (["showcase", "--out", "x", "--set", "steps=0"], "from 1 to 100000"),
        (["showcase", "--out", "x", "--set", "haze=-5"], "haze expects"),
        (["showcase", "--out", "x", "--light", "sun"], "keeps its own lights"),
        (["showcase", "--out", "x", "--integrator", "path"], "takes emission"),
        (["showcase", "--out", "x", "--step", "0.1"], "no medium"),
        (["solids", "--out", "x", "--step", "0.1"], "no medium"),
        (["bench", "tow"], "one, sky"),
        (["smoke", "--out", "x", "--volume", "missing.vdb"], "missing.vdb"),
        (["smoke", "--out", "x", "--volume", ""], "--volume"),
        (["scene.yaml", "--out", "x"], "cannot be read"),
        (["scene.yaml", "--out", "x", "--light", "sun"], "says these itself"),
    ],
)
def test_bad_command_lines_are_one_sentence_and_code_2(argv, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(argv) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and "Traceback" not in error
    assert not (tmp_path / "x" / "transforms_train.json").exists()


@pytest.mark.parametrize("arguments", [{"steps": -1}, {"steps": 0}, {"haze": -1.0}, {"smooth": 0}])
def test_the_showcase_refuses_what_it_cannot_integrate(arguments):
    with pytest.raises(InputError, match=next(iter(arguments))):
        Showcase(**arguments)


@pytest.mark.parametrize("name", scenes.SCENES)
def test_help_tells_parameters_defaults_and_integrators(name, capsys):
    with pytest.raises(SystemExit) as done:
        main([name, "--help"])
    told = capsys.readouterr().out
    assert done.value.code == 0 and scenes.summary(name) in told and "its own choice first" in told
    for key, default in scenes.parameters_of(name).items():
        assert ("--volume FILE" if key == "volume" else f"--set {key}={default}") in told


def test_options_reach_the_picture(tmp_path):
    """Each of --step --exposure --fov --side --max-depth --seed changes the files."""

    def written(*options):
        folder = tmp_path / "-".join(options).replace(".", "_")
        assert main(["slab", "--views", "1", "--size", "6x5", "--out", str(folder), "--exr", *options]) == 0
        return (
            (folder / "train/r_0.exr").read_bytes(),
            (folder / "train/r_0.png").read_bytes(),
            json.loads((folder / "transforms_train.json").read_text()),
        )

    plain = written()
    assert written("--step", "0.2")[0] != plain[0] and written("--side", "2")[0] != plain[0]
    bright = written("--exposure", "0.5")
    assert bright[0] == plain[0] and bright[1] != plain[1]
    assert written("--fov", "20")[2]["camera_angle_x"] == pytest.approx(np.radians(20.0))
    one = written("--integrator", "path", "--spp", "2", "--max-depth", "0")
    assert one[0] != written("--integrator", "path", "--spp", "2", "--seed", "5")[0]


def test_render_is_public():
    picture = render(scenes.sphere(), scenes.sphere().viewpoints.camera(0, 10, 6, 6))
    assert picture.rgb.shape == (6, 6, 3)


def test_data_synth_imports_nothing_from_nerfvol():
    folder = Path(__file__).parents[2] / "data_synth"
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(n.split(".")[0] == "nerfvol" for n in names), path


def test_bad_cameras_are_refused():
    with pytest.raises(InputError, match="rotation"):
        Camera(4, 4, 5.0, np.diag([1.0, 2.0, 1.0, 1.0]))
    with pytest.raises(InputError, match="focal"):
        Camera(4, 4, 0.0, np.eye(4))


def test_what_the_system_refuses_names_the_file(tmp_path):
    """And not the temporary one: a full disk names none."""
    with pytest.raises(OSError, match="full") as raised, files.replacing(tmp_path / "a.json"):
        raise OSError(errno.ENOSPC, "full")
    assert raised.value.filename == str(tmp_path / "a.json")
    with pytest.raises(OSError, match="No such file") as raised, files.replacing(tmp_path / "none" / "a.json") as path:
        path.write_text("a")
    assert raised.value.filename == str(tmp_path / "none" / "a.json")
