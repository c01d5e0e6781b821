"""Pictures: every pixel is its own ray's, distances are distances, files say what was rendered."""

import json
import math
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_synth.image import read_exr
from nerfvol import views
from nerfvol.cameras.camera import Camera, Intrinsics, look_at, orbit
from nerfvol.cameras.paths import cameras_document, default_orbit, describe_orbit, load_cameras, orbit_cameras
from nerfvol.errors import InputError
from nerfvol.files import pictures
from nerfvol.kernels import ops
from nerfvol.kernels.state import OUTPUTS
from nerfvol.octree.io import save_octree
from nerfvol.octree.tree import Octree


def lens_of(width, height, focal=None):
    focal = focal or 1.2 * width
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def camera_at(width, height, **lens):
    return Camera(lens_of(width, height, **lens), look_at((2.1, 1.3, 0.9), (0, 0, 0)))


# ---------------------------------------------------------------- pixels
@pytest.mark.parametrize("size", [(37, 21), (40, 16), (8, 8), (1, 1), (5, 70)])
@pytest.mark.parametrize("path", ["compiled", "reference"])
def test_every_pixel_is_its_own_ray(sphere_octree, monkeypatch, size, path):
    """Against one ray per pixel in row order: tiles and cropping move nothing."""
    camera = camera_at(*size)
    with monkeypatch.context() as patch:
        if path == "reference":
            patch.setattr(ops, "native", lambda: None)
        image = views.render_image(sphere_octree, camera, (0.2, 0.4, 0.6), 0.0, lod=0.0)
    origin, directions = camera.rays()
    expected = ops.render_rays(
        sphere_octree, np.broadcast_to(origin, directions.shape).copy(), directions, (0.2, 0.4, 0.6), 0.0
    )
    assert set(image) == set(OUTPUTS)
    for name, value in image.items():
        want = expected[name].reshape(value.shape)
        # float32 sums over at most some 30 leaves of values of order 1 (distances: of order 3)
        np.testing.assert_allclose(value, want, rtol=0, atol=2e-5, err_msg=name)
        assert value.shape[:2] == size[::-1] and value.dtype == np.float32


def wall():
    """A dense cube of side 1 in [0, 1]^3 minus (0.5, 0.5, 0): faces at x = +-0.5, y = +-0.5, z = 0 and 1."""
    cells = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3)
    octree = Octree.from_leaves(np.full(512, 3), cells, (-0.5, -0.5, 0.0), 1.0, 0, 1e4)
    octree.density = 10.0
    octree.sh = np.array([0.4, 0.0, -0.4])[None, :, None] / 0.28209479177387814
    return octree


def test_known_geometry_of_a_wall():
    """A camera 2 above the cube's upper face: sizes, distances and colours follow from similar triangles."""
    camera = Camera(lens_of(64, 64, focal=96.0), look_at((0, 0, 3.0), (0, 0, 0), up=(0, 1, 0)))
    image = views.render_image(wall(), camera, (1, 1, 1), 0.0)
    # The face at distance 2 spans 1 / 2 * 96 = 48 pixels: 8 to 56, to the pixel.
    inside = np.zeros((64, 64), bool)
    inside[8:56, 8:56] = True
    assert np.array_equal(image["opacity"] > 0.5, inside)
    depth = views.surface_depth(image)
    i, j = np.meshgrid(np.arange(64), np.arange(64))
    slant = np.sqrt(1 + ((i + 0.5 - 32) / 96) ** 2 + ((j + 0.5 - 32) / 96) ** 2)
    # One midpoint sample a leaf of size 1/8: the mean distance is at most a leaf's half diagonal behind the face.
    assert np.all(depth[inside] >= 2 * slant[inside] - 1e-5) and np.all(depth[inside] <= 2 * slant[inside] + 0.125)
    assert np.all(depth[~inside] == 0)
    np.testing.assert_allclose(image["rgb"][32, 32], [0.9, 0.5, 0.1], atol=1e-5)
    np.testing.assert_allclose(image["rgb"][0, 0], [1, 1, 1], atol=1e-6)


