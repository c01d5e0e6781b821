"""A medium as a model: its file and damaged ones, what is known of the light, pictures under other lights."""

import dataclasses
import json

import numpy as np
import pytest

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.errors import InputError
from nerfvol.files.arrayfile import write_arrays
from nerfvol.medium.lighting import Beam, Lighting, Lobe, load_lighting, parse_lighting
from nerfvol.medium.model import FORMAT, MediumModel
from nerfvol.models import load_model, save_model

LIGHTS = Lighting(
    {"left": (Beam((-1.0, 0.0, 0.0), (9.0, 9.0, 9.0)),), "right": (Beam((1.0, 0.0, 0.0), (9.0, 8.0, 7.0)),)},
    (Lobe(0.2, 1.0),), 2.0,
)  # fmt: skip


def ball(n: int = 9) -> MediumModel:
    x, y, z = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    sigma = (12 * np.clip(0.9 - np.sqrt(x * x + y * y + z * z), 0, 0.5)).astype(np.float32)
    albedo = np.stack([0.9 + 0 * x, 0.6 + 0.2 * x, 0.5 + 0.2 * y], -1).astype(np.float32)
    return MediumModel(sigma, albedo, np.array([[-1.0] * 3, [1.0] * 3]), LIGHTS, {"background": [0.0, 0.0, 0.0]})


def camera(light: str | None = None, size: int = 16) -> Camera:
    lens = Intrinsics(size, size, 1.2 * size, 1.2 * size, size / 2, size / 2)
    return Camera(lens, look_at((0.0, -4.0, 0.5), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), light)


def test_a_file_holds_it_exactly(tmp_path):
    model = ball()
    save_model(tmp_path / "m.safetensors", model)
    back = load_model(tmp_path / "m.safetensors")
    assert isinstance(back, MediumModel) and back.lighting == LIGHTS and back.metadata == model.metadata
    assert np.array_equal(back.sigma_t, model.sigma_t) and np.array_equal(back.albedo, model.albedo)
    assert np.array_equal(back.render(camera("right"))["rgb"], model.render(camera("right"))["rgb"])


def test_each_side_is_lit_by_its_sun():
    """The sun to the left of the picture lights its left half; the camera's name chooses, and no name is the first."""
    model = ball()
    left, right = (model.render(camera(name))["rgb"] for name in ("left", "right"))
    assert left[:, :8].mean() > 1.5 * left[:, 8:].mean() and right[:, 8:].mean() > 1.5 * right[:, :8].mean()
    assert np.array_equal(model.render(camera())["rgb"], left)
    other = model.under(Lighting({"only": LIGHTS.lights["right"]}, LIGHTS.phase, LIGHTS.exposure))
    assert np.array_equal(other.render(camera())["rgb"], right)
    with pytest.raises(InputError, match="no light 'noon', expected one of left, right"):
        model.render(camera("noon"))


def test_a_light_stays_with_a_camera():
    seen = camera("left", 32)
    assert {c.light for c in (seen.scaled(2), seen.resized(8, 8), dataclasses.replace(seen, c2w=np.eye(4)))} == {"left"}


def test_moved_looks_the_same():
    model, shift = ball(), np.array([3.0, -2.0, 5.0])
    pose = camera("left").c2w.copy()
    pose[:3, 3] = 4.0 * pose[:3, 3] + shift
    moved = model.moved(shift, 4.0).render(Camera(camera().intrinsics, pose, "left"), outputs=("rgb", "opacity"))
    own = model.render(camera("left"), outputs=("rgb", "opacity"))
    for name, picture in own.items():
        np.testing.assert_allclose(moved[name], picture, atol=2e-5)


def test_background_shows_where_light_passes():
    drawn = ball().render(camera("left"), (0.2, 0.4, 0.6), ("rgb", "opacity", "depth"))
    corner = drawn["opacity"][0, 0]
    assert corner == 0 and np.allclose(drawn["rgb"][0, 0], (0.2, 0.4, 0.6)) and drawn["opacity"][8, 8] > 0.9
    assert 3 < drawn["depth"][8, 8] / drawn["opacity"][8, 8] < 4.2


