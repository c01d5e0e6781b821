"""Level sets out of files, in scenes and in pictures: a sphere that OpenVDB itself wrote."""

import os
import struct
from pathlib import Path as File
from typing import Any

import numpy as np
import pytest

from data_synth import (
    InputError,
    March,
    Path,
    RenderWarning,
    jit,
    level_sets,
    lights,
    materials,
    scene_file,
    surfaces,
    truth,
)
from data_synth.scene import Scene
from data_synth.vdb import read_level_set, read_vdb
from data_synth.vdb_write import SparseGrid, write_grids
from data_synth.volumes import open_volume, read_volume

BALL = File(__file__).parent / "files" / "ball.vdb"
"""Radius 2, centre (0.8, 2.4, 2.4), spacing 0.2, half width 1.5 of it, blosc: pyopenvdb 10.0.1."""
RADIUS, CENTRE, H = 2.0, np.array([0.8, 2.4, 2.4]), 0.2
SHRINKS = H * H / 4 / (RADIUS - 2 * H)  # what interpolation takes away (crossings.py)
RED = materials.lambert((0.8, 0.3, 0.1))


def test_a_file_of_openvdb_encloses_its_sphere():
    """Also where nothing is stored: far inside and outside."""
    solid = level_sets.level_set(0, BALL)
    p = np.random.default_rng(0).uniform(-2, 6, (20000, 3)) + CENTRE - 2
    r = np.linalg.norm(p - CENTRE, axis=-1)
    inside = level_sets.holds(solid, p)
    assert inside[r < RADIUS - SHRINKS - 1e-6].all() and not inside[r > RADIUS + 1e-6].any() and 500 < inside.sum()
    assert level_sets.holds(solid, CENTRE[None])[0]
    lo, hi = level_sets.extent_of(solid)
    assert np.all(lo >= CENTRE - RADIUS - 1e-6) and np.all(lo <= CENTRE - RADIUS + H + 1e-6)
    assert np.all(hi <= CENTRE + RADIUS + 1e-6) and np.all(hi >= CENTRE + RADIUS - H - 1e-6)


def test_it_is_placed_and_scaled():
    solid = level_sets.level_set(0, BALL, size=1.0, centre=(5.0, 0.0, -1.0))
    lo, hi = level_sets.extent_of(solid)
    assert (hi - lo).max() == pytest.approx(1.0) and (lo + hi) / 2 == pytest.approx([5.0, 0.0, -1.0])
    wrongs: list[dict[str, Any]] = [{"size": 0.0}, {"size": np.inf}, {"centre": (1, 2)}, {"grid": "none"}]
    for wrong in wrongs:
        with pytest.raises(InputError):
            level_sets.level_set(0, BALL, **wrong)


def compared(scene, other, integrator):
    camera = scene.viewpoints.camera(30, 25, 16, 16)
    return integrator.render(scene, camera, seed=3), integrator.render(other, camera, seed=3)


@pytest.mark.parametrize("integrator", [March(), Path(spp=64, jitter=False)])
def test_it_looks_like_a_sphere(integrator):
    """Colour, alpha and distance of a matt ball under a sun and over a floor, against ``surfaces.sphere``, in pixels whose ray
    comes no nearer to the rim than the interpolation's error."""
    floor = surfaces.plane(1, (0, 0, -1.2), (0, 0, 1))
    common: dict[str, Any] = {
        "materials": [RED, materials.lambert(0.6)],
        "lights": [lights.directional((0.3, -0.5, 1.0), 3.0)],
    }
    solid = level_sets.level_set(0, BALL, centre=(0, 0, 0))
    off = CENTRE - np.sum(level_sets.extent_of(level_sets.level_set(0, BALL)), axis=0) / 2  # its box is one of samples
    scene = Scene(shapes=[floor], level_sets=[solid], **common)
    scene.viewpoints = scene.viewpoints.__class__(radius=9.0, fov=45)
    sphere = Scene(shapes=[floor, surfaces.sphere(0, off, RADIUS)], viewpoints=scene.viewpoints, **common)
    a, b = compared(scene, sphere, integrator)
    assert np.array_equal(a.alpha, b.alpha)
    far = abs(a.distance - b.distance)
    met = far > 1e-9
    assert (
        20 < met.sum() < 200
        and np.median(far[met]) < 2 * SHRINKS
        and np.mean(abs(a.rgb - b.rgb)[met]) < 0.1 * b.rgb.mean()
    )
    assert np.allclose(a.rgb[~met], b.rgb[~met], atol=0.15) and np.mean(abs(a.rgb - b.rgb)[~met]) < 0.05 * b.rgb.mean()


