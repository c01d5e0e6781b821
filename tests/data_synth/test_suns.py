"""Sets for relighting: which view has which sun, what lights.json says, and that pictures are taken under it."""

import json

import numpy as np
import pytest
from PIL import Image

from data_synth import Emission, InputError, March, Options, Scene, lights, media, phase, render_view, write_dataset
from data_synth.cli import main
from data_synth.suns import suns_of
from nerfvol.datasets.load import load_dataset
from nerfvol.medium.lighting import load_lighting

SUN = lights.directional((0.5, -0.7, 0.6), (30.0, 20.0, 10.0))


def scene(**more) -> Scene:
    medium = media.homogeneous((-1,) * 3, (1,) * 3, 2.0, 0.8, phase=phase.two_lobes(0.5, -0.2, 0.7))
    return Scene(**{"medium": medium, "lights": [SUN, lights.environment(0.3)], "exposure": 0.5} | more)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_dataset(
        scene(), tmp_path_factory.mktemp("suns"), Options(views=5, size=(6, 6), suns=2, integrator=March(beams=1))
    )


def frames(folder, split):
    return json.loads((folder / f"transforms_{split}.json").read_text())["frames"]


def test_views_take_turns_and_test_views_have_suns_of_their_own(folder):
    assert [f["light"] for f in frames(folder, "train")] == ["sun_0", "sun_1", "sun_0", "sun_1", "sun_0"]
    assert [f["light"] for f in frames(folder, "val")] == ["sun_0"]
    assert {f["light"] for f in frames(folder, "test")} == {"held_out_0"}
    assert [c.light for c in load_dataset(folder, "train").cameras] == [f["light"] for f in frames(folder, "train")]


def test_lights_are_told_as_the_trainer_reads_them(folder):
    told = load_lighting(folder / "lights.json")
    assert list(told.lights) == ["sun_0", "sun_1", "held_out_0"] and told.exposure == 0.5
    assert [(lobe.g, round(lobe.weight, 12)) for lobe in told.phase] == [(0.5, 0.7), (-0.2, 0.3)]
    for (beam,) in told.lights.values():
        assert beam.irradiance == pytest.approx((20.0,) * 3)  # white, as bright as the scene's own sun


def test_pictures_are_taken_under_their_sun(folder):
    own = scene()
    told, camera = load_lighting(folder / "lights.json"), own.viewpoints.spread(5, 6, 6, seed=0)[1]
    own.lights = [lights.directional(told.of("sun_1")[0].towards, told.of("sun_1")[0].irradiance)]
    want = render_view(own, camera, March(beams=1)).rgba8(0.5)
    assert np.array_equal(np.asarray(Image.open(folder / "train" / "r_1.png")), want)


def test_suns_are_spread_and_no_two_are_near():
    found = np.array([sun.row[7:10] for sun in suns_of(scene(), 8)])
    assert len(found) == 10 and np.abs(found.mean(0)).max() < 0.2
    cosines = found @ found.T - 2 * np.eye(10)
    assert cosines.max() < np.cos(np.radians(35))


@pytest.mark.parametrize("more, said", [
    ({"lights": [lights.environment(1.0)]}, "has no sun"), ({"medium": None}, "a scene with a medium"),
    ({"medium": media.homogeneous((-1,) * 3, (1,) * 3, phase=phase.rayleigh())}, "Henyey-Greenstein lobes"),
])  # fmt: skip
def test_scenes_without(tmp_path, more, said):
    with pytest.raises(InputError, match=said):
        write_dataset(scene(**more), tmp_path, Options(views=1, size=(2, 2), suns=2, integrator=Emission()))


@pytest.mark.parametrize("given, said", [
    (["--suns", "-1", "--out", "x"], "--suns: expected 0 to 1000"), (["--suns", "2", "--picture", "x.png"], "no --picture"),
    (["--suns", "2", "--light", "sky", "--out", "x"], "no --light"),
])  # fmt: skip
def test_command_lines(given, said, capsys):
    assert main(["cloud", *given]) == 2
    assert said in capsys.readouterr().err
