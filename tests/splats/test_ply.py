"""PLY files of Gaussians and points: exact both ways, read from any writer, and nothing in one does more than be refused."""

import struct

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from nerfvol.errors import InputError
from nerfvol.splats.ply import is_splat_ply, load_ply, save_ply
from nerfvol.splats.points import OPAQUE, PointCloud, read_points, spacing, splats_of_points
from nerfvol.splats.splats import Splats

SETTINGS = settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)
COLUMNS = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
TAIL = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def make_splats(n=23, degree=1, mode="mip", seed=0, origin=(0.0, 0.0, 0.0)):
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(size=(n, 3)).astype(np.float32), log_scales=rng.normal(-3, 1, (n, 3)).astype(np.float32),
        quats=rng.normal(size=(n, 4)).astype(np.float32), logits=rng.normal(size=n).astype(np.float32),
        sh=rng.normal(size=(n, 3, (degree + 1) ** 2)).astype(np.float32), origin=np.array(origin), mode=mode,
    )  # fmt: skip


def plain_read(path):
    """A reader that shares nothing with the package's: header by hand, rows by struct. Returns comments and columns."""
    data = path.read_bytes()
    head, body = data.split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    assert lines[0] == "ply" and lines[1] == "format binary_little_endian 1.0"
    names = [line.split()[2] for line in lines if line.startswith("property float ")]
    n = next(int(line.split()[2]) for line in lines if line.startswith("element vertex "))
    assert len(body) == 4 * n * len(names)
    rows = [struct.unpack_from(f"<{len(names)}f", body, 4 * i * len(names)) for i in range(n)]
    comments = [line[8:] for line in lines if line.startswith("comment ")]
    return comments, {name: np.array([row[k] for row in rows], np.float32) for k, name in enumerate(names)}


def write_table(path, columns, comments=(), kind="binary_little_endian", types=None, before="", after=""):
    """A PLY file of numpy columns in their own order and types."""
    types = types or {}
    n = len(next(iter(columns.values())))
    names = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int", "u2": "ushort"}
    typed = {name: np.asarray(a).astype(types.get(name, "f4")) for name, a in columns.items()}
    head = ["ply", f"format {kind} 1.0", *(f"comment {c}" for c in comments)]
    head += [*before.splitlines(), f"element vertex {n}"]
    head += [f"property {names[a.dtype.str[1:]]} {name}" for name, a in typed.items()] + after.splitlines()
    if kind == "ascii":
        body = "".join(" ".join(repr(a[i].item()) for a in typed.values()) + "\n" for i in range(n)).encode()
    else:
        order = "<" if kind == "binary_little_endian" else ">"
        table = np.zeros(n, [(name, order + a.dtype.str[1:]) for name, a in typed.items()])
        for name, a in typed.items():
            table[name] = a
        body = table.tobytes()
    path.write_bytes("\n".join([*head, "end_header", ""]).encode() + body)
    return path


def columns_of(splats):
    rest = splats.sh[:, :, 1:].reshape(splats.n, -1)
    names = COLUMNS + [f"f_rest_{k}" for k in range(rest.shape[1])] + TAIL
    places, shapes = [splats.means, np.zeros((splats.n, 3))], [splats.logits[:, None], splats.log_scales, splats.quats]
    arrays = np.concatenate([*places, splats.sh[:, :, 0], rest, *shapes], axis=1)
    return dict(zip(names, arrays.astype(np.float32).T, strict=True))