def test_picture_is_not_mirrored(sphere_octree):
    """x to the right, y up: the sphere's colour 0.5 + 0.4 sin(3 p) seen from +z with y up."""
    camera = Camera(lens_of(41, 41), look_at((0, 0, 3.0), (0, 0, 0), up=(0, 1, 0)))
    rgb = views.render_image(sphere_octree, camera)["rgb"]
    assert rgb[20, 28, 0] > 0.6 > 0.4 > rgb[20, 12, 0]  # red grows with x
    assert rgb[12, 20, 1] > 0.6 > 0.4 > rgb[28, 20, 1]  # green grows with y


def test_only_what_was_asked_for(sphere_octree):
    assert set(views.render_image(sphere_octree, camera_at(9, 9), outputs=("opacity",))) == {"opacity"}


def test_normals_point_at_the_viewer(sphere_octree):
    camera = Camera(lens_of(41, 41), look_at((0, 0, 3.0), (0, 0, 0), up=(0, 1, 0)))
    image = views.render_image(sphere_octree, camera)
    normal = views.unit_normal(image)
    assert np.dot(normal[20, 20], [0, 0, 1]) > 0.95
    lengths = np.linalg.norm(normal, axis=-1)
    assert np.all((np.abs(lengths - 1) < 1e-4) | (lengths == 0))


def test_depth_range_is_that_of_what_is_seen(sphere_octree):
    """The near half of a sphere of radius 0.8 seen from distance 3: 2.2 to sqrt(9 - 0.64)."""
    camera = Camera(lens_of(200, 100), look_at((0, 0, 3.0), (0, 0, 0), up=(0, 1, 0)))
    near, far = views.depth_range(views.OctreeModel(sphere_octree), [camera])
    margin = 0.1 * (math.sqrt(8.36) - 2.2)
    assert 2.2 - 1.5 * margin < near < 2.2 and math.sqrt(8.36) - margin < far < math.sqrt(8.36) + 1.5 * margin


def test_depth_range_of_nothing_is_that_of_the_model(sphere_octree):
    camera = Camera(lens_of(20, 20), look_at((0, 0, 3.0), (0, 0, 9.0), up=(0, 1, 0)))
    model = views.OctreeModel(sphere_octree)
    near, far = views.depth_range(model, [camera])
    low, high = model.aabb()
    distance, reach = np.linalg.norm(camera.position - (low + high) / 2), np.linalg.norm(high - low) / 2
    assert near == pytest.approx(distance - reach) and far == pytest.approx(distance + reach)


# ---------------------------------------------------------------- files
def test_png_is_exact(tmp_path):
    from PIL import Image

    rng = np.random.default_rng(0)
    for shape in ((5, 7, 3), (5, 7), (5, 7, 4)):
        bytes_ = rng.integers(0, 256, shape).astype(np.uint8)
        pictures.write_png(tmp_path / "a.png", bytes_ / 255.0)
        assert np.array_equal(np.asarray(Image.open(tmp_path / "a.png")), bytes_)
    deep = rng.integers(0, 65536, (4, 4)).astype(np.uint16)
    pictures.write_png(tmp_path / "b.png", deep)
    assert np.array_equal(np.asarray(Image.open(tmp_path / "b.png")), deep)
    assert pictures.to_uint8(np.array([-1.0, 0.5, 2.0])).tolist() == [0, 128, 255]


def test_srgb_curve():
    # Known points of IEC 61966-2-1; the curve's two pieces meet at 0.04045.
    np.testing.assert_allclose(
        pictures.srgb_to_linear(np.array([0, 0.04045, 0.5, 1.0], np.float32)), [0, 0.0031308, 0.2140411, 1], atol=1e-6
    )
    assert pictures.srgb_to_linear(np.float32([-0.5]))[0] == -pictures.srgb_to_linear(np.float32([0.5]))[0]


