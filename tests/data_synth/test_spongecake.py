"""SpongeCake layers (PHYSICS 12)."""

import numpy as np
import pytest

from data_synth import sggx, spongecake
from data_synth.errors import InputError
from tests.data_synth.kernels import SphereGrid, cake_samples, cake_values, unit
from tests.fixtures.hypothesis_tests import assert_histogram, assert_sample_mean

WO = unit(0.4, -0.2, 0.7)
SKIN = spongecake.layer(0.4, sggx.surface((0, 0, 1), 0.4), 0.9)
FLESH = spongecake.layer(1.1, sggx.fibre(unit(1, 0.3, 0.1), 0.5), (1.0, 0.7, 0.3))
CAKES = {"one": SKIN[None], "fibres": FLESH[None], "two": np.stack([SKIN, FLESH])}


def stack(*rows):
    return np.ascontiguousarray(np.stack(rows))


@pytest.mark.parametrize("name", CAKES)
@pytest.mark.parametrize("wi", [unit(-0.5, 0.6, 0.4), unit(0.1, 0.7, -0.6)])
def test_reciprocity(name, wi):
    there, _ = cake_values(CAKES[name], WO, np.array([wi]))
    back, _ = cake_values(CAKES[name], wi, np.array([WO]))
    assert np.allclose(there, back, rtol=1e-12) and there.min() > 0


@pytest.mark.parametrize("name", CAKES)
@pytest.mark.parametrize("wo", [WO, unit(0.9, 0.1, 0.25), unit(0.2, 0.1, -0.9)])
def test_reflects_and_transmits_no_more_than_arrives(name, wo):
    grid = SphereGrid(48, 24, 6)
    f, _ = cake_values(CAKES[name], wo, grid.directions)
    straight = np.exp(-sum(r[0] * np.sqrt(quadratic(r[1:7], wo)) / abs(wo[2]) for r in CAKES[name]))
    total = grid.integrate(f[:, 0] * np.abs(grid.directions[:, 2])) + straight
    assert straight < total <= 1.0 + 1e-3


def quadratic(s, w):
    matrix = np.array([[s[0], s[3], s[4]], [s[3], s[1], s[5]], [s[4], s[5], s[2]]])
    return np.array(w) @ matrix @ np.array(w)


def test_one_layer_is_two_halves():
    half = SKIN.copy()
    half[0] /= 2
    directions = SphereGrid(6, 6, 2).directions
    whole, _ = cake_values(SKIN[None], WO, directions)
    halves, _ = cake_values(stack(half, half), WO, directions)
    assert np.allclose(whole, halves, rtol=1e-9, atol=1e-14)


def test_thick_limit_forgets_what_lies_below():
    thick = SKIN.copy()
    thick[0] = 60.0
    wi = np.array([unit(-0.5, 0.6, 0.4)])
    alone, _ = cake_values(thick[None], WO, wi)
    covered, _ = cake_values(stack(thick, FLESH), WO, wi)
    assert np.allclose(alone, covered, rtol=1e-12)
    # reflection of an infinitely thick layer: F D(h) / (4 cos cos (Lambda_i + Lambda_o))
    s, h = SKIN[1:7], np.array(WO) + wi[0]
    h /= np.linalg.norm(h)
    matrix = np.array([[s[0], s[3], s[4]], [s[3], s[1], s[5]], [s[4], s[5], s[2]]])
    d = 1 / (np.pi * np.sqrt(np.linalg.det(matrix)) * (h @ np.linalg.inv(matrix) @ h) ** 2)
    slants = np.sqrt(quadratic(s, WO)) / WO[2] + np.sqrt(quadratic(s, wi[0])) / wi[0][2]
    assert alone[0, 0] == pytest.approx(0.9 * d / (4 * WO[2] * wi[0][2] * slants), rel=1e-12)


def test_transmission_is_continuous_where_the_slants_meet():
    layers, wi = spongecake.layer(0.7, sggx.fibre((0, 0, 1), 0.5), 1.0)[None], unit(0.2, 0.4, -0.7)
    turned = [unit(0.2, 0.4, -0.7 + e) for e in (-1e-5, -1e-9, 0.0, 1e-9, 1e-5)]
    values, _ = cake_values(layers, unit(0.4, -0.2, 0.7), np.array(turned))
    assert wi == turned[2] and np.ptp(values[:, 0]) < 1e-4 * values[0, 0] and values.min() > 0


@pytest.mark.parametrize("name", CAKES)
def test_sampling_follows_its_pdf(name):
    grid, n = SphereGrid(12, 12, 8), 200_000
    directions, straight = cake_samples(CAKES[name], WO, n)
    _, pdf = cake_values(CAKES[name], WO, grid.directions)
    through = np.exp(-sum(r[0] * np.sqrt(quadratic(r[1:7], WO)) / abs(WO[2]) for r in CAKES[name]))
    assert_sample_mean(straight, through)
    assert grid.integrate(pdf) == pytest.approx(1 - through, rel=1e-3)
    expected = grid.per_bin(pdf)
    scattered = directions[~straight]
    assert_histogram(grid.histogram(scattered), len(scattered) * expected / expected.sum())


def test_bad_layers_are_refused():
    with pytest.raises(InputError, match="tau"):
        spongecake.layer(-1.0, sggx.fibre((0, 0, 1), 0.5), 0.5)
    with pytest.raises(InputError, match="albedo"):
        spongecake.layer(1.0, sggx.fibre((0, 0, 1), 0.5), 1.5)
