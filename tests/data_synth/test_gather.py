"""Light gathered at the density's samples: the sweep against integrals, the picture against the march."""

import numpy as np
import pytest

from data_synth import Camera, DeepShadow, March, jit, lights, look_at, materials, media, phase, surfaces, sweep
from data_synth.scene import Scene
from data_synth.shadowmap import ShadowMaps
from data_synth.transmittance import sample_transmittance

CAMERA = Camera(12, 12, 17.0, look_at((0.3, -2.6, 0.9)))
SUN = lights.directional((0.6, 0.2, 0.77), 3.0)


def blob(x, y, z):
    return np.exp(-4.0 * (x * x + 1.4 * y * y + 0.7 * (z - 0.1) ** 2))


def cloud(resolution, **kwargs):
    given = {"sigma_t": 5.0, "albedo": (0.9, 0.8, 0.7), "phase": phase.two_lobes(0.6, -0.3, 0.7)} | kwargs
    return media.from_function(blob, (-1, -1, -0.8), (1, 1, 0.8), resolution, **given)


@pytest.mark.parametrize("towards", [(0, 0, 1), (0, -1, 0), (0.6, 0.2, 0.77), (-1, 1, -1), (0.5, -0.8, -0.33)])
def test_sweep_of_a_linear_density(towards):
    """Straight down, along diagonals and in between, on cells that are not cubes, up to every face of the box.

    Along an axis the sweep is exact. Elsewhere the thickness has kinks, where light turns from one face of the box to
    the next; across them the cubics are off by up to a cell, in few samples: hence a mean and a median.
    """
    w = np.array(towards) / np.linalg.norm(towards)
    lo, hi, n = np.array([-1.0, -0.7, 0.0]), np.array([1.0, 0.8, 1.1]), (33, 45, 25)
    p = np.stack(np.meshgrid(*[np.linspace(a, b, k) for a, b, k in zip(lo, hi, n, strict=True)], indexing="ij"), -1)
    slope = np.array([0.2, -0.1, 0.3])
    thickness = sweep.thickness((1.0 + p @ slope).astype(np.float32), (hi - lo) / (np.array(n) - 1), tuple(w))
    with np.errstate(divide="ignore", invalid="ignore"):
        leave = np.where(w > 0, (hi - p) / w, np.where(w < 0, (lo - p) / w, np.inf)).min(axis=-1)
    exact = leave * (1.0 + p @ slope) + 0.5 * leave**2 * (w @ slope)
    error = np.abs(thickness - exact) / exact.mean()
    straight = np.count_nonzero(w) == 1
    assert np.median(error) < (1e-6 if straight else 1e-3)
    assert error.mean() < (1e-6 if straight else 0.01)


def test_sweep_is_the_integral_to_the_light():
    m = cloud(41, sigma_t=1.0)
    w = (0.6, 0.2, np.sqrt(1 - 0.4))
    thickness = sweep.thickness(media.dense(m), m.cell, w)
    for i, j, k in ((20, 20, 16), (5, 30, 4), (33, 18, 10), (20, 8, 30), (12, 12, 12)):
        p = np.array(m.lo) + np.array([i, j, k]) * m.cell
        exact = -np.log(sample_transmittance(m, p, w, method="regular")[0, 0])
        assert thickness[i, j, k] == pytest.approx(exact, rel=5e-3, abs=1e-5)


def test_sweep_beside_a_hard_edge_is_not_negative():
    """Cubics swing below 0 next to the shadow of a block; a negative thickness would be more light than there is."""
    rho = np.zeros((40, 40, 40), np.float32)
    rho[15:25, 15:25, 15:25] = 1.0
    thickness = sweep.thickness(rho, (0.1,) * 3, (0.6, 0.2, np.sqrt(1 - 0.4)))
    assert thickness.min() == 0.0 and 1.0 < thickness.max() < 0.1 * 10 * np.sqrt(3) + 0.1


@pytest.mark.parametrize("towards", [(0.6, 0.2, 0.77), (-0.3, 0.9, 0.25), (1, 0, 0)])
def test_sweep_has_the_same_bits_for_any_number_of_threads(towards, monkeypatch):
    """On noise, so that every sample counts; several times over, so that threads meet; and with the bands in reverse."""
    rho = np.random.default_rng(0).random((70, 80, 90), dtype=np.float32)

    def swept(threads):
        monkeypatch.setattr(jit, "core_count", lambda: threads)
        return sweep.thickness(rho, (0.01, 0.012, 0.011), tuple(np.array(towards) / np.linalg.norm(towards)))

    alone = swept(1)
    assert alone.max() > 0.2
    for threads in 3 * (2, 3, 8):
        assert np.array_equal(swept(threads), alone), f"{threads} threads"
    in_order = jit.in_parallel
    monkeypatch.setattr(jit, "in_parallel", lambda work, jobs: in_order(work, reversed(list(jobs))))
    assert np.array_equal(swept(1), alone)