def test_exr_round_trip(tmp_path):
    rng = np.random.default_rng(1)
    channels = {
        "RGB": rng.normal(size=(6, 5, 3)).astype(np.float32), "A": rng.random((6, 5)).astype(np.float32),
        "Z": rng.random((6, 5)).astype(np.float32) * 1e6, "N": rng.normal(size=(6, 5, 3)).astype(np.float32),
    }  # fmt: skip
    pictures.write_exr(tmp_path / "a.exr", channels)
    found = read_exr(tmp_path / "a.exr")  # the ground truth's own reader shares no code with the writer
    assert list(found) == ["A", "B", "G", "N.X", "N.Y", "N.Z", "R", "Z"]
    for name, want in channels.items():
        for i, suffix in enumerate({"RGB": "RGB", "N": "XYZ"}.get(name, " ")):
            key = {"RGB": suffix, "N": f"N.{suffix}"}.get(name, name)
            assert np.array_equal(found[key], want[..., i] if want.ndim == 3 else want), key


def test_video_frames_come_back(tmp_path):
    import imageio_ffmpeg

    path = tmp_path / "v.mp4"
    with pictures.open_video(path, fps=10) as video:
        for level in (0.1, 0.5, 0.9):
            video.add(np.full((33, 51, 3), level, np.float32))  # odd sizes
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    decoded = subprocess.run(decode, capture_output=True, check=True)
    assert b"50x32" in decoded.stderr and b"10 fps" in decoded.stderr and b"yuv420p" in decoded.stderr
    frames = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 32, 50, 3)
    assert len(frames) == 3
    for frame, level in zip(frames, (0.1, 0.5, 0.9), strict=True):
        assert abs(frame.mean() / 255 - level) < 0.02  # lossy, and limited-range chroma
    assert [p.name for p in tmp_path.iterdir()] == ["v.mp4"]


def test_video_frames_must_fit(tmp_path):
    with pytest.raises(InputError, match="at least 2x2 pixels, got 1x9"):
        with pictures.open_video(tmp_path / "v.mp4", fps=10) as video:
            video.add(np.zeros((9, 1, 3), np.float32))
    with pytest.raises(ValueError, match="one size"):
        with pictures.open_video(tmp_path / "v.mp4", fps=10) as video:
            video.add(np.zeros((16, 16, 3), np.float32))
            video.add(np.zeros((16, 18, 3), np.float32))
    assert list(tmp_path.iterdir()) == []


def test_failed_video_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError):
        with pictures.open_video(tmp_path / "v.mp4", fps=10) as video:
            video.add(np.zeros((16, 16, 3), np.float32))
            raise RuntimeError("renderer failed")
    assert list(tmp_path.iterdir()) == []


def test_pictures_of_numbers():
    depth, opacity = np.float32([[1.0, 3.0, 2.0]]), np.float32([[1.0, 1.0, 0.2]])
    np.testing.assert_allclose(pictures.depth_to_grey(depth, opacity, 1.0, 3.0), [[1.0, 0.1, 0.0]], atol=1e-6)
    np.testing.assert_allclose(
        pictures.normal_to_rgb(np.float32([[[0, 0, 1], [1, 0, 0]]]), np.float32([[1, 0]])), [[[0.5, 0.5, 1], [0.5] * 3]]
    )
    errors = pictures.error_map(np.zeros((1, 3, 3)), np.array([[[0.0] * 3, [0.125] * 3, [1.0] * 3]]))
    np.testing.assert_allclose(errors[0], [[0, 0, 0], [1, 0.5, 0], [1, 1, 1]], atol=1e-6)
    wide = pictures.side_by_side([np.zeros((4, 5, 3), np.float32), np.zeros((4, 6), np.float32)], gap=2)
    assert wide.shape == (4, 13, 3) and np.all(wide[:, 5:7] == 1)


# ---------------------------------------------------------------- camera paths
def write(path, document):
    path.write_text(json.dumps(document))
    return path


POSE = look_at((2, 1, 1), (0, 0, 0)).tolist()


def test_a_path_of_matrices_alone(tmp_path):
    path = write(tmp_path / "p.json", {"frames": [{"transform_matrix": POSE}]})
    (camera,) = load_cameras(path)
    assert (camera.intrinsics.width, camera.intrinsics.height) == (800, 800)
    assert math.isclose(camera.intrinsics.fx, 1111.1, rel_tol=1e-3)  # NeRF-synthetic's 40 degrees
    np.testing.assert_allclose(camera.c2w, POSE, atol=1e-12)
    (camera,) = load_cameras(path, (320, 200))
    assert (camera.intrinsics.width, camera.intrinsics.height) == (320, 200)


