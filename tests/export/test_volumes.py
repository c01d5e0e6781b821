"""Exports of an octree as a volume, each read by a reader that shares nothing with its writer."""

import gzip
import re
import struct

import numpy as np
import pytest

from data_synth.image import srgb_to_linear
from data_synth.vdb import read_vdb
from nerfvol.errors import InputError
from nerfvol.export import export_model
from nerfvol.models import load_model
from nerfvol.octree.points import octree_density
from nerfvol.views import OctreeModel
from tests.export.shapes import BLUE, CENTER, HIGH, LOW, ORIGIN, RADIUS, RED, SIZE, ball, box

SIGMA = 4.0 * 16 / SIZE


@pytest.fixture(scope="module")
def cube():
    return OctreeModel(box())


def world(grid):
    """Positions (nx, ny, nz, 3) of a VDB grid's voxels, and whether they are active (here: above 0 in any channel)."""
    index = np.stack(np.meshgrid(*[np.arange(n) for n in grid.values.shape[:3]], indexing="ij"), -1) + grid.first
    return grid.origin + index * grid.voxel_size


def test_vdb_holds_the_vertices(tmp_path, cube):
    """Density exactly where the cube is, corners at its corners; linear colours that meet at x = 0; names and boxes."""
    size = export_model(cube, tmp_path / "a.vdb").size
    assert size == (tmp_path / "a.vdb").stat().st_size
    density, color = (read_vdb(tmp_path / "a.vdb", name) for name in ("density", "color"))
    at = world(density)
    inside = ((at > LOW - 1e-9) & (at < HIGH + 1e-9)).all(-1)
    assert inside.all() and np.allclose(at[0, 0, 0], LOW) and np.allclose(at[-1, -1, -1], HIGH)
    assert np.allclose(density.values, SIGMA, rtol=2**-11)
    red = at[..., 0] < -0.2  # between there and 0 a coarse leaf goes from red to blue
    assert np.allclose(color.values[red], srgb_to_linear(np.array(RED)), atol=2**-11)
    assert np.allclose(color.values[at[..., 0] > -1e-9], srgb_to_linear(np.array(BLUE)), atol=2**-11)
    assert density.metadata["name"] == b"density" and color.metadata["name"] == b"color"
    assert struct.unpack("<3i", density.metadata["file_bbox_min"]) == tuple(density.first)
    export_model(cube, tmp_path / "b.vdb", srgb=True, full_float=True)
    assert np.allclose(read_vdb(tmp_path / "b.vdb", "color").values[red], RED, atol=1e-6)
    assert (tmp_path / "b.vdb").stat().st_size > size


def test_vdb_interpolates_as_the_leaves_do(tmp_path):
    octree = ball()
    export_model(OctreeModel(octree), tmp_path / "a.vdb", full_float=True)
    grid = read_vdb(tmp_path / "a.vdb")
    at = world(grid)[grid.values > 0]
    inner = at[np.abs(np.linalg.norm(at - CENTER, axis=1) - RADIUS) < SIZE / 32]
    assert len(inner) > 500
    index = np.round((inner - grid.origin) / grid.voxel_size).astype(int) - grid.first
    theirs, ours = grid.values[tuple(index.T)], octree_density(octree, inner + 1e-9)
    inside = ours > 0  # a step up from the leaves' upper faces is outside of them
    assert inside.mean() > 0.8 and np.allclose(theirs[inside], ours[inside], rtol=1e-4)


