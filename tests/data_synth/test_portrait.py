"""Portraits: a filmic curve, framing by the alpha, exposure by the picture, and denoising that is never truth."""

import builtins
import sys

import numpy as np
import pytest

from data_synth import InputError, Path, Viewpoints, cli, lights, materials, media, scenes, surfaces
from data_synth.cli import main
from data_synth.image import Picture
from data_synth.portrait import MARGIN, denoised, exposure_for, film, framed, portrait
from data_synth.scene import Scene


def test_the_film_is_monotone_and_clips_nothing_abruptly():
    x = np.concatenate([[-1.0, 0.0], np.logspace(-4, 4, 400)])
    y = film(x)
    assert y[0] == y[1] == 0.0 and y.max() <= 1.0 and (np.diff(y) >= 0).all()
    assert y[np.searchsorted(x, 1.5)] < 0.95  # bright clouds keep a shoulder where a clipped curve has none


def ball(centre, radius=0.4):
    lo, hi = np.subtract(centre, radius), np.add(centre, radius)
    return Scene(
        medium=media.homogeneous(lo, hi, 40.0, 0.5), lights=[lights.environment(1.0)], viewpoints=Viewpoints(radius=6.0)
    )


@pytest.mark.parametrize("centre", [(0, 0, 0), (0.9, -0.7, 0.8), (-1.0, 0.3, -0.9)])
@pytest.mark.parametrize("size", [(96, 64), (48, 96)])
def test_framing_puts_what_is_seen_in_the_middle_and_fills_the_picture(centre, size):
    scene = ball(centre)
    camera = scene.viewpoints.camera(-55, 20, *size)
    better = framed(camera, Path(spp=4).render(scene, camera).alpha)
    assert np.array_equal(better.c2w[:3, 3], camera.c2w[:3, 3])
    seen = Path(spp=8).render(scene, better).alpha > 0.1
    free = []
    for axis, n in ((1, size[1]), (0, size[0])):
        at = np.flatnonzero(seen.any(axis=axis))
        low, high = at[0] / n, 1 - (at[-1] + 1) / n
        # the glance knows edges to a pixel of its own, at a scale of focal to focal; turning shears by second order
        slack = 1.5 * better.focal / camera.focal / n
        assert abs(low - high) < 2 * slack + 0.02
        free.append(min(low, high))
        assert min(low, high) > MARGIN - slack - 0.02
    assert min(free) < MARGIN + slack + 0.02


def test_specks_do_not_count():
    """One pixel far away from a square does not change the frame."""
    camera, alpha = Viewpoints().camera(0, 10, 64, 64), np.zeros((64, 64))
    alpha[20:40, 24:44] = 1.0
    clean = framed(camera, alpha)
    alpha[60, 2] = 0.5
    assert np.allclose(framed(camera, alpha).c2w, clean.c2w) and framed(camera, alpha).focal == clean.focal


def test_an_empty_picture_stays_as_it_is():
    camera = Viewpoints().camera(0, 10, 8, 8)
    assert framed(camera, np.zeros((8, 8))) is camera
    assert exposure_for(Picture(np.zeros((4, 4, 3)), np.zeros((4, 4)), np.zeros((4, 4)))) == 1.0


@pytest.mark.parametrize("bright", [1e-3, 1.0, 50.0])
def test_exposure_does_not_depend_on_how_bright_the_lamp_is(bright):
    """A picture and one of a thousand times the light look the same."""
    scene = ball((0, 0, 0))
    camera = scene.viewpoints.camera(-55, 20, 24, 24)

    def shown(factor):
        scene.lights = [lights.environment(factor)]
        return portrait(lambda view: Path(spp=16).render(scene, view, seed=1), camera)

    assert np.abs(shown(bright).astype(int) - shown(0.2)).max() <= 1