def test_intrinsics_are_overridden_frame_by_frame(tmp_path):
    frames = [{"transform_matrix": POSE}, {"transform_matrix": POSE, "fl_x": 50.0, "w": 60}]
    document = {"fl_x": 90.0, "w": 100, "h": 80, "cx": 49.0, "k1": 0.01, "frames": frames}
    first, second = load_cameras(write(tmp_path / "p.json", document))
    assert (first.intrinsics.fx, first.intrinsics.fy, first.intrinsics.cx, first.intrinsics.cy) == (90, 90, 49, 40)
    assert (second.intrinsics.fx, second.intrinsics.width, second.intrinsics.k1) == (50, 60, 0.01)


def test_document_round_trip(tmp_path):
    lens = Intrinsics(31, 22, 40.0, 41.0, 15.0, 11.5, k1=0.02, p2=-0.001)
    fish = Intrinsics(30, 30, 20.0, 20.0, 15.0, 15.0, k1=0.01, fisheye=True)
    cameras = [Camera(lens, np.array(POSE)), Camera(fish, look_at((0, 3, 1), (0, 0, 0)))]
    found = load_cameras(write(tmp_path / "p.json", cameras_document(cameras, ["a.png", "b.png"])))
    for a, b in zip(cameras, found, strict=True):
        assert a.intrinsics == b.intrinsics
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-12)


@pytest.mark.parametrize(
    "document, reason",
    [
        ([], "non-empty list 'frames'"),
        ({"frames": []}, "non-empty list 'frames'"),
        ({"frames": [{}]}, "frame 0: expected an object with a transform_matrix"),
        ({"frames": [3]}, "frame 0"),
        ({"frames": [{"transform_matrix": "x"}]}, "transform_matrix"),
        ({"frames": [{"transform_matrix": [[1, 2], [3, 4]]}]}, "frame 0: .*4x4"),
        ({"frames": [{"transform_matrix": [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]}]}, "rigid"),
        ({"frames": [{"transform_matrix": POSE}], "fl_x": 0}, "focal"),
        ({"frames": [{"transform_matrix": POSE}], "fl_x": "wide"}, "fl_x must be a finite number"),
        ({"frames": [{"transform_matrix": POSE}], "w": 100000, "h": 10}, "at most 16384"),
        ({"frames": [{"transform_matrix": POSE}], "w": 0, "h": 10}, "w must be|at least 1"),
    ],
)
def test_bad_paths(tmp_path, document, reason):
    with pytest.raises(InputError, match=reason) as error:
        load_cameras(write(tmp_path / "p.json", document))
    assert "p.json" in str(error.value)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (0, 0, -1)])
def test_orbit_is_found_again(up):
    center = np.array([0.3, -0.2, 0.1])
    cameras = orbit(12, center=center, radius=2.5, elevation_deg=35, intrinsics=lens_of(40, 30), up=up)
    found = describe_orbit(cameras, [center - 1, center + 1])
    np.testing.assert_allclose(found["center"], center, atol=1e-9)
    np.testing.assert_allclose(found["up"], up, atol=1e-9)
    assert math.isclose(found["radius"], 2.5) and math.isclose(found["elevation_deg"], 35)
    again = orbit_cameras(12, json.loads(json.dumps(found)), None)
    assert (again[0].intrinsics.width, again[0].intrinsics.height) == (40, 30)
    assert math.isclose(again[0].intrinsics.fx, 48.0)
    for a, b in zip(cameras, again, strict=True):
        np.testing.assert_allclose(a.c2w, b.c2w, atol=1e-9)


def test_orbit_of_forward_facing_and_outward_cameras_uses_the_box():
    ahead = [Camera(lens_of(40, 40), look_at((x, 0, 0), (x, 5, 0))) for x in (0.0, 1.0, 2.0)]
    assert describe_orbit(ahead, [[-1, 3, -1], [3, 5, 1]])["center"] == [1, 4, 0]
    outward = [Camera(lens_of(40, 40), look_at((0, 0, 0), (math.cos(a), math.sin(a), 0.1))) for a in range(6)]
    assert describe_orbit(outward, [[-1, -1, -1], [1, 1, 3]])["center"] == [0, 0, 1]


