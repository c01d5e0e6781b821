"""Pixels in Pillow's own memory: the same as a copy, alive after the image, refusing writes; copied where not lent."""

import gc
import weakref

import numpy as np
import pytest
from PIL import Image

from nerfvol.datasets import shared_pixels
from nerfvol.datasets.shared_pixels import pixels_of


def picture(mode: str, seed: int = 0) -> Image.Image:
    channels = len(Image.new(mode, (1, 1)).getbands())
    values = np.random.default_rng(seed).integers(0, 256, (37, 53, channels)).astype(np.uint8)
    return Image.fromarray(values[..., 0] if channels == 1 else values, mode)


@pytest.mark.parametrize("mode", ["RGBA", "RGB", "L"])
def test_they_are_the_pixels(mode):
    image = picture(mode)
    np.testing.assert_array_equal(pixels_of(image), np.asarray(image))


@pytest.mark.skipif(not hasattr(Image.Image, "__arrow_c_array__"), reason="this Pillow does not lend its memory")
def test_they_are_not_copied_and_outlive_the_image():
    image = picture("RGBA").copy()  # memory of its own
    copy, pixels = np.asarray(image).copy(), pixels_of(image)
    assert not pixels.flags.writeable and not pixels.flags.owndata
    image.putpixel((3, 5), (1, 2, 3, 4))
    assert pixels[5, 3].tolist() == [1, 2, 3, 4]
    copy[5, 3] = (1, 2, 3, 4)
    gone = weakref.ref(image)
    del image
    others = [picture("RGBA", seed) for seed in range(1, 30)]  # would take the memory if it were free
    gc.collect()
    assert gone() is None and len(others) == 29
    np.testing.assert_array_equal(pixels, copy)


def test_what_is_not_lent_is_copied(monkeypatch):
    image = picture("RGBA")
    expected = np.asarray(image)

    def refuse(self):
        raise ValueError("image is in multiple array blocks")

    monkeypatch.setattr(Image.Image, "__arrow_c_array__", refuse, raising=False)
    np.testing.assert_array_equal(pixels_of(image), expected)
    assert shared_pixels._lent(image) is None
    monkeypatch.delattr(Image.Image, "__arrow_c_array__")
    np.testing.assert_array_equal(pixels_of(image), expected)
