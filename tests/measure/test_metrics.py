"""PSNR and SSIM against closed forms and against scikit-image."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from nerfvol.errors import InputError
from nerfvol.measure.metrics import psnr, ssim


def pictures(kind, seed=0, shape=(70, 83, 3)):
    generator = np.random.default_rng(seed)
    smooth = 0.5 + 0.5 * np.sin(np.arange(shape[0])[:, None, None] / 9 + np.arange(shape[1])[None, :, None] / 5)
    a = np.broadcast_to(smooth, shape).copy()
    if kind == "noise":
        return a, np.clip(a + 0.1 * generator.normal(size=shape), 0, 1)
    if kind == "flat":  # no variance over most of the image: the worst place for rounding
        a[:] = 0.9
        b = a.copy()
        b[30:40, 30:50, 1] = 0.3
        return a, b
    if kind == "white":
        a[:] = 1.0
        return a, np.where(generator.random(shape) < 0.02, 0.0, a)
    return a, generator.random(shape)


def published_ssim(a, b):
    return structural_similarity(
        a, b, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, channel_axis=2, data_range=1.0
    )


@pytest.mark.parametrize("kind", ["noise", "flat", "white", "unrelated"])
@pytest.mark.parametrize("dtype,tolerance", [(np.float64, 1e-9), (np.float32, 1e-5)])
def test_ssim_is_the_published_one(kind, dtype, tolerance):
    # scikit-image divides by C2 = 9e-4 as we do: rounding of the variances is magnified about a thousand times
    a, b = pictures(kind)
    assert abs(ssim(a.astype(dtype), b.astype(dtype)) - published_ssim(a, b)) < tolerance


@pytest.mark.parametrize("shape", [(11, 11, 3), (11, 90, 3), (42, 12, 3), (43, 64, 1), (75, 20, 3)])
def test_ssim_of_every_shape(shape):
    a, b = pictures("noise", shape=shape)
    assert abs(ssim(a, b) - published_ssim(a, b)) < 1e-9


def test_ssim_of_constants_is_known():
    a, b = np.full((20, 20, 3), 0.6), np.full((20, 20, 3), 0.2)
    expected = (2 * 0.6 * 0.2 + 1e-4) / (0.6**2 + 0.2**2 + 1e-4)
    assert math.isclose(ssim(a, b), expected, rel_tol=1e-12)
    assert math.isclose(ssim(a, a), 1, rel_tol=1e-12)


def test_psnr_of_known_errors():
    a = np.zeros((4, 5, 3))
    assert math.isclose(psnr(a, a + 0.1), 20, rel_tol=1e-12)
    b = a.copy()
    b[0, 0, 0] = 0.5  # one of 60 values: mse = 0.25 / 60
    assert math.isclose(psnr(a, b), 10 * math.log10(240), rel_tol=1e-12)
    assert psnr(a, a) == math.inf
    assert math.isnan(psnr(a, a + np.nan))


def test_tensors_and_arrays_score_the_same():
    a, b = (x.astype(np.float32) for x in pictures("noise"))
    ta, tb = torch.from_numpy(a).requires_grad_(True), torch.from_numpy(b)
    assert psnr(ta, tb) == psnr(a, b) and ssim(ta, tb) == ssim(a, b)


def test_what_cannot_be_compared_is_refused():
    a, b = pictures("noise")
    with pytest.raises(InputError, match="one shape"):
        psnr(a, b[:-1])
    with pytest.raises(InputError, match=r"values in \[0, 1\]"):
        psnr((a * 255).astype(np.uint8), (b * 255).astype(np.uint8))
    with pytest.raises(InputError, match="at least 11x11"):
        ssim(a[:10], b[:10])
    with pytest.raises(InputError, match="some pixels"):
        psnr(a[:0], b[:0])


@pytest.mark.parametrize("kind", ["noise", "flat", "unrelated"])
def test_compiled_and_plain_ssim_are_the_same(kind, monkeypatch):
    from nerfvol.measure import metrics

    a, b = (x.astype(np.float32) for x in pictures(kind))
    a = a[:, ::-1]  # a view that is not contiguous
    seen = np.zeros(a.shape[:2], bool)
    seen[20:50, 30:33] = True
    compiled = ssim(a, b), ssim(a, b, seen)
    monkeypatch.setattr(metrics, "native", lambda: None)
    np.testing.assert_allclose(compiled, (ssim(a, b), ssim(a, b, seen)), atol=1e-5)
