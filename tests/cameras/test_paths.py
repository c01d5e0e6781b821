"""Smooth paths, moves by name, and path files of other tools."""

import json

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at, orbit
from nerfvol.cameras.interpolate import interpolated
from nerfvol.cameras.paths import describe_orbit, load_path
from nerfvol.cameras.shots import MOVES, moving_cameras
from nerfvol.errors import InputError
from nerfvol.rotations import between, product, quaternion, rotations

LENS = Intrinsics(64, 48, 70.0, 70.0, 32.0, 24.0)
RNG = np.random.default_rng(5)


def wander(n=6):
    """Keyframes of uneven distances and turns."""
    eyes = np.cumsum(RNG.normal(0, 1, (n, 3)) * RNG.uniform(0.3, 3, (n, 1)), axis=0)
    return [Camera(LENS, look_at(eye, eye + RNG.normal(size=3))) for eye in eyes]


def poses(cameras):
    return np.stack([camera.c2w for camera in cameras])


@pytest.mark.parametrize("loop", [False, True])
def test_a_path_goes_through_its_keyframes_without_a_jump(loop):
    """Speed and turning are continuous: second differences shrink with the square of the step, a kink's only with the step."""
    keys = wander()
    fine = poses(interpolated(keys, 3001, loop))
    for key in keys:
        assert np.abs(fine - key.c2w).max(axis=(1, 2)).min() < 0.02
    assert np.allclose(fine[0], keys[0].c2w, atol=1e-9) and (loop or np.allclose(fine[-1], keys[-1].c2w, atol=1e-9))
    kinks = []
    for n in (1500, 3000):
        path = poses(interpolated(keys, n, loop))
        ends = np.concatenate([path, path[:2]]) if loop else path
        kinks.append(np.abs(np.diff(ends, 2, axis=0)).max())
    assert kinks[1] < 0.3 * kinks[0]


def test_even_keyframes_are_catmull_rom_and_shoemake():
    """Four keyframes one apart on a line turned by one angle: uniform motion between; and the midpoint of a bent row in
    closed form."""
    step = rotations([[np.cos(0.15), 0, 0, np.sin(0.15)]])[0]
    keys, turn = [], np.eye(3)
    for k in range(4):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn, (k, 0, 0)
        keys.append(Camera(LENS, pose))
        turn = turn @ step
    path = interpolated(keys, 13)
    for k, camera in enumerate(path):
        assert np.allclose(camera.position, (k / 4, 0, 0), atol=1e-12)
        assert np.allclose(
            camera.c2w[:3, :3], rotations([[np.cos(0.0375 * k), 0, 0, np.sin(0.0375 * k)]])[0], atol=1e-12
        )
    places = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [2, 1, 0.0]])
    bent = [Camera(LENS, np.column_stack([np.eye(3), place])) for place in places]
    middle = interpolated(bent, 7)[3].position
    assert np.allclose(middle, (-places[0] + 9 * places[1] + 9 * places[2] - places[3]) / 16)  # Catmull-Rom at 1/2


@pytest.mark.parametrize("axis", np.eye(3).tolist())
def test_a_camera_that_spins_never_turns_back(axis):
    """By 100 degrees a keyframe, twice around: q and -q are one rotation, and the way between is the shorter one."""
    angles = np.radians(100.0) * np.arange(8)
    turns = rotations([[np.cos(a / 2), *(np.sin(a / 2) * np.array(axis))] for a in angles])
    keys = [
        Camera(LENS, np.block([[turn, np.array([[k], [0.0], [0.0]])], [np.eye(4)[3:]]])) for k, turn in enumerate(turns)
    ]
    found = poses(interpolated(keys, 7 * 20 + 1))[:, :3, :3]
    steps = np.radians(5.0) * np.arange(len(found))
    wanted = rotations([[np.cos(a / 2), *(np.sin(a / 2) * np.array(axis))] for a in steps])
    assert np.allclose(found, wanted, atol=1e-9)


def test_uneven_keyframes_by_barry_and_goldman():
    """Halfway between the middle two of four, through their pyramid of linear interpolations at centripetal knots (1988)."""
    places = np.array([[0, 0, 0], [0.2, 0.1, 0], [2, 1, 1], [2.5, -1, 3.0]])
    keys = [Camera(LENS, np.column_stack([np.eye(3), place])) for place in places]
    t = np.concatenate([[0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(places, axis=0), axis=1)))])
    at = (t[1] + t[2]) / 2
    level = list(places)
    for width in (1, 2, 2):  # the last one between the knots of the segment
        first = 1 if width == 2 and len(level) == 2 else 0
        ends = [(t[i + first], t[i + first + (width if first == 0 else 1)]) for i in range(len(level) - 1)]
        level = [((b - at) * p + (at - a) * q) / (b - a) for (a, b), p, q in zip(ends, level, level[1:], strict=False)]
    spans = np.linspace(0, t[-1], 20001)
    path = interpolated(keys, 20001)
    nearest = path[int(np.argmin(np.abs(spans - at)))].position
    assert np.abs(nearest - level[0]).max() < 5e-4 * t[-1]