def same(a, b):
    for name in ("means", "log_scales", "quats", "logits", "sh"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("mode", ["mip", "plain"])
def test_a_file_read_and_written_again_has_the_same_bytes(tmp_path, degree, mode):
    splats = make_splats(degree=degree, mode=mode, origin=(3.0, -2.0, 1e-3))
    size = save_ply(tmp_path / "a.ply", splats)
    loaded = load_ply(tmp_path / "a.ply")
    save_ply(tmp_path / "b.ply", loaded)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    assert size == (tmp_path / "a.ply").stat().st_size
    assert loaded.mode == mode and loaded.sh_degree == degree and not loaded.origin.any()
    np.testing.assert_array_equal(loaded.means, (splats.means.astype(np.float64) + splats.origin).astype(np.float32))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_another_reader_finds_every_column_where_viewers_look_for_it(tmp_path, degree):
    splats = make_splats(degree=degree)
    save_ply(tmp_path / "a.ply", splats)
    comments, columns = plain_read(tmp_path / "a.ply")
    assert comments == ["SplatRenderMode: mip"]
    k = (degree + 1) ** 2
    assert list(columns) == COLUMNS + [f"f_rest_{j}" for j in range(3 * (k - 1))] + TAIL
    for channel in range(3):
        np.testing.assert_array_equal(columns[f"f_dc_{channel}"], splats.sh[:, channel, 0])
        for j in range(1, k):  # all of red, then green, then blue
            np.testing.assert_array_equal(columns[f"f_rest_{channel * (k - 1) + j - 1}"], splats.sh[:, channel, j])
        np.testing.assert_array_equal(columns[f"scale_{channel}"], splats.log_scales[:, channel])
    np.testing.assert_array_equal(columns["rot_0"], splats.quats[:, 0])
    np.testing.assert_array_equal(columns["opacity"], splats.logits)
    assert not columns["nx"].any()


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_any_order_of_columns_and_bytes(tmp_path, kind):
    splats = make_splats(degree=2)
    columns = columns_of(splats)
    names = list(columns)
    np.random.default_rng(1).shuffle(names)
    shuffled = {name: columns[name] for name in names} | {"extra": np.arange(splats.n)}
    path = write_table(tmp_path / "a.ply", shuffled, kind=kind, types={"x": "f8", "extra": "i4"})
    same(load_ply(path), splats)
    assert is_splat_ply(path)


@pytest.mark.parametrize("comment,mode", [
    ("SplatRenderMode: mip", "mip"), ("SplatRenderMode: default", "plain"), ("splatrendermode:MIP", "mip"),
    ("antialiased 1", "mip"), ("antialiased 0", "plain"), ("Generated by something", None),
])  # fmt: skip
def test_the_mode_that_comments_state(tmp_path, comment, mode):
    path = write_table(tmp_path / "a.ply", columns_of(make_splats()), comments=["made today", comment])
    assert load_ply(path, mode="mip").mode == (mode or "mip")
    assert load_ply(path).mode == (mode or "plain")


def test_infinite_scales_and_opacities_of_other_writers_are_bounded(tmp_path):
    columns = columns_of(make_splats())
    columns["scale_2"][3] = -np.inf
    columns["opacity"][4:6] = np.inf, -np.inf
    splats = load_ply(write_table(tmp_path / "a.ply", columns))
    assert splats.log_scales[3, 2] == -40 and splats.logits[4] == 80 and splats.logits[5] == -80


def damaged(name, value):
    def change(columns):
        columns[name][7] = value

    return change


def zero_rotation(columns):
    for k in range(4):
        columns[f"rot_{k}"][7] = 0


@pytest.mark.parametrize("change,words", [
    (damaged("x", np.nan), "position of vertex 7"), (damaged("y", np.inf), "position of vertex 7"),
    (damaged("f_dc_1", np.nan), "colour of vertex 7"), (damaged("f_rest_5", -np.inf), "colour of vertex 7"),
    (damaged("rot_2", np.nan), "rotation of vertex 7"), (zero_rotation, "vertex 7 is a quaternion of length 0"),
    (damaged("opacity", np.nan), "opacity of vertex 7"), (damaged("scale_0", np.nan), "scale of vertex 7"),
    (damaged("scale_0", np.inf), "scale of vertex 7"),
    (lambda c: c.pop("rot_3"), "no property 'rot_3'"), (lambda c: c.pop("scale_0"), "points, not Gaussians"),
    (lambda c: c.pop("f_rest_3"), "8 columns f_rest"), (lambda c: c.update(f_rest_77=c.pop("f_rest_3")), "'f_rest_3'"),
])  # fmt: skip
def test_values_and_columns_that_cannot_be_used(tmp_path, change, words):
    columns = columns_of(make_splats())
    change(columns)
    with pytest.raises(InputError, match=words) as caught:
        load_ply(write_table(tmp_path / "bad.ply", columns))
    assert "bad.ply" in str(caught.value) and "\n" not in str(caught.value)


HEADER = "ply\nformat binary_little_endian 1.0\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize("text,words", [
    ("", "does not start"), ("plyx\n", "does not start"), ("ply\nformat ascii 1.0\n", "no end"),
    (HEADER + "comment " + "x" * 70_000 + "\nend_header\n", "no end within 65536"),
    (HEADER + "element vertex 1000000000\n" + XYZ + "end_header\n", "declares 1000000000 vertices"),
    ("ply\nformat ascii 1.0\nelement vertex 1000000000\n" + XYZ + "end_header\n1 2 3\n", "declares 1000000000 vertices"),
    (HEADER + "element vertex 99999999999999999999\n" + XYZ + "end_header\n", "whole number"),
    (HEADER + "element vertex -1\n" + XYZ + "end_header\n", "whole number"),
    (HEADER + "element vertex 1\nproperty list uchar int x\nend_header\n", "list"),
    (HEADER + "element vertex 0\nproperty quad x\nend_header\n", "a type and a name"),
    (HEADER + "element vertex 0\n" + XYZ + "property float x\nend_header\n", "twice"),
    (HEADER + "element vertex 0\n" + "".join(f"property float p{i}\n" for i in range(600)) + "end_header\n", "more than 512"),
    ("ply\nelement vertex 0\n" + XYZ + "end_header\n", "before it states the format"),
    ("ply\nformat morse 1.0\nelement vertex 0\nend_header\n", "not understood"),
    (HEADER + "element face 3\nproperty list uchar int i\nelement vertex 0\n" + XYZ + "end_header\n", "before its vertices"),
    (HEADER + "element face 3\nproperty list uchar int i\nend_header\n", "no vertices"),
    (HEADER + "end_header", "does not end"), (HEADER + "who knows\nend_header\n", "not understood"),
])  # fmt: skip
def test_headers_that_cannot_be_used(tmp_path, text, words):
    (tmp_path / "bad.ply").write_bytes(text.encode())
    for read in (load_ply, read_points):
        with pytest.raises(InputError, match=words) as caught:
            read(tmp_path / "bad.ply")
        assert "bad.ply" in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("comment", ["SplatRenderMode: soft", "antialiased 2"])
