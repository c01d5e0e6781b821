"""Sharpness is a frequency, and a number for pictures of any size."""

import numpy as np
import pytest

from nerfvol.measure.sharpness import sharpness


def test_sharpness_is_the_squared_frequency_of_a_wave():
    """A wave of k radians a pixel: the discrete Laplacian and central difference multiply it by 2 - 2 cos k and sin k."""
    x = np.arange(400)
    for k in (0.3, 0.8, 1.5):
        wave = np.round(127 + 100 * np.sin(k * x))[None].repeat(50, 0).astype(np.uint8)
        assert sharpness(wave) == pytest.approx((2 - 2 * np.cos(k)) ** 2 / np.sin(k) ** 2, rel=0.02)


@pytest.mark.parametrize("shape", [(9, 9), (3, 3), (2, 9), (9, 2), (1, 1), (0, 5)])
def test_uniform_pictures_and_those_without_a_middle_have_none(shape):
    """Without a warning of numpy's; 3 x 3 pixels have one that has neighbours on all sides."""
    assert sharpness(np.full(shape, 7, np.uint8)) == 0
    picture = np.random.default_rng(0).integers(0, 256, shape, np.uint8)
    assert (sharpness(picture) > 0) == (min(shape) >= 3)
