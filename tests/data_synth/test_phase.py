"""Phase functions and SGGX microflakes: normalisation, moments, samplers against densities, reciprocity."""

import numpy as np
import pytest

from data_synth import phase, sggx
from data_synth.errors import InputError
from tests.data_synth.kernels import SphereGrid, flake_values, phase_samples, phase_values, unit
from tests.fixtures.hypothesis_tests import assert_histogram, assert_sample_mean

WO = unit(0.3, -0.5, 0.8)
FIBRE = phase.microflakes(sggx.fibre(unit(1, 2, 0.5), 0.4))
PHASES = {
    "isotropic": phase.isotropic(),
    "rayleigh": phase.rayleigh(),
    "hg forward": phase.henyey_greenstein(0.7),
    "hg backward": phase.henyey_greenstein(-0.4),
    "hg tiny g": phase.henyey_greenstein(1e-7),
    "two lobes": phase.two_lobes(0.8, -0.3, 0.6),
    "fibre": FIBRE,
    "surface": phase.microflakes(sggx.surface(unit(0.2, 0.1, 1), 0.5)),
}
EXACT = [name for name in PHASES if name not in ("fibre", "surface")]


@pytest.mark.parametrize("name", PHASES)
def test_integrates_to_one(name):
    grid = SphereGrid(24, 24, 8)
    assert grid.integrate(phase_values(PHASES[name], WO, grid.directions)) == pytest.approx(1.0, abs=2e-4)


@pytest.mark.parametrize("name", PHASES)
def test_sampler_follows_the_density(name):
    grid = SphereGrid(12, 12, 8)
    n = 200_000
    expected = n * grid.per_bin(phase_values(PHASES[name], WO, grid.directions))
    assert_histogram(grid.histogram(phase_samples(PHASES[name], WO, n)), expected / expected.sum() * n)


@pytest.mark.parametrize("g", [-0.9, -0.3, 0.0, 1e-9, 0.5, 0.95])
def test_mean_cosine_is_g_and_positive_g_goes_forward(g):
    cosines = phase_samples(phase.henyey_greenstein(g), WO, 200_000) @ (-np.array(WO))
    assert_sample_mean(cosines, g)


def test_two_lobes_mean_cosine():
    cosines = phase_samples(PHASES["two lobes"], WO, 200_000) @ (-np.array(WO))
    assert_sample_mean(cosines, 0.6 * 0.8 - 0.4 * 0.3)


def test_rayleigh_second_moment():
    cosines = phase_samples(PHASES["rayleigh"], WO, 200_000) @ np.array(WO)
    assert_sample_mean(cosines**2, 0.4)


@pytest.mark.parametrize("name", PHASES)
def test_reciprocity_with_the_projected_area(name):
    ph, wi = PHASES[name], unit(-0.7, 0.1, 0.2)
    there = phase_values(ph, WO, np.array([wi]))[0] * flake_values(ph, np.array([WO]))[0][0]
    back = phase_values(ph, wi, np.array([WO]))[0] * flake_values(ph, np.array([wi]))[0][0]
    assert there == pytest.approx(back, rel=1e-12)


def test_unit_sphere_of_flakes_has_unit_projected_area():
    area, density = flake_values(phase.microflakes(np.eye(3)), SphereGrid(2, 2, 3).directions)
    assert np.allclose(area, 1.0, atol=1e-15) and np.allclose(density, 1 / np.pi, atol=1e-15)


@pytest.mark.parametrize("name", ["fibre", "surface"])
def test_projected_area_is_the_integral_over_normals(name):
    grid = SphereGrid(32, 32, 8)
    area, density = flake_values(PHASES[name], grid.directions)
    facing = np.maximum(grid.directions @ np.array(WO), 0)
    assert grid.integrate(facing * density) == pytest.approx(flake_values(PHASES[name], np.array([WO]))[0][0], rel=1e-3)


def test_visible_normals_follow_their_density():
    grid, n = SphereGrid(12, 12, 8), 200_000
    _, density = flake_values(FIBRE, grid.directions)
    visible = np.maximum(grid.directions @ np.array(WO), 0) * density
    expected = grid.per_bin(visible)
    assert_histogram(grid.histogram(phase_samples(FIBRE, WO, n, normals=True)), n * expected / expected.sum())


def test_diffuse_flakes_sample_what_they_evaluate():
    ph = phase.microflakes(sggx.fibre((0, 0, 1), 0.5), diffuse=True)
    grid = SphereGrid(6, 6, 4)
    values = phase_values(ph, WO, grid.directions, repeat=2000)
    assert grid.integrate(values) == pytest.approx(1.0, abs=5e-3)
    n = 20_000  # few enough that the noise of the evaluated density stays below the histogram's
    expected = grid.per_bin(values)
    assert_histogram(grid.histogram(phase_samples(ph, WO, n)), n * expected / expected.sum())


@pytest.mark.parametrize("g", [1.0, -1.0, 1.5, float("nan")])
def test_bad_g_is_refused(g):
    with pytest.raises(InputError, match="g1"):
        phase.henyey_greenstein(g)


def test_bad_flakes_are_refused():
    with pytest.raises(InputError, match="positive definite"):
        phase.microflakes(np.diag([1.0, 1.0, -0.1]))
    with pytest.raises(InputError, match="symmetric"):
        phase.microflakes(np.array([[1, 0.2, 0], [0, 1, 0], [0, 0, 1.0]]))
    with pytest.raises(InputError, match="roughness"):
        sggx.fibre((0, 0, 1), 0.0)
