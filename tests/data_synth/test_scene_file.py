"""Scenes from YAML: every kind of object, and one sentence with file and place for whatever is wrong."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from data_synth import InputError, lights, materials, media, phase, scene_file, sggx, spongecake, surfaces
from data_synth.cli import main
from data_synth.vdb_write import write_vdb

EVERYTHING = """
name: all of it
medium: {grid: {density: [[[0, 1], [1, 0]], [[2, 1], [0, 1]]], lo: [-1, -1, -1], hi: [1, 1, 1], sigma_t: [1, 2, 3], albedo: 0.5,
  Le: 0.1, phase: {two_lobes: {g1: 0.6, g2: -0.2, mix: 0.7}}}}
media:
  fog: {homogeneous: {lo: [-2, -2, -2], hi: [2, 2, 2], sigma_t: 0.3, phase: rayleigh}}
  haze: {exponential: {lo: [0, 0, 0], hi: [1, 1, 1], height: 0.3,
    phase: {microflakes: {S: {fibre: {axis: [1, 0, 0], roughness: 0.2}}}}}}
  puff: {volume: {file: v.npz, size: 3, centre: [0, 0, 1], sigma_t: 4, phase: isotropic}}
materials:
  floor: {lambert: {albedo: 0.6, second: 0.2, square: 0.25}}
  shine: {blinn_phong: {albedo: [0.5, 0.1, 0.1], gloss: 0.2, exponent: 40}}
  glass: {dielectric: {ior: 1.5, medium: fog, priority: 2}}
  edge: {"null": {medium: none}}
  leaf: {layered: {layers: [{tau: 0.1, S: {surface: {normal: [0, 0, 1], roughness: 0.3}}, albedo: 0.9},
    {tau: 1, S: [1, 1, 1, 0, 0, 0], albedo: 0.2}]}}
shapes:
  - plane: {material: floor, point: [0, 0, -1], normal: [0, 0, 2]}
  - sphere: {material: glass, centre: [0, 0, 0], radius: 0.5}
  - box: {material: shine, lo: [1, 1, 0], hi: [2, 2, 1]}
  - mesh: {material: leaf, vertices: [[0, 0, 0], [1, 0, 0], [0, 1, 0]], faces: [[0, 1, 2]]}
lights:
  - sun
  - point: {position: [1, 2, 3], intensity: 4}
  - quad: {corner: [0, 0, 3], edge_u: [0, 1, 0], edge_v: [1, 0, 0], radiance: [1, 2, 3], back: clear}
  - environment: 0.5
  - sky: {zenith: [0.1, 0.2, 0.9], horizon: 0.5, ground: 0.1}
bounded: true
opaque_sky: true
viewpoints: {target: [0, 0, 1], radius: 5, elevation: [0, 30], fov: 35}
aabb: [[-1, -1, -1], [1, 1, 2]]
integrators: [march, path]
exposure: 0.5
"""


def load(tmp_path, text):
    (tmp_path / "s.yaml").write_text(text)
    return scene_file.load(tmp_path / "s.yaml")


def test_every_object_is_what_its_function_makes(tmp_path):
    np.savez(tmp_path / "v.npz", density=np.arange(24.0).reshape(2, 3, 4))
    s = load(tmp_path, EVERYTHING)
    rho = np.array([[[0, 1], [1, 0]], [[2, 1], [0, 1]]])
    assert np.array_equal(media.dense(s.medium), rho) and s.medium.sigma_t == (1, 2, 3)
    assert s.medium.phase[:4] == phase.two_lobes(0.6, -0.2, 0.7)[:4]
    fog, haze, puff = s.media
    assert fog.phase.kind == phase.RAYLEIGH and haze.falloff == pytest.approx(1 / 0.3)
    assert np.allclose(haze.phase.S, [sggx.fibre((1, 0, 0), 0.2)])
    assert np.allclose(puff.lo, (-0.5, -1, -0.5)) and np.allclose(puff.hi, (0.5, 1, 2.5)) and puff.max_density == 1.0
    assert np.array_equal(s.materials[2], materials.dielectric(1.5, 1, 2)) and s.materials[3][13] == materials.CLEAR
    assert np.array_equal(s.materials[4], materials.layered(0, 2))
    assert np.array_equal(s.layers[0], spongecake.layer(0.1, sggx.surface((0, 0, 1), 0.3), 0.9))
    assert np.array_equal(s.shapes[0], surfaces.plane(0, (0, 0, -1), (0, 0, 1))) and len(s.shapes) == 3
    assert s.triangles.shape == (1, 12) and s.triangles[0, 0] == 4
    assert np.array_equal(s.lights[2], lights.quad((0, 0, 3), (0, 1, 0), (1, 0, 0), (1, 2, 3), back="clear"))
    assert np.array_equal(s.lights[3], lights.environment(0.5)) and len(s.lights) == 5
    assert s.bounded and s.opaque_sky and s.exposure == 0.5 and s.integrators == ("march", "path")
    assert s.viewpoints.radius == 5 and s.aabb[1, 2] == 2


def test_a_volume_that_is_upright_along_y_is_turned(tmp_path):
    """The file's y, of 3 samples, is z then, and its z, of 4, is -y; an array and a file of blocks alike."""
    rho = np.arange(24.0, dtype=np.float32).reshape(2, 3, 4) + 1
    np.savez(tmp_path / "v.npz", density=rho)
    write_vdb(tmp_path / "v.vdb", rho, (1.0,) * 3, half=False)
    for name in ("v.npz", "v.vdb"):
        puff = load(
            tmp_path, f"medium: {{volume: {{file: {name}, size: 3, centre: [0, 0, 1], up: y}}}}\nlights: [sun]"
        ).medium
        dense = media.dense(puff)
        for x, y, z in np.ndindex(rho.shape):
            assert dense[x, 3 - z, y] == rho[x, y, z] / np.float32(24)
        assert np.allclose(puff.lo, (-0.5, -1.5, 0)) and np.allclose(puff.hi, (0.5, 1.5, 2))
    with pytest.raises(InputError, match=r"medium.volume: expected up to be y or z, got up"):
        load(tmp_path, "medium: {volume: {file: v.npz, up: up}}")


