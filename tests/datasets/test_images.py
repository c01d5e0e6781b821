"""Decoding of every kind of image file, and the integer arithmetic on images against float64."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, ImageFile

from nerfvol.datasets.averages import area_average, composite, composite_average
from nerfvol.datasets.images import MAX_PIXELS, image_header, image_size, read_image
from nerfvol.errors import InputError
from tests.fixtures.scenes import png_bytes, random_images

BACKGROUNDS = [(1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.5, 0.123)]
STRATEGY = st.tuples(st.integers(1, 5), st.integers(5, 23), st.integers(5, 23), st.integers(0, 2**31))


def rgba(height, width, seed):
    """Random colours; alpha often exactly 0 and 255, where images mostly are."""
    generator = np.random.default_rng(seed)
    image = generator.integers(0, 256, (height, width, 4), dtype=np.uint8)
    image[..., 3] = generator.choice([0, 0, 1, 77, 254, 255, 255], (height, width))
    return image


def block_mean(values, k):
    h, w = values.shape[0] // k, values.shape[1] // k
    return values[: h * k, : w * k].reshape(h, k, w, k, -1).mean(axis=(1, 3))


@settings(max_examples=60, deadline=None)
@given(STRATEGY, st.sampled_from(BACKGROUNDS))
def test_pyramid_levels_are_exact_to_half_a_level(sizes, background):
    k, height, width, seed = sizes
    image = rgba(height, width, seed)
    alpha = image[..., 3:] / 255
    truth = block_mean(image[..., :3] * alpha + 255 * np.array(background) * (1 - alpha), k)
    found = composite_average(image, background, k)
    assert found.dtype == np.uint8 and found.shape == truth.shape
    # half a level from rounding the result, 1/510 from the background's rounding to 1/255 of a level
    assert np.abs(found - truth).max() <= 0.5 + 1 / 510 + 1e-9


@settings(max_examples=60, deadline=None)
@given(STRATEGY)
def test_area_average_weighs_colour_with_alpha(sizes):
    k, height, width, seed = sizes[0] + 1, *sizes[1:]
    height, width = max(height, k), max(width, k)
    image = rgba(height, width, seed)
    found = area_average(image, k)
    alpha = image[..., 3:].astype(np.float64)
    weight = block_mean(alpha, k)
    colour = block_mean(image[..., :3] * alpha, k) / np.where(weight > 0, weight, 1)
    assert np.abs(found[..., 3:] - weight).max() <= 0.5 + 1e-9
    seen = found[..., 3] > 0
    assert np.abs(found[..., :3] - colour)[seen].max(initial=0) <= 0.5 + 1e-9
    assert not found[~seen].any()


def test_a_transparent_pixel_leaves_no_fringe():
    image = np.zeros((2, 2, 4), np.uint8)
    image[0, 0] = (200, 100, 40, 255)
    image[1, 1] = (0, 255, 0, 0)  # green that nobody can see
    np.testing.assert_array_equal(area_average(image, 2), [[[200, 100, 40, 64]]])


def test_what_is_all_transparent_is_black():
    image = rgba(8, 8, 0)
    image[:4, :4, 3] = 0
    assert not area_average(image, 4)[0, 0].any()
    assert not area_average(image, 2)[:2, :2].any()


def test_opaque_images_are_averaged_and_dropped_at_the_edge():
    image = random_images(1, (11, 7))[0]
    truth = np.floor(block_mean(image.astype(np.float64), 3) + 0.5)
    np.testing.assert_array_equal(area_average(image, 3), truth)
    np.testing.assert_array_equal(composite_average(image, (0, 0, 0), 3), truth)
    assert composite_average(image, (1, 1, 1), 1) is image


@pytest.mark.parametrize("background", BACKGROUNDS)
def test_composite_in_floats(background):
    image = rgba(9, 8, 1)
    alpha = image[..., 3:] / 255
    found = composite(image, background)
    assert found.dtype == np.float32
    truth = image[..., :3] / 255 * alpha + np.array(background) * (1 - alpha)
    np.testing.assert_allclose(found, truth, atol=4 * 2**-24)
    np.testing.assert_allclose(composite(image[..., :3], background), image[..., :3] / 255, atol=2 * 2**-24)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "1", "P"])
def test_modes_are_expanded(tmp_path, mode):
    source = Image.fromarray(random_images(1, channels=4)[0])
    image = source.convert("RGB" if mode == "P" else "RGBA").convert(mode)
    image.save(tmp_path / "image.png")
    expected = np.asarray(image.convert("RGBA" if mode in ("RGBA", "LA") else "RGB"))
    found = read_image(tmp_path / "image.png")
    np.testing.assert_array_equal(found, expected)
    assert found.flags.writeable and image_size(tmp_path / "image.png") == (24, 16)


def test_palettes_with_transparency_have_alpha(tmp_path):
    image = Image.fromarray(random_images(1)[0]).quantize(8)
    image.save(tmp_path / "image.png", transparency=3)
    found = read_image(tmp_path / "image.png")
    np.testing.assert_array_equal(found[..., 3] == 0, np.asarray(image) == 3)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_become_eight(tmp_path, channels):
    exact = random_images(1, channels=channels)[0]
    (tmp_path / "image.png").write_bytes(png_bytes(exact.astype(np.uint16) * 257))
    expected = np.repeat(exact, 3, axis=2) if channels == 1 else exact
    np.testing.assert_array_equal(read_image(tmp_path / "image.png"), expected)


@pytest.mark.parametrize("mode", ["RGB", "L", "CMYK"])
def test_jpeg(tmp_path, mode):
    Image.new("RGB", (24, 16), (200, 60, 30)).convert(mode).save(tmp_path / "image.jpg", quality=95)
    found = read_image(tmp_path / "image.jpg")
    assert found.shape == (16, 24, 3)
    expected = (200, 60, 30) if mode != "L" else (98, 98, 98)  # 0.299, 0.587, 0.114
    assert np.abs(found.astype(int) - expected).max() <= 3


def damaged(kind, tmp_path):
    whole = png_bytes(random_images(1, (60, 60))[0])
    path = tmp_path / "image.png"
    if kind == "truncated":
        path.write_bytes(whole[: len(whole) // 2])
    elif kind == "header only":
        path.write_bytes(whole[:33])
    elif kind == "flipped bits":
        path.write_bytes(whole[:60] + bytes(b ^ 0x55 for b in whole[60:90]) + whole[90:])
    elif kind == "text":
        path.write_text("this is no image")
    elif kind == "empty":
        path.write_bytes(b"")
    elif kind == "folder":
        path.mkdir()
    elif kind == "bomb":
        path.write_bytes(png_bytes(random_images(1)[0], declared=(60000, 60000)))
    elif kind == "float":
        path = tmp_path / "image.tif"
        Image.fromarray(np.zeros((4, 4), np.float32)).save(path)
    return path


@pytest.mark.parametrize("kind,sentence", [
    ("truncated", "damaged or truncated"), ("header only", "content is none"), ("flipped bits", "damaged"),
    ("text", "expected a PNG, JPEG"), ("empty", "expected a PNG, JPEG"), ("folder", "is a folder"),
    ("missing", "no such file"), ("bomb", "million pixels are refused"), ("float", "8 or 16 bits"),
])  # fmt: skip
def test_unusable_files_are_refused_in_one_sentence(tmp_path, kind, sentence):
    path = damaged(kind, tmp_path)
    with pytest.raises(InputError, match=sentence) as caught:
        read_image(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_sizes_between_pillows_limits_are_refused_too(tmp_path):
    side = int(MAX_PIXELS**0.5) + 2
    path = tmp_path / "image.png"
    path.write_bytes(png_bytes(random_images(1)[0], declared=(side, side)))
    with pytest.raises(InputError, match=f"declares {side}x{side}"):
        image_size(path)


@pytest.mark.parametrize("name", ["GIF", "PPM", "ICO", "DDS", "EPS"])
def test_other_formats_are_refused_whatever_the_name(tmp_path, name):
    """Pillow goes by the content, and hands PostScript to another program: only the decoders in use are reached."""
    path = tmp_path / "a.png"
    Image.new("RGB", (8, 8)).save(path, format=name)
    with pytest.raises(InputError, match="expected a PNG, JPEG, WEBP, BMP or TIFF image"):
        read_image(path)


def _png_with_exif(orientation, after_the_pixels):
    """A PNG whose eXIf chunk stands where other programs put it."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    chunk = exif.tobytes().removeprefix(b"Exif\0\0")
    whole = struct.pack(">I", len(chunk)) + b"eXIf" + chunk + struct.pack(">I", zlib.crc32(b"eXIf" + chunk))
    plain = png_bytes(random_images(1, (6, 4))[0])
    at = plain.index(b"IEND" if after_the_pixels else b"IDAT") - 4
    return plain[:at] + whole + plain[at:]


@pytest.mark.parametrize("after_the_pixels", [False, True])
def test_the_orientation_of_a_png_is_found_wherever_it_stands(tmp_path, after_the_pixels):
    path = tmp_path / "turned.png"
    path.write_bytes(_png_with_exif(6, after_the_pixels))
    assert image_header(path).orientation == 6


def test_a_header_is_read_without_decoding(tmp_path, monkeypatch):
    path = tmp_path / "plain.png"
    path.write_bytes(png_bytes(random_images(1, (6, 4))[0]))
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda self: pytest.fail("the picture was decoded"))
    assert image_header(path).size == (6, 4)
