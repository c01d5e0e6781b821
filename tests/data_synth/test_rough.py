"""Rough and tinted boundaries: densities, reciprocity, energy, the smooth limit, and pictures with closed forms."""

import math

import numpy as np
import pytest

from data_synth import Camera, InputError, March, Path, lights, look_at, materials, rough, surfaces
from data_synth.jit import kernel
from data_synth.rng import new_rng
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means


@kernel
def _parts(alpha, eta, wo, wi, out):
    for k in range(len(out)):
        a, b = (wo[k, 0], wo[k, 1], wo[k, 2]), (wi[k, 0], wi[k, 1], wi[k, 2])
        out[k, 0], out[k, 1], through = rough.parts(alpha, eta, a, b)
        out[k, 2] = 1.0 if through else 0.0


@kernel
def _sample(alpha, eta, wo, rng, out):
    for k in range(len(out)):
        w, out[k, 3], out[k, 4], through = rough.sample(alpha, eta, (wo[0], wo[1], wo[2]), rng)
        out[k, 0], out[k, 1], out[k, 2] = w
        out[k, 5] = 1.0 if through else 0.0


def parts(alpha, eta, wo, wi):
    wo, wi = np.broadcast_arrays(np.atleast_2d(wo), np.atleast_2d(wi))
    out = np.empty((len(wo), 3))
    _parts(alpha, eta, np.ascontiguousarray(wo, float), np.ascontiguousarray(wi, float), out)
    return out


def sampled(alpha, eta, wo, n, seed=0):
    out = np.empty((n, 6))
    _sample(alpha, eta, np.array(wo, float), new_rng(seed, 0), out)
    return out


def sphere(n=400):
    """Directions (2 n^2, 3) and weights: Gauss-Legendre in z on either side, even azimuths."""
    z, w = np.polynomial.legendre.leggauss(n)
    z, w = np.concatenate([(z + 1) / 2, (z - 1) / 2]), np.concatenate([w, w]) / 2
    azimuth = (np.arange(n) + 0.5) * 2 * math.pi / n
    sine = np.sqrt(1 - z * z)
    d = np.stack(np.broadcast_arrays(sine[:, None] * np.cos(azimuth), sine[:, None] * np.sin(azimuth), z[:, None]), -1)
    return d.reshape(-1, 3), np.repeat(w, n) * 2 * math.pi / n


def towards(cosine, azimuth=0.7):
    s = math.sqrt(1 - cosine * cosine)
    return np.array([s * math.cos(azimuth), s * math.sin(azimuth), cosine])


def fresnel(cosine, eta):
    """Reflectance of unpolarised light; eta: the index here over that of the other side."""
    s2 = eta * eta * (1 - cosine * cosine)
    if s2 >= 1:
        return 1.0
    ct = math.sqrt(1 - s2)
    return 0.5 * (((cosine - eta * ct) / (cosine + eta * ct)) ** 2 + ((eta * cosine - ct) / (eta * cosine + ct)) ** 2)


CASES = [(0.5, 1 / 1.5, 0.9), (0.5, 1 / 1.5, 0.3), (0.3, 1.5, 0.8), (0.3, 1.5, -0.5), (0.9, 1 / 1.33, -0.7)]


@pytest.mark.parametrize("alpha, eta, cosine", CASES)
def test_samples_have_their_density(alpha, eta, cosine):
    """Counts in 2 x 6 x 8 bins of the sphere, and what is lost to a second facet, against quadrature of the density."""
    wo, n, grid = towards(cosine), 200_000, 480
    d, w = sphere(grid)
    pdf = parts(alpha, eta, wo, d)[:, 1] * w

    def bins(v):
        k = np.minimum(((v[:, 2] + 1) * 6).astype(int), 11)
        return k * 8 + np.minimum(((np.arctan2(v[:, 1], v[:, 0]) + math.pi) / (2 * math.pi) * 8).astype(int), 7)

    expected = np.bincount(bins(d), pdf, 96)
    found = sampled(alpha, eta, wo, n)
    kept = found[:, 3] > 0
    counts = np.bincount(bins(found[kept, :3]), minlength=96)
    assert 0.7 < expected.sum() <= 1 + 1e-3
    p, q = np.append(expected, 1 - expected.sum()), np.append(counts, n - kept.sum()) / n
    error = np.abs(p - q) / np.sqrt(np.maximum(p, 1e-4) / n)
    # bins cut the quadrature's cells at z = k / 6: a cell is 1 / 480 of a hemisphere, of which its edge is off by half
    assert (error < 4.5 + 0.004 * p.max() * math.sqrt(n)).all()
    np.testing.assert_allclose(found[kept, 4], parts(alpha, eta, wo, found[kept, :3])[:, 1], rtol=1e-6)