def test_a_mode_that_nobody_knows_is_refused(tmp_path, comment):
    path = write_table(tmp_path / "a.ply", columns_of(make_splats()), comments=[comment])
    with pytest.raises(InputError, match="a.ply is not a usable PLY file: its .* expected"):
        load_ply(path)


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    splats = make_splats()
    splats.logits[2] = np.nan
    with pytest.raises(InputError, match="cannot write .*a.ply: "):
        save_ply(tmp_path / "a.ply", splats)
    with pytest.raises(InputError, match="too large for the format"):
        save_ply(tmp_path / "a.ply", make_splats(origin=(1e39, 0, 0)))
    with pytest.raises(InputError, match="cannot write .*its folder does not exist"):
        save_ply(tmp_path / "none" / "a.ply", make_splats())
    assert not list(tmp_path.iterdir())
    assert save_ply(tmp_path / "b.ply", make_splats(n=0)) and load_ply(tmp_path / "b.ply").n == 0


def test_files_that_are_not_there(tmp_path):
    for path, words in ((tmp_path / "none.ply", "no such"), (tmp_path, "folder")):
        with pytest.raises(InputError, match=words):
            load_ply(path)


@SETTINGS
@given(data=st.data())
def test_any_damage_is_refused_in_a_sentence_or_read(tmp_path, data):
    kind = data.draw(st.sampled_from(["binary_little_endian", "ascii"]))
    path = write_table(tmp_path / "f.ply", columns_of(make_splats(n=5)), comments=["SplatRenderMode: mip"], kind=kind)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        what = data.draw(st.sampled_from(["set", "cut", "drop", "repeat"]))
        if what == "set":
            content[at] = data.draw(st.integers(0, 255))
        elif what == "cut":
            content = content[: at + 1]
        elif what == "drop":
            del content[at : at + data.draw(st.integers(1, 40))]
            content = content or bytearray(b"p")
        else:
            content[at:at] = content[at : at + data.draw(st.integers(1, 40))]
    path.write_bytes(bytes(content))
    for read in (load_ply, read_points):
        try:
            found = read(path)
        except InputError as error:
            assert "f.ply" in str(error) and "\n" not in str(error)
        else:
            if isinstance(found, Splats):
                found.validate()
            else:
                assert np.isfinite(found.positions).all()


