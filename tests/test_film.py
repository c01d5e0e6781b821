"""nerfvol render to videos and pictures: each is what its name says, of the length, size and content asked for."""

import json
import subprocess

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from nerfvol.cameras.camera import Camera, Intrinsics, orbit
from nerfvol.cameras.paths import cameras_document
from nerfvol.octree.io import save_octree


@pytest.fixture(scope="module")
def files(tmp_path_factory, sphere_octree):
    folder = tmp_path_factory.mktemp("models")
    save_octree(folder / "a.safetensors", sphere_octree, {})
    other = sphere_octree.with_sh_degree(0)
    other.sh = -other.sh
    save_octree(folder / "b.safetensors", other, {})
    return folder


def read(path):
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def frames_of(path, width, height):
    """(n, height, width, 3) uint8 as ffmpeg decodes them, and what it says of the file."""
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3), done.stderr.decode()


@pytest.mark.parametrize("ending, starts, codec", [
    (".mp4", b"ftyp", "h264"), (".mov", b"ftypqt", "h264"), (".webm", b"\x1aE\xdf\xa3", "vp9"), (".gif", b"GIF89a", "gif"),
])  # fmt: skip
def test_a_video_is_what_its_name_says(tmp_path, files, command, ending, starts, codec):
    out = tmp_path / f"v{ending}"
    timing = ("--seconds", "0.5", "--fps", 10, "--size", "48x32")
    code, said, err = command("render", files / "a.safetensors", "--path", "orbit", *timing, "--out", out)
    assert code == 0 and "5 views" in said, err
    head = out.read_bytes()[:16]
    assert out.is_file() and starts in head
    video, about = frames_of(out, 48, 32)
    assert len(video) == 5 and codec in about
    assert (
        command(
            "render",
            files / "a.safetensors",
            "--path",
            "orbit",
            "--frames",
            5,
            "--size",
            "48x32",
            "--out",
            tmp_path / "f",
        )[0]
        == 0
    )
    still = read(tmp_path / "f" / "0002.png").astype(float)
    assert np.abs(video[2] - still).mean() < 12  # subsampled colours, 256 of them in a GIF


def test_depth_beside_another_model(tmp_path, files, command):
    common = ("--path", "orbit", "--frames", 2, "--size", "40x32")
    a, b = files / "a.safetensors", files / "b.safetensors"
    assert command("render", a, *common, "--compare", b, "--out", tmp_path / "c")[0] == 0
    for name in "ab":
        assert command("render", files / f"{name}.safetensors", *common, "--out", tmp_path / name)[0] == 0
    both = read(tmp_path / "c" / "0001.png")
    assert both.shape == (32, 88, 3) and (both[:, 40:48] == 255).all()
    assert np.array_equal(both[:, :40], read(tmp_path / "a" / "0001.png"))
    assert np.array_equal(both[:, 48:], read(tmp_path / "b" / "0001.png"))
    assert command("render", a, *common, "--output", "depth", "--aov", "normal", "--out", tmp_path / "d")[0] == 0
    assert command("render", a, *common, "--aov", "depth,normal", "--out", tmp_path / "e")[0] == 0
    assert (tmp_path / "d" / "0000.png").read_bytes() == (tmp_path / "e" / "0000_depth.png").read_bytes()
    assert (tmp_path / "d" / "0000_normal.png").read_bytes() == (tmp_path / "e" / "0000_normal.png").read_bytes()
    code, _, err = command("render", a, *common, "--compare", b, "--format", "exr", "--out", tmp_path / "x")
    assert code == 2 and "EXR pictures hold one model" in err