@pytest.mark.parametrize("alpha, eta, cosine", CASES)
def test_weights_are_the_albedo(alpha, eta, cosine):
    """Mean weight = integral of f |cos|, at most 1: nothing is won, and little is lost where the surface is smooth."""
    wo = towards(cosine)
    d, w = sphere()
    want = float((parts(alpha, eta, wo, d)[:, 0] * w).sum())
    weights = sampled(alpha, eta, wo, 100_000, 1)[:, 3]
    assert_means(weights.mean(), weights.var() / len(weights), want, bias=2e-3)  # of the quadrature
    assert weights.max() <= 1 + 1e-9 and 0.6 < want < 1
    assert sampled(0.03, eta, towards(0.9), 20_000)[:, 3].mean() > 0.995


def test_reciprocity():
    rng = np.random.default_rng(0)
    wo, wi = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in rng.normal(size=(2, 4000, 3)))
    eta = 1 / 1.4
    there = parts(0.6, eta, wo, wi)
    # from the other end of the path: what was wi's side has the index that was on wo's other side
    swapped = np.where(wo[:, 2] * wi[:, 2] < 0, True, False)
    for side, own in ((swapped, 1 / eta), (~swapped, eta)):
        back = parts(0.6, own, wi[side], wo[side])
        f, g = there[side, 0] / np.abs(wi[side, 2]), back[:, 0] / np.abs(wo[side, 2])
        factor = eta * eta if own != eta else 1.0
        assert (f > 0).sum() > 200
        # eta wo + wi nearly cancels at worst to 1e-4 of its terms, and D has its square
        np.testing.assert_allclose(factor * f, g, rtol=1e-7, atol=1e-300)


@pytest.mark.parametrize("eta, cosine", [(1 / 1.5, 0.9), (1 / 1.5, 0.2), (1.5, 0.9), (1.5, 0.3)])
def test_smooth_limit(eta, cosine):
    wo, n = towards(cosine), 20_000
    found = sampled(1e-4, eta, wo, n)
    mirrored = np.array([-wo[0], -wo[1], wo[2]])
    through = found[:, 5] > 0
    R = fresnel(cosine, eta)
    assert abs(through.sum() - (1 - R) * n) <= 4.5 * math.sqrt(n * R * (1 - R)) + 1e-9
    assert np.abs(found[~through, :3] - mirrored).max() < 0.1 and found[:, 3].min() > 0.99
    if R < 1:
        bent = np.array([-eta * wo[0], -eta * wo[1], -math.sqrt(1 - eta**2 * (1 - cosine**2))])
        assert np.median(np.abs(found[through, :3] - bent).max(1)) < 1e-3


def looking_down(cosine, height=3.0):
    eye = np.array([-math.sqrt(1 - cosine**2) / cosine * height, 0.0, height])
    return Camera(1, 1, 1e5, look_at(tuple(eye), (0.0, 0.0, 0.0)))


TINT = np.array([0.9, 0.5, 0.2])