def test_the_example_is_a_scene():
    scene = scene_file.load(Path(__file__).parents[2] / "examples" / "scene.yaml")
    assert len(scene.media) == 1 and len(scene.lights) == 2 and scene.world(4).ambient == 0


@pytest.mark.parametrize("text, message", [
    ("lights: [sun]\nlights: [sky]", "key lights a second time in line 2"),
    ("lights: [sun]\nmaterials: {a: {lambert: 0.5}, a: {lambert: 0.2}}", "key a a second time"),
    ("a: &x [1]\nlights: *x", "an alias"),
    ("lights: !!python/object/apply:os.system [ls]", "expected YAML"),
    ("lights: [", "expected YAML"),
    ("- 1", "expected names and values"),
    ("lihgts: [sun]", "did you mean lights?"),
    ("lights: sun", "lights: expected a list"),
    ("lights: [{pint: {position: [0, 0, 0], intensity: 1}}]", r"lights\[0\].*did you mean point?"),
    ("lights: [{point: {positoin: [0, 0, 0], intensity: 1}}]", "did you mean position?"),
    ("lights: [{point: {position: [0, 0], intensity: 1}}]", "position: expected three finite numbers"),
    ("lights: [{point: {position: [0, 0, .nan], intensity: 1}}]", "position: expected three finite numbers"),
    ("lights: [{point: {position: [0, 0, a], intensity: 1}}]", "expected numbers"),
    ("lights: [{point: {position: [0, 0, 0]}}]", "expected intensity as well"),
    ("lights: [{directional: {towards: [0, 0, 0], irradiance: 1}}]", "expected a direction"),
    ("lights: [sin]", "did you mean sun?"),
    ("medium: {homogeneous: {lo: [0, 0, 0], hi: [0, 1, 1]}}", "lo < hi"),
    ("medium: {homogeneous: {lo: [0, 0, 0], hi: [1, 1, 1], albedo: 2}}", "albedo"),
    ("medium: {homogeneous: {lo: [0, 0, 0], hi: [1, 1, 1], phase: {henyey_greenstein: 1}}}", r"in \(-1, 1\)"),
    ("medium: {grid: {density: [[1, 2], [3]], lo: [0, 0, 0], hi: [1, 1, 1]}}", "medium.grid"),
    ("medium: {volume: {file: no.vdb}}", "no such file"),
    ("shapes: [{sphere: {material: gold, centre: [0, 0, 0], radius: 1}}]", "expected one of none, got 'gold'"),
    ("materials: {g: {dielectric: {ior: 1.5, medium: fig}}}\nmedia: {fog: {homogeneous: {lo: [0, 0, 0], hi: [1, 1, 1]}}}",
     "did you mean fog?"),
    ("integrators: [pat]", "integrators: expected a list of"),
    ("exposure: -1", "exposure: expected a positive number"),
    ("bounded: 1", "bounded: expected true or false"),
    ("aabb: [[0, 0, 0], [1, 1]]", "aabb: expected two corners"),
    ("viewpoints: {radios: 4}", "did you mean radius?"),
    ("viewpoints: {radius: -4}", "radius"),
    ("\x00", "expected YAML"),
])  # fmt: skip
def test_bad_files_are_one_sentence(tmp_path, capsys, text, message):
    (tmp_path / "s.yaml").write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        scene_file.load(tmp_path / "s.yaml")
    assert str(caught.value).startswith(str(tmp_path / "s.yaml")) and "\n" not in str(caught.value)
    assert main([str(tmp_path / "s.yaml"), "--out", str(tmp_path / "o")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_a_file_of_letters_and_a_missing_one(tmp_path):
    (tmp_path / "s.yaml").write_bytes(b"\xff\xfe\x00a")
    with pytest.raises(InputError, match="UTF-8"):
        scene_file.load(tmp_path / "s.yaml")
    with pytest.raises(InputError, match="cannot be read"):
        scene_file.load(tmp_path / "none.yaml")


def test_kinds_are_all_functions_that_make_rows():
    """A light, shape or material that data_synth gets must be a kind here as well."""
    for module, what in (
        (lights, "light"),
        (surfaces, "shape"),
        (materials, "material"),
        (media, "medium"),
        (phase, "phase"),
    ):
        made = {
            name for name, f in vars(module).items()
            if callable(f) and getattr(f, "__module__", "") == module.__name__ and not name.startswith("_")
            and f.__annotations__.get("return") in ("np.ndarray", "Medium", "Phase")
        }  # fmt: skip
        assert made - {"geometry", "dense", "dense_of", "from_function", "procedural"} <= set(scene_file.KINDS[what]), (
            what
        )
    assert yaml.safe_load(EVERYTHING)