def test_cameras_on_one_side_sway_there_and_back_within_their_arc():
    full = orbit(36, center=(0, 0, 0), radius=3.0, elevation_deg=20, intrinsics=lens_of(40, 40))
    seen = [*full[1:6], full[0], *full[-5:]]  # 50 degrees to each side of the first
    found = describe_orbit(seen, [[-1, -1, -1], [1, 1, 1]])
    assert abs(found["azimuth_deg"]) < 1e-6 and 80 <= found["arc_deg"] <= 100
    path = orbit_cameras(40, found, None)
    away = np.degrees([math.acos(np.clip(c.position[:2] @ full[0].position[:2] / (3 * math.cos(math.radians(20))) ** 2, -1, 1))
                       for c in path])  # fmt: skip
    assert away.max() == pytest.approx(found["arc_deg"] / 2, abs=1e-6) and away[0] < 1e-6
    assert np.linalg.norm(path[-1].position - path[0].position) < 0.5  # a loop
    assert "arc_deg" not in describe_orbit(full, [[-1, -1, -1], [1, 1, 1]])
    above = [Camera(lens_of(40, 40), look_at((0, 0, 0), (math.cos(a), math.sin(a), 0.1))) for a in range(6)]
    assert "arc_deg" not in describe_orbit(above, [[-1, -1, -1], [1, 1, 3]])  # they look outwards