@pytest.mark.parametrize("roughness", [0.0, 1e-4])
@pytest.mark.parametrize("cosine", [0.999, 0.5])
def test_slab_of_tinted_glass_in_front_of_the_ground(roughness, cosine):
    """All orders of reflection inside: T = tint^2 (1 - R)^2 / (1 - R^2). A thin slab, so that nothing leaves by its sides."""
    slab = surfaces.box(0, (-50, -50, -0.01), (50, 50, 0))
    glass = materials.dielectric(1.5, roughness=roughness, tint=TINT)
    scene = Scene(shapes=[slab], materials=[glass], lights=[lights.sky(0.0, 0.0, 1.0)], opaque_sky=True)
    R = fresnel(cosine, 1 / 1.5)
    want = TINT**2 * (1 - R) ** 2 / (1 - R * R)
    runs = [Path(spp=400, jitter=False).render(scene, looking_down(cosine), seed=k).rgb[0, 0] for k in range(25)]
    p = np.array(runs)
    assert_means(p.mean(0), p.var(0, ddof=1) / len(p), want, bias=1e-5)
    marched = March(beams=2).render(scene, looking_down(cosine)).rgb[0, 0]
    np.testing.assert_allclose(marched, TINT**2 * (1 - R), rtol=1e-6)  # where light leaves all of it goes on


def halfspace(alpha, lit):
    """Glass fills everything below z = 0."""
    glass = materials.dielectric(1.5, roughness=alpha, tint=TINT)
    return Scene(shapes=[surfaces.plane(0, (0, 0, 0), (0, 0, 1))], materials=[glass], lights=lit, opaque_sky=True)


@pytest.mark.parametrize("alpha, cosine", [(0.4, 0.8), (0.8, 0.4)])
def test_furnace_of_one_boundary(alpha, cosine):
    """Under a constant sky, above and below, one boundary shows its albedo, tinted below: next events and paths together."""
    d, w = sphere()
    value = parts(alpha, 1 / 1.5, towards(cosine), d) * w[:, None]
    through = value[:, 2] > 0
    want = value[~through, 0].sum() + TINT * value[through, 0].sum()
    p = Path(spp=40_000, jitter=False).render(halfspace(alpha, [lights.environment(1.0)]), looking_down(cosine))
    assert_means(p.rgb[0, 0], p.variance[0, 0], want, bias=3e-3)  # of the quadrature


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_sun_seen_in_and_through_rough_glass(side):
    """Its radiance is f |cos| E, by the formulas of Walter et al. (2007), written here once more; tinted where refracted."""
    alpha, cosine, sun, n = 0.3, 0.8, np.array([0.2, 0.1, side * 0.9]), 1.5
    sun = sun / np.linalg.norm(sun)
    p = Path(spp=4, jitter=False).render(
        halfspace(alpha, [lights.directional(sun, (3.0, 2.0, 1.0))]), looking_down(cosine)
    )
    wo = np.array([-math.sqrt(1 - cosine**2), 0.0, cosine])
    h = wo + sun if side > 0 else -(wo + n * sun)  # of the incident and the transmitted index, pointing into the air
    h = h / np.linalg.norm(h) * np.sign(h[2])
    a2 = alpha * alpha
    D = a2 / (math.pi * ((a2 - 1) * h[2] ** 2 + 1) ** 2)
    tan2 = [(1 - v[2] ** 2) / v[2] ** 2 for v in (wo, sun)]
    G = 1 / (1 + sum((math.sqrt(1 + a2 * t) - 1) / 2 for t in tan2))
    co, ci, R = abs(wo @ h), abs(sun @ h), fresnel(abs(wo @ h), 1 / n)
    if side > 0:
        f = R * D * G / (4 * wo[2] * sun[2])
    else:  # eq. 21, without the square of the relative index
        f = co * ci / (wo[2] * abs(sun[2])) * n**2 * (1 - R) * D * G / (wo @ h + n * (sun @ h)) ** 2
    want = f * abs(sun[2]) * np.array([3.0, 2.0, 1.0]) * (TINT if side < 0 else 1.0)
    np.testing.assert_allclose(p.rgb[0, 0], want, rtol=1e-4)  # the camera's pixel is not quite a ray
    assert want.min() > 1e-3


@pytest.mark.parametrize("given, said", [
    ({"roughness": -0.1}, "roughness must be in"), ({"roughness": float("nan")}, "roughness must be in"),
    ({"tint": 1.1}, "tint"), ({"tint": (1, 1)}, "tint"),
])  # fmt: skip
def test_what_is_no_such_boundary(given, said):
    with pytest.raises(InputError, match=said):
        materials.dielectric(1.5, **given)