# ------------------------------------------------------------------ points
@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_points_of_any_writer(tmp_path, kind):
    rng = np.random.default_rng(0)
    xyz, rgb, normals = rng.normal(size=(9, 3)), rng.integers(0, 256, (9, 3)), rng.normal(size=(9, 3))
    columns = dict(zip(("x", "y", "z"), xyz.T, strict=True)) | dict(zip(("nx", "ny", "nz"), normals.T, strict=True))
    columns |= dict(zip(("red", "green", "blue"), rgb.T, strict=True)) | {"quality": np.arange(9)}
    types = dict.fromkeys("xyz", "f8") | dict.fromkeys(("red", "green", "blue"), "u1") | {"quality": "i4"}
    after = "element face 0\nproperty list uchar int vertex_indices"
    cloud = read_points(write_table(tmp_path / "p.ply", columns, kind=kind, types=types, after=after))
    np.testing.assert_array_equal(cloud.positions, xyz)
    np.testing.assert_allclose(cloud.colours, rgb / 255, atol=1e-7)
    np.testing.assert_allclose(cloud.normals, normals / np.linalg.norm(normals, axis=1, keepdims=True), atol=1e-6)
    assert not is_splat_ply(tmp_path / "p.ply")


def test_points_without_colours_are_grey_and_zero_normals_are_none(tmp_path):
    columns = {name: np.arange(4.0) for name in "xyz"} | {name: np.zeros(4) for name in ("nx", "ny", "nz")}
    cloud = read_points(write_table(tmp_path / "p.ply", columns))
    assert cloud.normals is None and (cloud.colours == 0.5).all()
    columns |= dict(zip(("r", "g", "b"), ([0.0, 0.25, 1.0, 2.0], [np.nan] * 4, [1.0] * 4), strict=True))
    cloud = read_points(write_table(tmp_path / "p.ply", columns))
    np.testing.assert_array_equal(cloud.colours[:, 0], np.float32([0, 0.25, 1, 1]))
    np.testing.assert_array_equal(cloud.colours[:, 1], 0.5)
    columns = {"x": np.zeros(3), "y": np.array([0, np.nan, 0]), "z": np.zeros(3)}
    with pytest.raises(InputError, match="position of point 1"):
        read_points(write_table(tmp_path / "p.ply", columns))
    with pytest.raises(InputError, match="no property 'z'"):
        read_points(write_table(tmp_path / "p.ply", {"x": [0.0], "y": [0.0]}))


def grid(n=7, step=0.25):
    return step * np.stack(np.meshgrid(np.arange(n), np.arange(n), [0.0], indexing="ij"), -1).reshape(-1, 3)


def test_points_become_gaussians_as_wide_as_they_are_apart():
    normal = np.array([0.3, -0.5, -0.8])
    normal /= np.linalg.norm(normal)
    places = grid()
    cloud = PointCloud(
        places, np.full((49, 3), [0.2, 0.5, 0.9], np.float32), np.tile(normal, (49, 1)).astype(np.float32)
    )
    middle = 24  # its 8 neighbours: four at 1 step, four at sqrt(2)
    splats = splats_of_points(cloud, scale=1.0)
    splats.validate()
    np.testing.assert_allclose(np.exp(splats.log_scales[middle, :2]), 0.25 * 1.5**0.5, rtol=1e-5)
    np.testing.assert_allclose(splats.means + splats.origin, places, atol=1e-6)
    w, x, y, z = splats.quats[middle].astype(float)
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])  # where the z axis goes
    np.testing.assert_allclose(abs(axis @ normal), 1, atol=1e-6)
    np.testing.assert_allclose(0.5 + splats.sh[middle, :, 0] * 0.28209479, [0.2, 0.5, 0.9], atol=1e-6)
    assert splats.log_scales[middle, 2] < splats.log_scales[middle, 0] - 6  # a disc
    np.testing.assert_allclose(1 / (1 + np.exp(-splats.logits)), OPAQUE, rtol=1e-6)
    balls = splats_of_points(PointCloud(cloud.positions, cloud.colours))
    assert np.ptp(balls.log_scales, axis=1).max() == 0 and balls.mode == "mip"


def test_points_at_one_place_and_alone():
    with pytest.raises(InputError, match="all at one place"):
        splats_of_points(PointCloud(np.zeros((5, 3)), np.zeros((5, 3), np.float32)))
    with pytest.raises(InputError, match="without points"):
        splats_of_points(PointCloud.empty())
    np.testing.assert_allclose(spacing([[0, 0, 0], [3, 4, 0]], 3), 5)
    assert np.isnan(spacing([[0, 0, 0]], 3)).all()
    twice = np.concatenate([grid(4), grid(4)[:9], np.tile(grid(4)[:1], (9, 1))])
    splats_of_points(PointCloud(twice, np.zeros((len(twice), 3), np.float32))).validate()