DOCUMENT = LIGHTS.document()


@pytest.mark.parametrize("change,said", [
    (lambda d: [], "expected an object with lights"),
    (lambda d: {**d, "sky": 1}, "expected lights, phase and exposure, got 'sky'"),
    (lambda d: {**d, "lights": {}}, "at least one light"),
    (lambda d: {**d, "lights": {"a": {}}}, "expected a list of suns"),
    (lambda d: {**d, "lights": {"a": [{"towards": [0, 0, 1]}]}}, "a sun's towards and irradiance"),
    (lambda d: {**d, "lights": {"a": [{"towards": [0, 0, 0], "irradiance": [1, 1, 1]}]}}, "direction towards the sun"),
    (lambda d: {**d, "lights": {"a": [{"towards": [0, 0, 1], "irradiance": [1, -1, 1]}]}}, "three numbers from 0 on"),
    (lambda d: {**d, "lights": {"a": [{"towards": [0, float("nan"), 1], "irradiance": [1, 1, 1]}]}}, "three numbers"),
    (lambda d: {**d, "phase": [{"g": 1.0, "weight": 1.0}]}, "g within"),
    (lambda d: {**d, "phase": [{"g": 0.0, "weight": 0.5}]}, "sum to 1, got 0.5"),
    (lambda d: {**d, "exposure": 0}, "a positive exposure, got 0"),
    (lambda d: {**d, "exposure": True}, "a positive exposure"),
])  # fmt: skip
def test_lightings_that_are_none(change, said):
    with pytest.raises(InputError, match=said) as caught:
        parse_lighting(change(DOCUMENT), "sun.json")
    assert str(caught.value).startswith("sun.json")


def test_lighting_of_a_file(tmp_path):
    (tmp_path / "lights.json").write_text(json.dumps(DOCUMENT))
    assert load_lighting(tmp_path / "lights.json") == LIGHTS
    assert parse_lighting({"lights": DOCUMENT["lights"]}, "x").phase == (Lobe(0.0, 1.0),)  # isotropic, exposure 1
    towards = (
        parse_lighting({"lights": {"a": [{"towards": [0, 3, 4], "irradiance": [1, 1, 1]}]}}, "x").of("a")[0].towards
    )
    assert towards == pytest.approx((0, 0.6, 0.8))


@pytest.mark.parametrize("change,said", [
    ({"version": 9}, "version 1, it has 9"), ({"box": [[0, 0, 0], [0, 1, 1]]}, "its box"), ({"box": None}, "its box"),
    ({"lighting": None}, "its lighting"), ({"metadata": 3}, "metadata"),
    ({"albedo": np.ones((3, 3, 3, 3), np.float32) * 1.5}, "'albedo' are not within 0 and 1"),
    ({"sigma_t": np.full((3, 3, 3), np.nan, np.float32)}, "'sigma_t' are not within"),
    ({"albedo": np.ones((3, 3, 2, 3), np.float32)}, "'albedo' should be"),
])  # fmt: skip
def test_damaged_files(tmp_path, change, said):
    arrays = {"sigma_t": np.ones((3, 3, 3), np.float32), "albedo": np.ones((3, 3, 3, 3), np.float32) / 2}
    document = {"format": FORMAT, "version": 1, "box": [[0, 0, 0], [1, 1, 1]], "lighting": DOCUMENT, "metadata": {}}
    for key, value in change.items():
        (arrays if key in arrays else document)[key] = value
    write_arrays(tmp_path / "m.safetensors", arrays, document)
    with pytest.raises(InputError, match=said):
        load_model(tmp_path / "m.safetensors")


def test_values_at_points_are_those_of_vertices():
    model = ball(5)
    points = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    sigma, albedo = model.at(points)
    np.testing.assert_allclose(sigma, model.sigma_t.reshape(-1), atol=1e-6)
    np.testing.assert_allclose(albedo, model.albedo.reshape(-1, 3), atol=1e-6)
    assert not model.at(np.array([[1.01, 0, 0]]))[0].any()