def test_pictures_do_not_depend_on_threads_and_do_on_seeds():
    scene = Scene(
        level_sets=[level_sets.level_set(0, BALL, centre=(0, 0, 0), size=1.5)], lights=[lights.environment(1.0)]
    )
    scene.materials = [materials.dielectric(1.4)]
    camera, pictures = scene.viewpoints.camera(30, 25, 12, 12), []
    for threads, seed in ((1, 1), (2, 1), (1, 2)):
        jit.use_threads(threads)
        pictures.append(Path(spp=16).render(scene, camera, seed=seed).rgb)
    jit.use_threads(0)
    assert np.array_equal(pictures[0], pictures[1]) and not np.array_equal(pictures[0], pictures[2])


YAML = """
medium: {homogeneous: {lo: [-2, -2, -2], hi: [2, 2, 2], sigma_t: 1}}
materials: {glass: {dielectric: {ior: 1.5, medium: none}}}
shapes: [{level_set: {material: glass, file: ball.vdb, size: 2.0, centre: [0, 0, 0]}}]
lights: [sky]
"""


def test_a_scene_file_has_it_and_truth_tells_it(tmp_path):
    os.link(BALL, tmp_path / "ball.vdb")
    (tmp_path / "s.yaml").write_text(YAML)
    scene = scene_file.load(tmp_path / "s.yaml")
    (solid,) = scene.level_sets
    assert scene.shapes == [] and level_sets.holds(solid, np.zeros((1, 3)))[0]
    truth.write(scene, tmp_path / "truth.npz")
    with np.load(tmp_path / "truth.npz", allow_pickle=False) as stored:
        t = dict(stored)
    for name in ("lo", "cell", "samples"):
        assert np.array_equal(t[f"solid0_{name}"], getattr(solid, name))
    assert t["solid0_material"] == 0 and t["solid0_offsets"].shape == solid.bricks
    axes = [np.linspace(a, b, n) for a, b, n in zip(t["number_lo"], t["number_hi"], t["number"].shape, strict=True)]
    p = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    assert np.array_equal(t["number"] == -1, level_sets.holds(solid, p)) and (t["number"] == -1).any()


def test_what_is_upright_along_y_is_turned(tmp_path):
    """A solid of the file at (x, y, z) is then at (x, -z, y): over several bricks, of another size along each axis."""
    shape, lo, hi = (12, 30, 21), np.array([0.1, -1.0, 0.3]), np.array([1.2, 2.0, 2.5])
    p = np.stack(np.meshgrid(*[np.linspace(a, b, n) for a, b, n in zip(lo, hi, shape, strict=True)], indexing="ij"), -1)
    solid = level_sets.sampled(0, np.linalg.norm((p - [0.6, 0.2, 1.2]) / [0.3, 0.7, 0.5], axis=-1) - 1, lo, hi)
    turned = level_sets.upright(solid)
    points = np.random.default_rng(0).uniform(lo, hi, (4000, 3))
    inside = level_sets.holds(solid, points)
    assert 100 < inside.sum() < 3600
    x, y, z = points.T
    assert np.array_equal(level_sets.holds(turned, np.stack([x, -z, y], 1)), inside)

    os.link(BALL, tmp_path / "ball.vdb")
    made = []
    for up in ("z", "y"):
        (tmp_path / "s.yaml").write_text(YAML.replace("size: 2.0, centre: [0, 0, 0]", f"up: {up}"))
        made += scene_file.load(tmp_path / "s.yaml").level_sets
    assert made[1].lo == level_sets.upright(made[0]).lo != made[0].lo
    (tmp_path / "s.yaml").write_text(YAML.replace("size: 2.0", "up: x, size: 2.0"))
    with pytest.raises(InputError, match=r"shapes\[0\].level_set: expected up to be y or z, got x"):
        scene_file.load(tmp_path / "s.yaml")