def test_the_picture_has_the_same_bits_for_any_number_of_threads(monkeypatch):
    """From the sweep of two lights to the last pixel."""
    pictures = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(jit, "core_count", lambda threads=threads: threads)
        scene = Scene(medium=cloud(41), lights=[SUN, lights.directional((-0.5, 0.3, 0.81), (1.0, 2.0, 3.0))])
        pictures.append(DeepShadow().render(scene, CAMERA).rgb)
    assert (
        pictures[0].max() > 0 and np.array_equal(pictures[1], pictures[0]) and np.array_equal(pictures[2], pictures[0])
    )


def test_gathered_light_tends_to_the_march_as_the_grid_is_refined():
    """Second order in the cell, with a sun and a sky; shadow rays of fine steps through the same medium are the truth."""
    errors, sizes = [], (17, 25, 37)
    for n in sizes:
        scene = Scene(medium=cloud(n), lights=[SUN, lights.sky((0.2, 0.4, 0.9), 0.5, 0.1)])
        scene.medium = scene.medium._replace(step=0.02)
        marched = March(beams=5).render(scene, CAMERA)
        gathered = DeepShadow(beams=5).render(scene, CAMERA)
        assert np.allclose(gathered.alpha, marched.alpha, atol=1e-6)
        assert np.allclose(gathered.distance, marched.distance, rtol=1e-4)
        errors.append(np.abs(gathered.rgb - marched.rgb).mean() / marched.rgb.mean())
    order = -np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert order > 1.6 and errors[-1] < 2e-3, f"errors {errors}, order {order:.2f}"


def test_gathered_glow_and_attributes():
    """Emission and albedo that depend on an attribute are put down at the samples as well."""
    n = 33
    x = np.linspace(0, 1, n)[:, None, None] * np.ones((1, n, n))
    rho = np.sin(np.pi * x) * np.sin(np.pi * x.transpose(1, 0, 2))
    albedo, Le = [[0.2, 0.5, 0.9], [0.9, 0.5, 0.1]], [[0.0, 0.1, 0.5], [2.0, 1.0, 0.2]]
    m = media.grid(rho, (-1,) * 3, (1,) * 3, 4.0, albedo, Le, attribute=x)
    scene = Scene(medium=m._replace(step=0.02), lights=[SUN])
    marched, gathered = (i.render(scene, CAMERA).rgb for i in (March(), DeepShadow()))
    assert np.abs(gathered - marched).mean() < 2e-3 * marched.mean()


def floor_and_wall(**kwargs):
    return Scene(
        medium=cloud(33, **kwargs)._replace(step=0.02),
        shapes=[surfaces.plane(0, (0, 0, -1.0), (0, 0, 1)), surfaces.box(0, (0.9, -0.6, 0.85), (1.0, 0.6, 2.0))],
        materials=[materials.lambert(0.6)],
        lights=[SUN],
    )


def test_gathered_light_beside_surfaces():
    """A wall shadows part of the medium, the medium shadows the floor."""
    scene = floor_and_wall()
    marched, gathered = (i.render(scene, CAMERA) for i in (March(), DeepShadow()))
    assert np.abs(gathered.rgb - marched.rgb).mean() < 0.01 * marched.rgb.mean()
    assert np.allclose(gathered.alpha, marched.alpha, atol=1e-6)
    bare = floor_and_wall()
    bare.shapes = bare.shapes[:1]
    open_sky = DeepShadow().render(bare, CAMERA).rgb
    assert np.abs(open_sky - marched.rgb).mean() > 0.05 * marched.rgb.mean()  # the wall matters


@pytest.mark.parametrize("why", ["eye inside", "coloured", "flakes", "lamp"])
def test_what_cannot_be_gathered_is_read_from_maps(why, monkeypatch):
    """The default integrator then renders exactly what it renders when maps are asked for."""
    more = {"coloured": {"sigma_t": (3.0, 4.0, 5.0)}, "flakes": {"phase": phase.microflakes(np.diag([1.0, 1.0, 0.3]))}}
    scene = Scene(medium=cloud(17, **more.get(why, {})), lights=[SUN])
    if why == "lamp":
        scene.lights = [lights.point((1.0, -1.0, 2.0), 5.0)]
    camera = Camera(6, 6, 6.0, look_at((0.0, -0.4, 0.1))) if why == "eye inside" else CAMERA
    default, mapped = (i.render(scene, camera).rgb for i in (DeepShadow(), DeepShadow(resolution=96)))
    assert np.array_equal(default, mapped) and default.max() > 0


def test_maps_are_not_made_where_nothing_reads_them():
    scene = Scene(medium=cloud(17), lights=[SUN])
    DeepShadow().render(scene, CAMERA)
    (prepared,) = scene.prepared.values()
    assert prepared.gathered is not None and isinstance(prepared.maps, ShadowMaps) and prepared.maps.values.size == 0