def test_one_picture_or_a_sentence(tmp_path, files, command):
    model = files / "a.safetensors"
    assert (
        command("render", model, "--path", "orbit", "--frames", 1, "--size", "20x20", "--out", tmp_path / "x.png")[0]
        == 0
    )
    assert read(tmp_path / "x.png").shape == (20, 20, 3)
    code, _, err = command("render", model, "--orbit", 3, "--out", tmp_path / "y.png")
    assert code == 2 and "is one picture and there are 3 views" in err
    for ending in (".avi", ".jpg"):
        code, _, err = command("render", model, "--orbit", 3, "--out", tmp_path / f"y{ending}")
        assert code == 2 and f"{ending} is not written: expected .mp4, .mov, .webm, .gif" in err
    assert {p.name for p in tmp_path.iterdir()} == {"x.png"}


@pytest.mark.parametrize(
    "ending, others", [(".mp4", [(24, 32)]), (".gif", [(16, 16), (48, 20)]), (".webm", [(32, 23)])]
)
def test_cameras_of_several_sizes(tmp_path, files, command, ending, others):
    lens = Intrinsics(32, 24, 40.0, 40.0, 16.0, 12.0)
    cameras = orbit(2, center=(0, 0, 0), radius=3.0, elevation_deg=20.0, intrinsics=lens)
    cameras += [Camera(Intrinsics(w, h, 40.0, 40.0, w / 2, h / 2), cameras[0].c2w) for w, h in others]
    names = [str(k) for k in range(len(cameras))]
    (tmp_path / "p.json").write_text(json.dumps(cameras_document(cameras, names)))
    out = tmp_path / f"v{ending}"
    code, said, err = command("render", files / "a.safetensors", "--cameras", tmp_path / "p.json", "--out", out)
    assert code == 0 and "all are drawn at the first one's, 32x24" in said, err
    assert len(frames_of(out, 32, 24)[0]) == len(cameras)


def test_frames_between_keyframes(tmp_path, files, command):
    lens = Intrinsics(16, 12, 20.0, 20.0, 8.0, 6.0)
    cameras = orbit(4, center=(0, 0, 0), radius=3.0, elevation_deg=20.0, intrinsics=lens)
    (tmp_path / "p.json").write_text(json.dumps(cameras_document(cameras, list("abcd"))))
    out = tmp_path / "o"
    assert (
        command(
            "render", files / "a.safetensors", "--path", tmp_path / "p.json", "--frames", 8, "--loop", "--out", out
        )[0]
        == 0
    )
    used = json.loads((out / "cameras.json").read_text())["frames"]
    assert len(used) == 8
    for k in range(4):
        assert np.allclose(used[2 * k]["transform_matrix"], cameras[k].c2w, atol=1e-9)
    radius = np.linalg.norm([np.array(f["transform_matrix"])[:3, 3] for f in used], axis=1)
    between = 10 / 16 * np.sqrt(2) * 3 * np.cos(np.radians(20))  # Catmull-Rom halfway along a quarter of a circle
    assert np.allclose(radius[1::2], np.hypot(between, 3 * np.sin(np.radians(20))), rtol=1e-6)


@pytest.mark.parametrize("arguments, reason", [
    (("--path", "zigzag", "--out", "x"), "unknown path 'zigzag': expected orbit, ellipse, spiral, lemniscate, or a file"),
    (("--path", "orbit", "--frames", 3, "--seconds", 2, "--out", "x"), "both say how many pictures"),
    (("--orbit", 3, "--frames", 3, "--out", "x"), "use --path orbit"),
    (("--path", "orbit", "--seconds", -1, "--out", "x"), "seconds"),
    (("--path", "orbit", "--fps", 0, "--out", "x"), "fps"),
    (("--path", "orbit", "--output", "albedo", "--out", "x"), "output"),
    (("--path", "orbit", "--compare", "none.safetensors", "--out", "x"), "no such run folder or model file"),
])  # fmt: skip
def test_refusals(tmp_path, files, command, monkeypatch, arguments, reason):
    monkeypatch.chdir(tmp_path)
    code, _, err = command("render", files / "a.safetensors", *arguments)
    assert code == 2 and reason in err and err.count("\n") == 1 and not list(tmp_path.iterdir())
