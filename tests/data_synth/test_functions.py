"""Density functions as machine code: what plain_fields.py tests without a compiler, once through the compiler."""

import math
from typing import Any, cast

import numpy as np
import pytest

from data_synth import Camera, InputError, March, Path, lights, look_at, media, sample_transmittance, transmittance
from data_synth.scene import Scene
from tests.fixtures.hypothesis_tests import assert_means

BOX = (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)
RAY = (-3.0, 0.3, -0.4), (1.0, 0.0, 0.0)


def fog(x, y, z):
    return math.exp(-(z + 1.0) / 0.5)


def ramp(x, y, z):
    return 0.5 + 0.5 * x


def words(x, y, z):
    return "thick"


def test_functions_share_their_kernels_and_have_their_closed_forms():
    compiled, signatures = cast(Any, transmittance._transmittances), 0
    for function, depth in ((fog, 2 * math.exp(-0.6 / 0.5)), (ramp, 1.0)):
        m = media.procedural(function, *BOX, 1.0, (0.5, 1.0, 2.0), step=0.05)
        want = np.exp(-depth * np.array([0.5, 1.0, 2.0]))
        T = sample_transmittance(m, *RAY, method="ratio", n=4000)
        assert_means(T.mean(axis=0), T.var(axis=0, ddof=1) / len(T), want)
        assert sample_transmittance(m, *RAY, method="march")[0] == pytest.approx(want, rel=1e-12)  # both linear along x
        signatures = len(compiled.signatures)
        scene = Scene(medium=m, lights=[lights.environment(1.0)])
        camera = Camera(1, 1, 50.0, look_at(RAY[0], (0.0, *RAY[0][1:])))
        assert March(beams=1).render(scene, camera).alpha[0, 0] == pytest.approx(1 - want.mean())
        alpha = Path(spp=4000, jitter=False).render(scene, camera).alpha[0, 0]
        assert abs(alpha - (1 - want.mean())) < 4 * 0.5 / math.sqrt(4000)  # samples lie in [0, 1]
    assert len(compiled.signatures) == signatures


def test_what_is_no_density():
    with pytest.raises(InputError, match="words: expected a function .x, y, z. -> number that numba compiles"):
        media.procedural(cast(Any, words), *BOX, 1.0)