def test_lenses_sizes_and_doubled_keyframes():
    a, b = Camera(LENS, np.eye(4)), Camera(Intrinsics(32, 48, 140.0, 140.0, 16.0, 24.0), np.diag([1.0, 1, 1, 1]))
    moved = np.eye(4)
    moved[0, 3] = 1
    path = interpolated([a, a, Camera(b.intrinsics, moved)], 3)
    assert path[1].intrinsics.fx == pytest.approx(np.sqrt(70 * 280)) and path[2].intrinsics.width == 64
    assert interpolated([a, a], 3)[2].c2w.tolist() == np.eye(4).tolist() and len(interpolated([a], 2, loop=True)) == 2
    for keys, count in (([], 3), ([a], 0)):
        with pytest.raises(InputError, match="at least one keyframe and one camera"):
            interpolated(keys, count)


def test_quaternions():
    for q in RNG.normal(size=(20, 4)):
        q /= np.linalg.norm(q)
        assert np.isclose(abs(quaternion(rotations([q])[0]) @ q), 1)
    p, q = RNG.normal(size=(2, 4))
    assert np.allclose(rotations([product(p, q)])[0], rotations([p])[0] @ rotations([q])[0])
    for a, b in ((np.eye(3)[0], -np.eye(3)[0]), (np.eye(3)[2], -np.eye(3)[2]), (np.eye(3)[1], np.array([0, 0.6, 0.8]))):
        turn = between(a, b)
        assert np.allclose(turn @ a, b) and np.allclose(turn @ turn.T, np.eye(3)) and np.linalg.det(turn) > 0


@pytest.mark.parametrize("name", MOVES)
def test_moves_look_at_the_centre_and_close(name):
    center = np.array([0.5, -1.0, 2.0])
    seen = orbit(24, center=center, radius=3.0, elevation_deg=30.0, intrinsics=LENS)
    cameras = moving_cameras(name, 60, describe_orbit(seen, [center - 1, center + 1]), (80, 60), seen)
    places = np.stack([camera.position for camera in cameras])
    for camera in cameras:
        towards = (center - camera.position) / np.linalg.norm(center - camera.position)
        assert camera.forward @ towards > 1 - 1e-9 and (camera.intrinsics.width, camera.intrinsics.height) == (80, 60)
        assert 1.0 < np.linalg.norm(camera.position - center) < 6.0
    steps = np.linalg.norm(np.diff(np.concatenate([places, places[:1]]), axis=0), axis=1)
    assert steps[-1] < 1.01 * steps[:-1].max() and len(np.unique(places.round(6), axis=0)) >= 59


def test_an_ellipse_lies_where_the_cameras_stood():
    angle = 2 * np.pi * np.arange(40) / 40
    places = np.column_stack([4 * np.cos(angle), 2 * np.sin(angle), np.full(40, 1.0)])
    seen = [Camera(LENS, look_at(place, (0, 0, 0))) for place in places]
    path = moving_cameras("ellipse", 40, describe_orbit(seen, [[-1] * 3, [1] * 3]), None, seen)
    got = np.stack([camera.position for camera in path])
    assert np.allclose(np.abs(got).max(0), (4, 2, 1), rtol=0.05)


def test_an_unknown_move():
    with pytest.raises(
        InputError, match="unknown path 'zigzag': expected orbit, ellipse, spiral, lemniscate, or a file"
    ):
        moving_cameras("zigzag", 3, {}, None)


# ------------------------------------------------------------------ files of other tools
CAMERAS = [Camera(LENS, look_at((1.0 + k, -2.0, 0.5 * k), (0, 0.2, 0.1))) for k in range(3)]
FOV = float(np.degrees(2 * np.arctan(24 / 70)))


def saved(tmp_path, document, name="p.json"):
    (tmp_path / name).write_text(json.dumps(document))
    return tmp_path / name


def nerfstudio(matrices):
    entries = [{"camera_to_world": m.ravel().tolist(), "fov": FOV, "aspect": 64 / 48} for m in matrices]
    return {"camera_type": "perspective", "render_width": 64, "render_height": 48, "fps": 24, "seconds": 2.0,
            "is_cycle": True, "camera_path": entries}  # fmt: skip


def same(cameras):
    for got, wanted in zip(cameras, CAMERAS, strict=True):
        assert np.allclose(got.c2w, wanted.c2w) and got.intrinsics.fx == pytest.approx(70) == got.intrinsics.fy