def read_htg(path):
    """Leaves of a one-tree .htg: lowest corner, side, density, colour. From the format's document (VTK 9, XML 2.0)."""
    data = path.read_bytes()
    at = data.index(b'<AppendedData encoding="raw">')
    start, head, found = data.index(b"_", at) + 1, data[:at].decode(), {}
    kinds = {"Float64": "<f8", "Int64": "<i8", "UInt32": "<u4", "Bit": "u1", "Float32": "<f4", "UInt8": "u1"}
    for kind, name, offset in re.findall(r'type="(\w+)" Name="(\w+)".*?offset="(\d+)"', head):
        (n,) = struct.unpack_from("<Q", data, start + int(offset))
        found[name] = np.frombuffer(
            data, kinds[kind], offset=start + int(offset) + 8, count=n // np.dtype(kinds[kind]).itemsize
        )
    low = np.array([found[f"{a}Coordinates"][0] for a in "XYZ"])
    side = found["XCoordinates"][1] - found["XCoordinates"][0]
    counts = found["NumberOfVerticesPerDepth"]
    refined = np.concatenate([np.unpackbits(found["Descriptors"])[: sum(counts[:-1])], np.zeros(counts[-1])]).astype(
        bool
    )
    masked, corners, at, leaves = np.unpackbits(found["Mask"])[: sum(counts)].astype(bool), [low], 0, []
    for count in counts:
        below = []
        for cell in range(count):
            if refined[at + cell]:
                below += [corners[cell] + side / 2 * np.array([i & 1, i >> 1 & 1, i >> 2]) for i in range(8)]
            elif not masked[at + cell]:
                leaves.append((*corners[cell], side, at + cell))
        corners, at, side = below, at + count, side / 2
    table = np.array(leaves)
    number = table[:, 4].astype(int)
    return table[:, :3], table[:, 3], found["density"][number], found["color"].reshape(-1, 3)[number]


def test_htg_is_the_octree(tmp_path, cube):
    export_model(cube, tmp_path / "a.htg")
    low, side, density, color = read_htg(tmp_path / "a.htg")
    octree = cube.octree
    ours = np.column_stack([octree.leaf_centers() - octree.leaf_sizes()[:, None] / 2, octree.leaf_sizes()])
    theirs = np.column_stack([low, side])
    assert len(ours) == len(theirs) and np.array_equal(ours[np.lexsort(ours.T)], theirs[np.lexsort(theirs.T)])
    assert np.allclose(density, SIGMA)
    assert (color[low[:, 0] < -0.26] == np.rint(255 * np.array(RED))).all()
    assert (color[low[:, 0] >= 0] == np.rint(255 * np.array(BLUE))).all()


@pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
def test_nifti_by_nibabel(tmp_path, ending):
    nibabel = pytest.importorskip("nibabel")
    export_model(OctreeModel(ball()), tmp_path / f"a{ending}", resolution=40)
    image = nibabel.load(tmp_path / f"a{ending}")
    values = np.asarray(image.dataobj)
    at = nibabel.affines.apply_affine(image.affine, np.argwhere(values >= 0)).reshape(*values.shape, 3)
    assert np.allclose(octree_density(ball(), at.reshape(-1, 3)), values.reshape(-1), rtol=1e-4, atol=1e-3)
    assert np.allclose(image.get_qform(), image.affine)


def test_nifti_colours(tmp_path, cube):
    nibabel = pytest.importorskip("nibabel")
    export_model(cube, tmp_path / "c.nii.gz", resolution=16, quantity="color")
    image = nibabel.load(tmp_path / "c.nii.gz")
    values = np.asarray(image.dataobj)
    assert values.dtype.names == ("R", "G", "B")
    rgb = np.stack([values[c] for c in "RGB"], -1)
    x = nibabel.affines.apply_affine(image.affine, np.argwhere(rgb[..., 0] >= 0))[:, 0].reshape(rgb.shape[:3])
    assert (rgb[x < -0.26] == np.rint(255 * np.array(RED))).all() and (
        rgb[x > 0] == np.rint(255 * np.array(BLUE))
    ).all()