def test_a_changed_solid_is_another_scene():
    scene = Scene(level_sets=[level_sets.level_set(0, BALL)], materials=[RED], lights=[lights.environment(1.0)])
    before = scene.fingerprint()
    scene.level_sets = [level_sets.level_set(0, BALL, size=1.0)]
    assert scene.fingerprint() != before


def test_a_level_set_is_no_density(tmp_path, command):
    """It is refused with the way to show it, whatever asks; beside a density it is left out, with a word."""
    for read in (open_volume, read_volume):
        with pytest.raises(
            InputError, match=r"grid ball is a level set: .*shapes: \[{level_set: {material: ..., file: ball.vdb}}\]"
        ):
            read(BALL)
    code, _, said = command(
        "synth", "smoke", "--volume", BALL, "--views", "1", "--size", "8x8", "--out", tmp_path / "s"
    )
    assert code == 2 and "is a level set" in said and len(said.splitlines()) == 1
    assert read_vdb(BALL).values.min() < 0  # who reads arrays gets them
    cube = np.argwhere(np.ones((4, 4, 4)))
    fog = SparseGrid("smoke", cube, np.ones(64))
    write_grids(tmp_path / "fog.vdb", [fog])
    with pytest.raises(InputError, match="expected an OpenVDB level set, its grid smoke is none"):
        level_sets.level_set(0, tmp_path / "fog.vdb")


def written(path, background, *grids):
    """Grids in a file, the last one with a background of its own."""
    write_grids(path, grids)
    data = bytearray(path.read_bytes())
    at = data.index(struct.pack("<IfII", 1, 0.0, 0, 1), data.rindex(b"ScaleTranslateMap"))
    struct.pack_into("<f", data, at + 4, background)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("grid, background, size, message", [
    ({"origin": (0.0, np.nan, 0.0)}, 1.0, None, "its origin at"),
    ({"voxel_size": (np.inf, 1.0, 1.0)}, 1.0, None, "voxel size of"),
    ({}, np.inf, None, "infinite or no numbers"), ({}, 1.0, 1.0, "a single voxel of it is inside"),
    ({"values": np.ones(27)}, 1.0, None, "encloses nothing"),
])  # fmt: skip
def test_solids_that_are_none(tmp_path, grid, background, size, message):
    """Numbers of a file that would have made a picture of nothing, and one voxel alone, which has no extent to be scaled by."""
    around = np.argwhere(np.ones((3, 3, 3))) + 3
    given = {"values": np.where((around == 4).all(axis=1), -1.0, 1.0)} | grid
    path = written(tmp_path / "b.vdb", background, SparseGrid("b", around, **given))
    with pytest.raises(InputError, match=message) as caught:
        level_sets.level_set(0, path, size=size)
    assert "b.vdb" in str(caught.value)


def test_a_temperature_below_0_is_no_level_set(tmp_path):
    """Beside a density it is left out with a word, as any grid is whose background is not 0."""
    cube = np.argwhere(np.ones((4, 4, 4)))
    cold = SparseGrid("temperature", cube, -np.ones(64), kind="unknown")
    path = written(tmp_path / "a.vdb", 20.0, SparseGrid("density", cube, np.ones(64)), cold)
    with pytest.warns(RenderWarning) as said:
        assert open_volume(path).heat is None
    assert "temperature lies on another grid than density" in str(said[0].message)
    with pytest.raises(InputError, match="grid temperature is a level set"):
        read_volume(f"{path}:temperature")


def test_damage_is_one_sentence(tmp_path):
    data, rng = bytearray(BALL.read_bytes()), np.random.default_rng(1)
    for k in range(60):
        damaged = bytearray(data)
        damaged[int(rng.integers(0, 1500 if k % 2 else len(data)))] = int(rng.integers(0, 256))
        (tmp_path / "b.vdb").write_bytes(damaged if k % 5 else damaged[: int(rng.integers(0, len(data)))])
        try:
            level_sets.level_set(0, tmp_path / "b.vdb")
        except InputError as error:
            assert "b.vdb" in str(error) and "\n" not in str(error)


def test_the_first_level_set_is_taken_or_the_one_named():
    tree, voxel_size, _ = read_level_set(BALL)
    assert tree.background == pytest.approx(1.5 * H) and voxel_size == pytest.approx([H] * 3) and len(tree.inside)
    assert read_level_set(BALL, "ball")[0].background == tree.background