def test_default_orbit_shows_the_whole_box():
    box = np.array([[-1.0, -2.0, 0.0], [3.0, 1.0, 1.0]])
    corners = np.array([[box[i, 0], box[j, 1], box[k, 2]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    for camera in orbit_cameras(7, default_orbit(box), (200, 200)):
        pixels = camera.project(corners)
        assert np.all(pixels >= 0) and np.all(pixels <= 200)


# ---------------------------------------------------------------- the command
@pytest.fixture
def octree_file(tmp_path, sphere_octree):
    path = tmp_path / "o.safetensors"
    save_octree(path, sphere_octree, {"background": [0.0, 0.0, 0.0]})
    return path


def test_render_pictures_and_their_cameras(tmp_path, octree_file, command):
    from PIL import Image

    out = tmp_path / "out"
    aovs = "depth,opacity,normal,median_depth"
    code, text, _ = command("render", octree_file, "--orbit", 3, "--size", "24x16", "--out", out, "--aov", aovs)
    assert code == 0 and "3 views" in text
    names = {f"000{i}{aov}.png" for i in range(3) for aov in ("", "_depth", "_opacity", "_normal", "_median_depth")}
    assert {p.name for p in out.iterdir()} == names | {"cameras.json", "film.json"}
    picture = np.asarray(Image.open(out / "0000.png"))
    assert picture.shape == (16, 24, 3) and np.all(picture[0, 0] == 0)  # the background stored with the octree
    again = tmp_path / "again"
    command("render", octree_file, "--cameras", out / "cameras.json", "--out", again, "--background", "white")
    whiter = np.asarray(Image.open(again / "0000.png"))
    assert np.all(whiter[0, 0] == 255) and whiter.shape == picture.shape
    opaque = np.asarray(Image.open(out / "0000_opacity.png")) == 255
    # 255 means an opacity of at least 254.5 / 255: half a level of background at most, and its rounding
    assert opaque.any() and np.abs(picture[opaque].astype(int) - whiter[opaque]).max() <= 1


def test_render_exr_and_video(tmp_path, octree_file, command):
    code, *_ = command(
        "render", octree_file, "--orbit", 1, "--size", "16x16", "--out", tmp_path / "e", "--format", "exr",
        "--aov", "depth,opacity,normal",
    )  # fmt: skip
    assert code == 0
    found = read_exr(tmp_path / "e" / "0000.exr")
    assert set(found) == {"R", "G", "B", "A", "Z", "N.X", "N.Y", "N.Z"}
    assert found["Z"].max() > 1 and found["A"].max() == pytest.approx(1, abs=0.01)
    code, text, _ = command(
        "render", octree_file, "--orbit", 4, "--size", "32x32", "--out", tmp_path / "v.mp4", "--aov", "depth"
    )
    assert code == 0 and (tmp_path / "v.mp4").stat().st_size > 500 and (tmp_path / "v_depth.mp4").is_file()


@pytest.mark.parametrize("out", ["views", "v.mp4"])
def test_a_disk_that_takes_no_more(tmp_path, octree_file, out):
    """A limit on file size, set by the operating system as a full disk would be: one sentence, no half files."""
    limited = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (200, 200)); from nerfvol.cli import main; "
    )
    arguments = ["render", str(octree_file), "--orbit", "3", "--size", "64x64", "--out", str(tmp_path / out)]
    root = Path(views.__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", limited + f"sys.exit(main.main({arguments}))"], cwd=root, capture_output=True, text=True
    )
    assert done.returncode == 2 and done.stderr.startswith("nerfvol: error: cannot write"), done.stderr
    assert done.stderr.count("\n") == 1 and len(done.stderr) < 300 and str(tmp_path / out) in done.stderr
    assert {path.name for path in tmp_path.rglob("*")} <= {"o.safetensors", "views"}


@pytest.mark.parametrize(
    "arguments, reason",
    [
        (["--out", "x"], "or --cameras FILE.json or --orbit N"),
        (["--orbit", "2", "--cameras", "c.json", "--out", "x"], "both say where the cameras are"),
        (["--orbit", "2"], "needs --out"),
        (["--orbit", "0", "--out", "x"], "orbit: expected a number of at least 1"),
        (["--orbit", "many", "--out", "x"], "orbit: expected a whole number"),
        (["--orbit", "2", "--out", "x", "--size", "800"], "size: expected a size such as 800x600"),
        (["--orbit", "2", "--out", "x", "--aov", "albedo"], "expected names out of depth"),
        (["--orbit", "2", "--out", "x.mp4", "--format", "exr"], "not a video"),
        (["--cameras", "none.json", "--out", "x"], "no such file: none.json"),
        (["--orbit", "2", "--out", "x", "--early-stop-eps", "1"], "0 .exact. to below 1"),
        (["--orbit", "2", "--out", "x", "--threads", "-1"], "--threads"),
    ],
)
def test_bad_render_arguments(tmp_path, octree_file, command, monkeypatch, arguments, reason):
    import re

    monkeypatch.chdir(tmp_path)
    code, _, err = command("render", octree_file, *arguments)
    assert code == 2 and err.startswith("nerfvol: error: ") and err.count("\n") == 1
    assert re.search(reason, err), err


@pytest.mark.parametrize("suffix", [".mp4", ".webm"])
def test_a_video_says_which_colours_its_numbers_are(tmp_path, suffix):
    """BT.709's matrix, stated: what a player takes by itself depends on the video's size. Read back with it, colours are those
    of the frame to the rounding of luma and chroma and the codec's."""
    import imageio_ffmpeg

    colours = np.array([[200, 100, 50], [60, 120, 200], [40, 160, 60], [180, 60, 160]], np.uint8)
    with pictures.open_video(tmp_path / f"v{suffix}", fps=10) as video:
        for _ in range(3):
            video.add(colours[None].repeat(64, 0).repeat(32, 1))
    ffmpeg = [imageio_ffmpeg.get_ffmpeg_exe(), "-hide_banner", "-i", str(tmp_path / f"v{suffix}")]
    assert re.search("tv, bt709/bt709/iec61966-2-1", subprocess.run(ffmpeg, capture_output=True, text=True).stderr)
    # The matrix is stated to the reader, so that a tag alone does not pass.
    as_read = [
        "-vf",
        "scale=in_color_matrix=bt709:in_range=tv",
        "-pix_fmt",
        "rgb24",
        "-frames:v",
        "1",
        "-f",
        "rawvideo",
        "-",
    ]
    frame = np.frombuffer(subprocess.run([*ffmpeg, *as_read], capture_output=True).stdout, np.uint8).reshape(64, 128, 3)
    assert np.abs(frame[32, 16::32].astype(int) - colours).max() <= 8