def test_vti(tmp_path):
    export_model(OctreeModel(ball()), tmp_path / "a.vti", resolution=24)
    data = (tmp_path / "a.vti").read_bytes()
    head, body = data.split(b'<AppendedData encoding="raw">\n_', 1)
    text = head.decode()
    numbers = lambda key: np.array(re.search(rf' {key}="([^"]*)"', text)[1].split(), float)  # noqa: E731
    shape = (numbers("WholeExtent")[1::2] + 1).astype(int)
    (n,) = struct.unpack_from("<Q", body)
    values = np.frombuffer(body, "<f4", offset=8, count=n // 4).reshape(shape, order="F")
    at = numbers("Origin") + np.argwhere(values >= 0) * numbers("Spacing")
    assert np.allclose(octree_density(ball(), at), values.reshape(-1), rtol=1e-4, atol=1e-3)


def svox_leaves(path):
    """What svox's N3Tree.load and its world-to-tree transform make of the file: corner, side, sigma, rgb of the constant
    band."""
    with np.load(path) as z:
        child, data, radius, offset = z["child"], z["data"].astype(np.float64), z["invradius3"], z["offset"]
        assert (
            z["parent_depth"].shape == (len(child), 2) and int(z["n_internal"]) == len(child) and not int(z["n_free"])
        )
        assert int(z["data_dim"]) == data.shape[-1] and str(z["data_format"]) == f"SH{(data.shape[-1] - 1) // 3}"
        packed, depth = z["parent_depth"].T
    leaves, stack = [], [(0, np.zeros(3), 0.5)]
    while stack:
        node, low, side = stack.pop()
        for i, j, k in np.ndindex(2, 2, 2):
            corner = low + side * np.array([i, j, k])
            if child[node, i, j, k]:
                below = node + child[node, i, j, k]
                assert packed[below] == 8 * node + 4 * i + 2 * j + k and depth[below] == depth[node] + 1
                stack.append((below, corner, side / 2))
            elif data[node, i, j, k, -1] > 0:
                row = data[node, i, j, k]
                leaves.append((*((corner - offset) / radius), side / radius[0], row[-1], *row[: len(row) - 1]))
    return np.array(leaves)


def test_plenoctree_as_svox_reads_it(tmp_path, cube):
    export_model(cube, tmp_path / "a.npz", "plenoctree")
    leaves, octree = svox_leaves(tmp_path / "a.npz"), cube.octree
    ours = np.column_stack([octree.leaf_centers() - octree.leaf_sizes()[:, None] / 2, octree.leaf_sizes()])
    theirs = leaves[:, :4]
    assert len(ours) == len(theirs)
    assert np.allclose(ours[np.lexsort(ours.T.round(5))], theirs[np.lexsort(theirs.T.round(5))], atol=1e-6)
    assert np.allclose(leaves[:, 4], SIGMA, rtol=2**-11)
    rgb = 1 / (1 + np.exp(-leaves[:, 5:] * 0.28209479177387814))
    assert np.allclose(rgb[leaves[:, 0] < -0.26], RED, atol=2e-3) and np.allclose(
        rgb[leaves[:, 0] >= 0], BLUE, atol=2e-3
    )


def test_plenoctree_colours_of_degree_one(tmp_path):
    """sigmoid of svox's coefficients along a direction is our colour there, to what a logit fit can: 64 directions, small
    bands."""
    octree = ball(3, degree=1)
    sh = octree.sh
    sh[:, :, 1:] = np.random.default_rng(0).normal(0, 0.05, sh[:, :, 1:].shape)
    octree.sh = sh
    export_model(OctreeModel(octree), tmp_path / "a.npz", "plenoctree")
    leaves = svox_leaves(tmp_path / "a.npz")
    places = leaves[:, :3] + leaves[:, 3:4] / 2
    d = np.array([0.6, -0.48, 0.64])
    basis = np.array(
        [0.28209479177387814, -0.4886025119029199 * d[1], 0.4886025119029199 * d[2], -0.4886025119029199 * d[0]]
    )
    leaf = octree.query(places)
    ours = 0.5 + octree.sh[octree.corners[leaf]].mean(axis=1) @ basis
    theirs = 1 / (1 + np.exp(-leaves[:, 5:].reshape(-1, 3, 4) @ basis))
    within = (ours > 0.15) & (ours < 0.85)  # beyond, some direction's colour lies outside [0, 1]
    assert within.mean() > 0.5 and np.abs(ours - theirs)[within].max() < 0.01


def test_plenoctree_comes_back(tmp_path, cube):
    export_model(cube, tmp_path / "a.npz", "plenoctree")
    again = load_model(tmp_path / "a.npz").octree
    assert np.array_equal(again.leaf_level, cube.octree.leaf_level) and np.array_equal(
        again.leaf_ijk, cube.octree.leaf_ijk
    )
    assert np.allclose(again.origin, ORIGIN, atol=1e-6) and again.size == pytest.approx(SIZE)
    assert np.allclose(octree_density(again, again.leaf_centers()), SIGMA, rtol=1e-3)
    x = again.vertex_positions()[:, 0]
    away = (x < -0.3) | (x > 0.1)  # between, a coarse leaf goes from red to blue
    wanted = np.where(again.vertex_positions()[away, :1] < 0, RED, BLUE)
    assert np.allclose(0.5 + 0.28209479177387814 * again.sh[away, :, 0], wanted, atol=3e-3)


@pytest.mark.parametrize("damage", ["loop", "format", "far", "cut", "pickle"])
def test_damaged_plenoctrees(tmp_path, cube, damage):
    export_model(cube, tmp_path / "a.npz", "plenoctree")
    with np.load(tmp_path / "a.npz") as z:
        arrays = dict(z)
    first = tuple(np.argwhere(arrays["child"] != 0)[-1])
    if damage == "loop":
        arrays["child"][first] = -first[0]
    elif damage == "far":
        arrays["child"][first] = 10**6
    elif damage == "format":
        arrays["data_format"] = np.array("SG4")
    elif damage == "pickle":
        arrays["data"] = np.array([{}], dtype=object)
    np.savez(tmp_path / "b.npz", **arrays)
    if damage == "cut":
        (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-900])
    with pytest.raises(InputError, match="b.npz"):
        load_model(tmp_path / "b.npz")


