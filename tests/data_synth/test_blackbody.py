"""Planck's law as colours, against the chromaticities that the CIE tabulates."""

import numpy as np
import pytest

from data_synth import InputError, blackbody, scenes


@pytest.mark.parametrize(
    "kelvin, x, y",
    [(2000, 0.5267, 0.4133), (2855.5, 0.4476, 0.4074), (6504, 0.3135, 0.3236), (10000, 0.2807, 0.2884)],
)
def test_chromaticity(kelvin, x, y):
    """The observer's fit is off by below 1 % of its peak: by a few thousandths in x and y, by more for a deep red."""
    c = blackbody.xyz(kelvin)
    assert np.allclose(c[:2] / c.sum(), (x, y), atol=4e-3)


def test_luminance_follows_planck():
    """Against the law itself at 555 nm, where the eye is most sensitive: Wien's ratio of two temperatures."""
    low, high = blackbody.glow(1500.0, 2000.0), blackbody.glow(2000.0, 2000.0)
    weights = np.array([0.2126729, 0.7151522, 0.0721750])
    assert high @ weights == pytest.approx(1.0, rel=2e-3)  # a clipped blue channel
    ratio = np.expm1(0.0143877 / (575e-9 * 2000)) / np.expm1(0.0143877 / (575e-9 * 1500))
    assert low @ weights == pytest.approx(ratio, rel=0.15)  # the eye's centre of gravity moves with temperature
    with pytest.raises(InputError, match="kelvin"):
        blackbody.glow(-1.0, 2000.0)


def test_the_fireball_is_redder_where_it_is_cooler():
    Le = scenes.explosion(resolution=16).medium.Le
    seen = Le[Le[:, 1] > 1e-6]
    assert len(seen) > 10 and (np.diff(seen[:, 1] / seen[:, 0]) > 0).all() and (np.diff(seen[:, 0]) > 0).all()