def test_denoising_comes_nearer_to_the_truth_and_drops_the_variance():
    pytest.importorskip("pyoidn", reason="the extra 'denoise' is not installed")
    scene = scenes.cloud(resolution=24)
    camera = scene.viewpoints.camera(-55, 22, 48, 48)
    noisy, truth = Path(spp=4).render(scene, camera), Path(spp=2000).render(scene, camera, seed=9)
    clean = denoised(noisy)
    error = [np.square(p.rgb - truth.rgb).mean() for p in (clean, noisy)]
    assert error[0] < 0.5 * error[1]
    assert clean.variance is None
    assert np.square(clean.alpha - truth.alpha).mean() < np.square(noisy.alpha - truth.alpha).mean()


def test_without_the_extra_it_is_one_sentence(monkeypatch, tmp_path, capsys):
    real = builtins.__import__

    def refuse(name, *args, **kwargs):
        if name == "pyoidn":
            raise ImportError("No module named 'pyoidn'")
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)
    monkeypatch.delitem(sys.modules, "pyoidn", raising=False)
    with pytest.raises(InputError, match=r"nerfvol\[denoise\]"):
        denoised(Picture(np.zeros((4, 4, 3)), np.zeros((4, 4)), np.zeros((4, 4))))


def test_data_sets_are_never_denoised(tmp_path, capsys):
    assert main(["slab", "--denoise", "--out", str(tmp_path / "d")]) == 2
    assert "--picture" in capsys.readouterr().err
    assert not (tmp_path / "d").exists()


def test_a_portrait_is_seen_from_where_one_says(monkeypatch, tmp_path, capsys):
    seen = []

    def no_picture(render, camera, *rest):
        seen.append(camera.c2w[:3, 3])
        return np.zeros((8, 8, 3), np.uint8)

    monkeypatch.setattr(cli, "portrait", no_picture)
    command = ["slab", "--size", "8x8", "--picture", str(tmp_path / "a.png")]
    assert main(command) == main([*command, "--from", "20,40"]) == main([*command, "--from=-55,27.5"]) == 0
    az, el = np.radians(20), np.radians(40)
    assert seen[1] == pytest.approx(4.2 * np.array([np.cos(az) * np.cos(el), np.sin(az) * np.cos(el), np.sin(el)]))
    assert seen[0] == pytest.approx(seen[2])
    capsys.readouterr()
    for place in ("x", "1,2,3", "0,90", "nan,3", "400,0", ""):
        assert main([*command, f"--from={place}"]) == 2
        assert "--from: expected azimuth and elevation" in capsys.readouterr().err
    assert main(["slab", "--out", str(tmp_path / "d"), "--from", "20,40"]) == 2
    assert "--from: expected --picture" in capsys.readouterr().err


def last_camera(scene, camera):
    """The camera of the portrait itself, after the glance."""
    views = []
    portrait(lambda view: (views.append(view), Path(spp=4).render(scene, view, seed=1))[1], camera)
    return views[-1]


def test_what_the_camera_cuts_off_is_framed_whole():
    scene = ball((0, 0, 0), 0.9)
    camera = Viewpoints(radius=6.0, fov=16.0).camera(-55, 20, 48, 48)
    assert Path(spp=4).render(scene, camera).alpha[:, 0].max() > 0.9
    alpha = Path(spp=4).render(scene, last_camera(scene, camera)).alpha
    assert max(edge.max() for edge in (alpha[0], alpha[-1], alpha[:, 0], alpha[:, -1])) == 0.0 < alpha.max()


def test_what_has_no_edges_is_framed_as_the_camera_sees_it():
    floor = Scene(
        shapes=[surfaces.plane(0, (0, 0, -1), (0, 0, 1))],
        materials=[materials.lambert(0.5)],
        lights=[lights.environment(1.0)],
    )
    camera = Viewpoints(radius=4.0, fov=30.0).camera(-55, 70, 32, 32)
    found, wanted = last_camera(floor, camera), framed(camera, np.ones((8, 8)))
    assert found.focal == pytest.approx(wanted.focal) and np.allclose(found.c2w, wanted.c2w)
