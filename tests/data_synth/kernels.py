"""Compiled loops that let the tests look into the scalar functions, a few for all tests so that little is compiled."""

import numpy as np

from data_synth import phase, sggx, spongecake
from data_synth.jit import kernel
from data_synth.rng import new_rng

MODE_PHASE, MODE_NORMALS = range(2)


@kernel
def _evaluate(ph, wo, directions, repeat, rng, out):
    for k in range(len(directions)):
        wi = (directions[k, 0], directions[k, 1], directions[k, 2])
        total = 0.0
        for _ in range(repeat):
            total += phase.evaluate(ph, 0.0, wo, wi, rng)
        out[k] = total / repeat


@kernel
def _sample(ph, mode, wo, rng, out):
    for k in range(len(out)):
        if mode == MODE_PHASE:
            w = phase.sample(ph, 0.0, wo, rng)
        else:
            w = sggx.sample_visible_normal(phase.flakes_at(ph, 0.0), wo, rng)
        out[k, 0], out[k, 1], out[k, 2] = w


@kernel
def _normals(ph, wo, directions, out):
    """sigma(w) and D(w)."""
    s = phase.flakes_at(ph, 0.0)
    for k in range(len(directions)):
        w = (directions[k, 0], directions[k, 1], directions[k, 2])
        out[k, 0], out[k, 1] = sggx.projected_area(s, w), sggx.normal_density(s, w)


@kernel
def _cake(layers, wo, directions, out):
    n = layers.rows.shape[0]
    for k in range(len(directions)):
        wi = (directions[k, 0], directions[k, 1], directions[k, 2])
        out[k, 0], out[k, 1], out[k, 2] = spongecake.evaluate(layers, 0, n, wo, wi)
        out[k, 3] = spongecake.pdf(layers, 0, n, wo, wi)


@kernel
def _cake_sample(layers, wo, rng, out):
    for k in range(len(out)):
        w, straight = spongecake.sample(layers, 0, layers.rows.shape[0], wo, rng)
        out[k, 0], out[k, 1], out[k, 2] = w
        out[k, 3] = 1.0 if straight else 0.0


def unit(*v):
    v = np.array(v, float)
    return tuple(float(x) for x in v / np.linalg.norm(v))


def phase_values(ph, wo, directions, repeat=1, seed=0):
    out = np.empty(len(directions))
    _evaluate(ph, wo, directions, repeat, new_rng(seed, 0), out)
    return out


def phase_samples(ph, wo, n, seed=0, normals=False):
    out = np.empty((n, 3))
    _sample(ph, MODE_NORMALS if normals else MODE_PHASE, wo, new_rng(seed, 0), out)
    return out


def flake_values(ph, directions):
    out = np.empty((len(directions), 2))
    _normals(ph, (0.0, 0.0, 1.0), directions, out)
    return out[:, 0], out[:, 1]


def cake_values(layers, wo, directions):
    out = np.empty((len(directions), 4))
    _cake(spongecake.stack(list(layers)), wo, directions, out)
    return out[:, :3], out[:, 3]


def cake_samples(layers, wo, n, seed=0):
    out = np.empty((n, 4))
    _cake_sample(spongecake.stack(list(layers)), wo, new_rng(seed, 0), out)
    return out[:, :3], out[:, 3] > 0


class SphereGrid:
    """Bins of the sphere in (cos theta, azimuth), with Gauss-Legendre points in each."""

    def __init__(self, n_cos=16, n_azimuth=16, order=6):
        x, w = np.polynomial.legendre.leggauss(order)
        self.n_cos, self.n_azimuth = n_cos, n_azimuth
        z = -1 + 2 * (np.arange(n_cos)[:, None] + 0.5 + 0.5 * x) / n_cos
        a = 2 * np.pi * (np.arange(n_azimuth)[:, None] + 0.5 + 0.5 * x) / n_azimuth
        z, a = np.broadcast_arrays(z[:, None, :, None], a[None, :, None, :])
        r = np.sqrt(1 - z * z)
        self.points = np.stack([r * np.cos(a), r * np.sin(a), z], axis=-1)
        self.weights = np.broadcast_to(np.outer(w, w), z.shape) * (np.pi / (n_cos * n_azimuth))

    @property
    def directions(self):
        return np.ascontiguousarray(self.points.reshape(-1, 3))

    def per_bin(self, values):
        return (values.reshape(self.weights.shape) * self.weights).sum(axis=(2, 3))

    def integrate(self, values):
        return self.per_bin(values).sum()

    def histogram(self, samples):
        i = np.clip(((samples[:, 2] + 1) / 2 * self.n_cos).astype(int), 0, self.n_cos - 1)
        a = np.arctan2(samples[:, 1], samples[:, 0]) % (2 * np.pi)
        j = np.clip((a / (2 * np.pi) * self.n_azimuth).astype(int), 0, self.n_azimuth - 1)
        return np.bincount(i * self.n_azimuth + j, minlength=self.n_cos * self.n_azimuth).reshape(self.n_cos, -1)