def test_nerfstudio(tmp_path):
    path = load_path(saved(tmp_path, nerfstudio([c.c2w for c in CAMERAS])))
    same(path.cameras)
    assert (path.loop, path.fps, path.seconds) == (True, 24, 2.0)
    (sentence,) = path.said
    assert "dataparser_transforms.json is not beside" in sentence
    path = load_path(saved(tmp_path, nerfstudio([CAMERAS[0].c2w]) | {"crop": {"crop_scale": [1, 1, 1]}}))
    assert "a crop, which is not used" in path.said[1]


def test_nerfstudio_in_the_coordinates_of_its_loader(tmp_path):
    """x' = scale (R x + t), as nerfstudio's dataparser makes it, written down here by hand."""
    turn, shift, scale = rotations([[0.8, 0.1, -0.5, 0.3]])[0], np.array([0.3, -0.7, 1.1]), 0.4
    matrices = []
    for camera in CAMERAS:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = turn @ camera.c2w[:3, :3], scale * (turn @ camera.position + shift)
        matrices.append(matrix)
    document = {"transform": np.column_stack([turn, shift]).tolist(), "scale": scale}
    saved(tmp_path, document, "dataparser_transforms.json")
    path = saved(tmp_path, nerfstudio(matrices))
    with pytest.raises(AssertionError):
        same([Camera(LENS, m) for m in matrices])
    assert all(np.allclose(a.position, b.position) for a, b in zip(load_path(path).cameras, CAMERAS, strict=True))
    same(load_path(path).cameras)
    assert not load_path(path).said


def test_gaussian_splatting(tmp_path):
    entries = [
        {"id": i, "img_name": str(i), "width": 64, "height": 48, "position": c.position.tolist(),
         "rotation": (c.c2w[:3, :3] @ np.diag([1, -1, -1])).tolist(), "fx": 70.0, "fy": 70.0}
        for i, c in enumerate(CAMERAS)
    ]  # fmt: skip
    same(load_path(saved(tmp_path, entries)).cameras)


def test_instant_ngp(tmp_path):
    """nerf_matrix_to_ngp of its nerf_loader.h: columns 1 and 2 negated, 0.33 x + 0.5, rows (x, y, z) <- (y, z, x)."""
    entries = []
    for camera in CAMERAS:
        m = camera.c2w[:3].copy()
        m[:, 1:3] *= -1
        m[:, 3] = 0.33 * m[:, 3] + 0.5
        m = m[[1, 2, 0]]
        w, x, y, z = quaternion(m[:, :3])
        entries.append({"R": [x, y, z, w], "T": m[:, 3].tolist(), "fov": FOV, "aperture_size": 0, "scale": 1.0})
    path = load_path(saved(tmp_path, {"loop": False, "path": entries, "time": 0.0}), (64, 48))
    same(path.cameras)
    assert path.keyframes and not path.loop


EYE = np.eye(3).tolist()
SPLAT = {"rotation": EYE, "width": 8, "height": 8, "fx": 9, "fy": 9}
POSE = np.eye(4).ravel().tolist()


@pytest.mark.parametrize("document, message", [
    ([SPLAT], "frame 0: it has no 'position'"),
    ([{**SPLAT, "position": [0, 0, "a"]}], "3 finite numbers"),
    ([{**SPLAT, "position": [0, 0, 0], "width": -3}], "width must lie between"),
    ({"camera_path": [{"fov": 40}]}, "frame 0: it has no 'camera_to_world'"),
    ({"camera_path": [{"camera_to_world": [1.0] * 15, "fov": 40}]}, "4 x 4 finite numbers"),
    ({"camera_path": [{"camera_to_world": POSE, "fov": 200}]}, "between 0 and 180"),
    ({"camera_path": [{"camera_to_world": POSE}]}, "no 'fov'"),
    ({"camera_type": "fisheye", "camera_path": [{}]}, "camera_type 'fisheye' is not supported"),
    ({"path": [{"R": [0, 0, 0, 0], "T": [0, 0, 0], "fov": 40}]}, "length 0"),
    ({"path": [{"T": [0, 0, 0], "fov": 40}]}, "no 'R'"),
    ({"path": [3]}, "frame 0: expected an object"),
    ({"frames": [], "camera_path": []}, "expected a camera path"),
    ({"fps": -2, "frames": [{"transform_matrix": np.eye(4).tolist()}]}, "fps must be positive"),
    ([], "expected a camera path"),
])  # fmt: skip
def test_what_is_no_path(tmp_path, document, message):
    with pytest.raises(InputError, match=message) as caught:
        load_path(saved(tmp_path, document))
    assert "p.json" in str(caught.value)