def test_levels_sizes_and_boxes(tmp_path):
    model = OctreeModel(ball())
    full = export_model(model, tmp_path / "a.vdb")
    coarse = export_model(model, tmp_path / "b.vdb", level=4)
    assert (full.level, coarse.level) == (5, 4) and coarse.size < full.size
    assert np.allclose(read_vdb(tmp_path / "b.vdb").voxel_size, SIZE / 16)
    fitting = export_model(model, tmp_path / "c.vdb", max_bytes=coarse.size)
    assert (fitting.level, fitting.size) == (4, coarse.size) and {p.name for p in tmp_path.iterdir()} == {
        "a.vdb",
        "b.vdb",
        "c.vdb",
    }
    with pytest.raises(InputError, match="--max-bytes 10: .*even at level 1"):
        export_model(model, tmp_path / "d.vdb", max_bytes=10)
    export_model(model, tmp_path / "e.vdb", crop=(-1, -1, -1, 0.3, 1, 1))
    assert world(read_vdb(tmp_path / "e.vdb"))[..., 0].max() == pytest.approx(0.3, abs=SIZE / 32)
    with pytest.raises(InputError, match=r"--crop: nothing .* reaches from -0\.\d+"):
        export_model(model, tmp_path / "f.vdb", crop=(5, 5, 5, 6, 6, 6))
    with pytest.raises(InputError, match="--level is for octrees written as"):
        export_model(model, tmp_path / "g.npz", level=3)
    with pytest.raises(InputError, match="of memory, .* --crop or --level take less"):
        export_model(model, tmp_path / "h.vdb", free=1000)


def test_gzip_without_a_time(tmp_path, cube):
    """The same model gives the same bytes."""
    for name in ("a.nii.gz", "b.nii.gz"):
        export_model(cube, tmp_path / name, resolution=8)
    assert (tmp_path / "a.nii.gz").read_bytes() == (tmp_path / "b.nii.gz").read_bytes()
    assert len(gzip.decompress((tmp_path / "a.nii.gz").read_bytes())) > 352
