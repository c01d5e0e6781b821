"""Pictures in other colours than sRGB become sRGB, and a sentence says so; files of several pictures are told."""

import io
import struct
import zlib

import numpy as np
import pytest
from PIL import Image, ImageCms, PngImagePlugin, TiffImagePlugin

from nerfvol.datasets.colours import _of_numbers, colours_of
from nerfvol.datasets.images import image_header, read_image, read_mask
from nerfvol.datasets.load import load_dataset
from nerfvol.datasets.primaries import BY_CODE, to_srgb
from nerfvol.errors import InputError
from tests.datasets.test_whatever_people_bring import said, scene
from tests.fixtures import scenes

# Columns of D50 XYZ of each space's primaries, as its ICC profile has them.
SRGB = np.array([[0.43607, 0.38515, 0.14307], [0.22249, 0.71687, 0.06061], [0.01392, 0.09708, 0.71410]])
P3 = np.array([[0.51512, 0.29198, 0.15710], [0.24120, 0.69225, 0.06657], [-0.00105, 0.04189, 0.78407]])
ADOBE = np.array([[0.60974, 0.20528, 0.14919], [0.31111, 0.62567, 0.06322], [0.01947, 0.06087, 0.74457]])
COLOURS = np.array(
    [[[200, 100, 50], [90, 140, 60], [128, 128, 128], [10, 20, 30], [250, 240, 230], [60, 60, 160]]], np.uint8
)


def icc(space, tags, name, connection=b"XYZ ", kind=b"mntr") -> bytes:
    """An ICC version 2 profile written out by hand (ICC.1:2001-04)."""
    tags = {b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(name) + 1) + name.encode() + bytes(79),
            b"wtpt": numbers((0.9642, 1, 0.8249)), b"cprt": b"text\0\0\0\0\0", **tags}  # fmt: skip
    table, body, first = struct.pack(">I", len(tags)), b"", 128 + 4 + 12 * len(tags)
    for tag, data in tags.items():
        table += tag + struct.pack(">II", first + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(">I4sI4s4s4s", first + len(body), b"lcms", 0x02100000, kind, space, connection)
    head += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", 63190, 65536, 54061) + bytes(48)
    return head + table + body


def numbers(values) -> bytes:
    return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(v * 65536) for v in values))


def curve(values) -> bytes:
    """Of a power, or of what 0 to 1 become."""
    whole = [round(256 * values)] if isinstance(values, float) else [round(65535 * v) for v in values]
    return b"curv\0\0\0\0" + struct.pack(f">I{len(whole)}H", len(whole), *whole)


def profile(primaries, gamma, name) -> bytes:
    """Of primaries (3, 3), D50, and a power."""
    tags = {}
    for letter, column in zip("rgb", primaries.T, strict=True):
        tags |= {f"{letter}XYZ".encode(): numbers(column), f"{letter}TRC".encode(): curve(float(gamma))}
    return icc(b"RGB ", tags, name)


def grey(values, name="grey") -> bytes:
    return icc(b"GRAY", {b"kTRC": curve(values)}, name)


def inks() -> bytes:
    """White paper, black where K is full or all others are, cyan at its corner; in between linear in Lab."""
    corners = np.zeros((2, 2, 2, 2, 3), np.uint8) + 128
    share = np.stack(np.meshgrid(*[[0, 1]] * 4, indexing="ij"), -1)
    corners[..., 0] = np.rint(255 * (1 - share[..., 3]) * (1 - share[..., :3].mean(axis=-1)))
    corners[1, 0, 0, 0] = np.rint([CYAN[0] * 2.55, CYAN[1] + 128, CYAN[2] + 128])
    table = b"mft1\0\0\0\0" + bytes([4, 3, 2, 0]) + struct.pack(">9i", *(65536 * np.eye(3, dtype=int)).ravel())
    table += bytes(range(256)) * 4 + corners.tobytes() + bytes(range(256)) * 3
    return icc(b"CMYK", {b"A2B0": table, b"A2B1": table}, "inks", b"Lab ", b"prtr")


CYAN = (60, -30, -30)
"""In Lab."""


def srgb_of(values, primaries, gamma):
    """What ``values`` (..., 3) mean in sRGB, 0 to 255, by the definitions."""
    light = np.clip((values / 255.0) ** gamma @ (np.linalg.inv(SRGB) @ primaries).T, 0, 1)
    return 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)


def save(path, **more):
    Image.fromarray(COLOURS).save(path, **more)
    return path


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
@pytest.mark.parametrize(("primaries", "gamma"), [(P3, 2.2), (ADOBE, 2.19921875), (SRGB, 1.8)])
def test_a_profile_is_applied(tmp_path, suffix, primaries, gamma):
    path = save(tmp_path / f"a{suffix}", icc_profile=profile(primaries, gamma, "own"), lossless=True)
    # A level for rounding, and one for the profile's own numbers, of 8 bits behind the point of the power.
    assert np.abs(read_image(path) - srgb_of(COLOURS, primaries, gamma)).max() <= 2
    assert np.abs(srgb_of(COLOURS, primaries, gamma) - COLOURS).max() > 8


def test_profiles_that_are_srgb_change_no_bit(tmp_path):
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    path = save(tmp_path / "a.png", icc_profile=own)
    assert (read_image(path) == COLOURS).all()
    with Image.open(path) as image:
        assert colours_of(image) is None


def test_transparency_and_palettes_keep_theirs(tmp_path):
    p3 = profile(P3, 2.2, "P3")
    alpha = np.arange(6, dtype=np.uint8)[None, :, None] * 40
    Image.fromarray(np.concatenate([COLOURS, alpha], axis=2)).save(tmp_path / "a.png", icc_profile=p3)
    image = read_image(tmp_path / "a.png")
    assert (image[..., 3:] == alpha).all() and np.abs(image[..., :3] - srgb_of(COLOURS, P3, 2.2)).max() <= 2
    palette = Image.fromarray(COLOURS).quantize(6)
    palette.save(tmp_path / "p.png", icc_profile=p3)
    plain = np.asarray(palette.convert("RGB"))
    assert np.abs(read_image(tmp_path / "p.png") - srgb_of(plain, P3, 2.2)).max() <= 2


def test_a_png_says_its_gamma(tmp_path):
    """gAMA is the power that made values of light; sRGB's own chunk, or its own power, changes nothing."""
    cases = ((1.0, (), srgb_of(COLOURS, SRGB, 1.0)), (0.55556, (), srgb_of(COLOURS, SRGB, 1.8)), (0.45455, (), COLOURS),
             (1.0, (b"sRGB",), COLOURS))  # fmt: skip
    for gamma, more, expected in cases:
        info = PngImagePlugin.PngInfo()
        info.add(b"gAMA", round(gamma * 100000).to_bytes(4, "big"))
        for chunk in more:
            info.add(chunk, b"\0")
        assert np.abs(read_image(save(tmp_path / "a.png", pnginfo=info)) - expected).max() <= 0.51


BT2020 = np.array([[0.67348, 0.16566, 0.12505], [0.27904, 0.67535, 0.04561], [-0.00193, 0.02998, 0.79686]])


def chunks(*pairs):
    info = PngImagePlugin.PngInfo()
    for name, data in pairs:
        info.add(name, data)
    return info


def places(*values) -> tuple[bytes, bytes]:
    return b"cHRM", struct.pack(">8I", *(round(100000 * v) for v in values))


def of_curve(values):
    """As ``srgb_of`` takes them with a power of 1: sRGB's values as light, 0 to 255."""
    v = values / 255.0
    return 255 * np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


@pytest.mark.parametrize(("codes", "expected"), [
    ((1, 13, 0, 1), COLOURS), ((1, 1, 0, 1), COLOURS), ((2, 13, 0, 1), COLOURS),
    ((12, 13, 0, 1), srgb_of(of_curve(COLOURS), P3, 1.0)), ((9, 14, 0, 1), srgb_of(of_curve(COLOURS), BT2020, 1.0)),
    ((12, 4, 0, 1), srgb_of(COLOURS, P3, 2.2)), ((1, 8, 0, 1), srgb_of(COLOURS, SRGB, 1.0)),
])  # fmt: skip
def test_a_pngs_code_points_go_before_all_else(tmp_path, codes, expected):
    """ITU-T H.273: Display P3 is 12, BT.2020 9, sRGB's curve 13, the power of 2.2 is 4, light itself 8."""
    info = chunks((b"gAMA", (30000).to_bytes(4, "big")), (b"cICP", bytes(codes)))
    path = save(tmp_path / "a.png", pnginfo=info, icc_profile=profile(ADOBE, 1.8, "other"))
    assert np.abs(read_image(path) - expected).max() <= 0.6  # the matrices have five digits
    with Image.open(path) as image:
        colours = colours_of(image)
    assert (colours is None) == (expected is COLOURS) and (colours is None or "cICP" in colours.name)


@pytest.mark.parametrize(("codes", "words"), [
    ((9, 16, 0, 1), "BT.2020 with PQ"), ((9, 18, 0, 1), "BT.2020 with HLG"), ((1, 13, 0, 0), "BT.709"),
    ((99, 13, 0, 1), "primaries 99"), ((1, 77, 0, 1), "curve 77"), ((1, 13, 5, 1), "BT.709"),
])  # fmt: skip
def test_code_points_without_a_known_conversion_are_told(tmp_path, codes, words):
    path = save(tmp_path / "a.png", pnginfo=chunks((b"cICP", bytes(codes))))
    assert (read_image(path) == COLOURS).all()
    with Image.open(path) as image:
        colours = colours_of(image)
    assert colours is not None and not colours.is_known and words in colours.name


def test_code_points_of_a_png_with_something_behind_its_pixels(tmp_path):
    """As ImageMagick writes its dates: a decoder looks there for EXIF, and closes the file."""
    path = save(tmp_path / "a.png", pnginfo=chunks((b"cICP", bytes((12, 13, 0, 1)))))
    data, text = path.read_bytes(), b"tEXtdate:create\x002026-12-01"
    chunk = struct.pack(">I", len(text) - 4) + text + struct.pack(">I", zlib.crc32(text))
    path.write_bytes(data[:-12] + chunk + data[-12:])
    colours = image_header(path).colours
    assert colours is not None and colours.name == "Display P3, by cICP"


def test_primaries_of_which_a_decoder_hands_on_another_number_are_none():
    assert _of_numbers(None, (0.3127, 0.329)) is None and _of_numbers(None, ()) is None


@pytest.mark.parametrize("code, published", [
    (12, [[1.2249402, -0.2249402, 0], [-0.0420570, 1.0420570, 0], [-0.0196376, -0.0786361, 1.0982736]]),
    (9, [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]),
])  # fmt: skip
def test_matrices_are_those_that_are_published(code, published):
    """CSS Color 4's for Display P3, ITU-R BT.2087's for BT.2020, which has four digits."""
    np.testing.assert_allclose(
        np.array(to_srgb(BY_CODE[code][1])), published, rtol=0, atol=6e-8 if code == 12 else 6e-5
    )


def test_code_points_that_say_nothing_leave_it_to_the_rest(tmp_path):
    path = save(tmp_path / "a.png", pnginfo=chunks((b"cICP", bytes((2, 2, 0, 1)))), icc_profile=profile(P3, 2.2, "P3"))
    assert np.abs(read_image(path) - srgb_of(COLOURS, P3, 2.2)).max() <= 2


def test_a_png_says_its_primaries(tmp_path):
    """With its gamma, or sRGB's curve; sRGB's own, as files round them, change nothing; one white becomes the other."""
    own, p3 = (0.3127, 0.329, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06), (0.3127, 0.329, 0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
    gamma = (b"gAMA", (55556).to_bytes(4, "big"))
    for pairs, expected in (
        ((places(*own),), COLOURS), ((places(0.313, 0.329, *own[2:]),), COLOURS), ((places(*p3), (b"sRGB", b"\0")), COLOURS),
        ((places(*p3),), srgb_of(of_curve(COLOURS), P3, 1.0)), ((places(*p3), gamma), srgb_of(COLOURS, P3, 1.8)),
    ):  # fmt: skip
        path = save(tmp_path / "a.png", pnginfo=chunks(*pairs))
        assert np.abs(read_image(path) - expected).max() <= 0.6
    greys = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    for white in ((0.3457, 0.3585), (1 / 3, 1 / 3), (0.314, 0.351)):
        Image.fromarray(greys).save(tmp_path / "a.png", pnginfo=chunks(places(*white, *p3[2:])))
        assert np.abs(read_image(tmp_path / "a.png").astype(int) - greys).max() <= 1


@pytest.mark.parametrize("given", [
    [0] * 8, [0.3127, 0.329, *[0.3, 0.3] * 3], [0.9, 0.05, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06],
    [0.3127, 0.329, 0.64, 0.33, 40000.0, 0.6, 0.15, 0.06], [0.3127, 0.0, 0.64, 0.33, 0.3, 0.6, 0.15, 0.06],
])  # fmt: skip
def test_primaries_that_are_none_are_told(tmp_path, given):
    path = save(tmp_path / "a.png", pnginfo=chunks(places(*given)))
    assert (read_image(path) == COLOURS).all()
    with Image.open(path) as image:
        colours = colours_of(image)
    assert colours is not None and not colours.is_known and "cHRM" in colours.name


def test_sixteen_bits_of_linear_light(tmp_path):
    values = np.linspace(0, 65535, 24).astype(np.uint16).reshape(2, 12, 1)
    data = scenes.png_bytes(values)
    chunk = b"gAMA" + (100000).to_bytes(4, "big")
    (tmp_path / "a.png").write_bytes(
        data[:33] + struct.pack(">I", 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    )
    expected = srgb_of(np.repeat(np.rint(values / 257), 3, axis=2), SRGB, 1.0)
    assert np.abs(read_image(tmp_path / "a.png") - expected).max() <= 0.51


def test_cameras_mark_adobe_rgb_in_exif(tmp_path):
    """Uncalibrated, and the interoperability R03, as the camera file system's rules have it."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    big = Image.fromarray(np.repeat(np.repeat(COLOURS, 16, axis=0), 16, axis=1))
    big.save(tmp_path / "a.jpg", exif=exif, quality=100, subsampling=0)
    plain = np.asarray(Image.open(tmp_path / "a.jpg").convert("RGB"))
    assert np.abs(read_image(tmp_path / "a.jpg") - srgb_of(plain, ADOBE, 2.19921875)).max() <= 2
    exif.get_ifd(0x8769)[0xA001] = 1
    big.save(tmp_path / "b.jpg", exif=exif, quality=100, subsampling=0)
    assert (read_image(tmp_path / "b.jpg") == plain).all()


def test_grey_profiles(tmp_path):
    """Of any curve but sRGB's own; a transparent level and half-transparent pixels stay as transparent as they were."""
    plain = Image.fromarray(COLOURS).convert("L")
    values, alpha = np.asarray(plain), (np.arange(6, dtype=np.uint8) * 40)[None]
    expected = srgb_of(np.repeat(values[..., None], 3, axis=2), SRGB, 1.8)
    plain.save(tmp_path / "a.png", icc_profile=grey(1.8))
    assert np.abs(read_image(tmp_path / "a.png") - expected).max() <= 2
    level = int(values[0, 1])
    plain.save(tmp_path / "t.png", icc_profile=grey(1.8), transparency=level)
    image = read_image(tmp_path / "t.png")
    assert (image[..., 3] == np.where(values == level, 0, 255)).all() and np.abs(image[..., :3] - expected).max() <= 2
    Image.merge("LA", (plain, Image.fromarray(alpha))).save(tmp_path / "b.png", icc_profile=grey(1.8))
    image = read_image(tmp_path / "b.png")
    assert (image[..., 3] == alpha).all() and np.abs(image[..., :3] - expected).max() <= 2
    x = np.linspace(0, 1, 1024)
    own = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    plain.save(tmp_path / "s.png", icc_profile=grey(own, "sGray"))
    assert (read_image(tmp_path / "s.png") == values[..., None]).all()
    with Image.open(tmp_path / "s.png") as image:
        assert colours_of(image) is None


def test_inks_with_a_profile(tmp_path):
    """No ink, all black, and cyan alone; ICC.1's Lab is relative to D50."""
    ink = np.array([[[0, 0, 0, 0], [0, 0, 0, 255], [255, 0, 0, 0]]], np.uint8)
    Image.fromarray(ink, "CMYK").save(tmp_path / "a.tif", icc_profile=inks())
    f = (CYAN[0] + 16) / 116 + np.array([CYAN[1] / 500, 0, -CYAN[2] / 200])
    light = np.linalg.inv(SRGB) @ (np.where(f > 6 / 29, f**3, 3 * (6 / 29) ** 2 * (f - 4 / 29)) * (0.9642, 1, 0.8249))
    light = np.clip(light, 0, 1)
    cyan = 255 * np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    # 8 bits of Lab are half a level of L, and more of what they stand for in red, which is near 0.
    assert np.abs(read_image(tmp_path / "a.tif") - np.stack([[255] * 3, [0] * 3, cyan])).max() <= 4


def test_a_profile_of_other_numbers_than_the_pictures_is_told(tmp_path):
    """Inks with sRGB's own profile are no sRGB."""
    own = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(COLOURS).convert("CMYK").save(tmp_path / "a.tif", icc_profile=own)
    with Image.open(tmp_path / "a.tif") as image:
        colours = colours_of(image)
    assert colours is not None and not colours.is_known


@pytest.mark.parametrize("gamma", [1, 4_000_000_000])
def test_a_gamma_that_none_can_mean_is_not_applied(tmp_path, gamma):
    info = PngImagePlugin.PngInfo()
    info.add(b"gAMA", gamma.to_bytes(4, "big"))
    assert (read_image(save(tmp_path / "a.png", pnginfo=info)) == COLOURS).all()
    with Image.open(tmp_path / "a.png") as image:
        colours = colours_of(image)
    assert colours is not None and not colours.is_known and "gamma" in colours.name


def test_masks_stay_black_and_white(tmp_path):
    mask = np.repeat(np.where(np.arange(6) % 2, 255, 0).astype(np.uint8)[None, :, None], 3, axis=2)
    Image.fromarray(mask).save(tmp_path / "m.png", icc_profile=profile(P3, 2.2, "P3"))
    assert (read_mask(tmp_path / "m.png", (6, 1)) == mask[..., 0]).all()


def test_a_masks_numbers_are_no_colours(tmp_path):
    """What is darker than half is left out of a JPEG, whatever light a profile says it is."""
    Image.new("L", (16, 16), 120).save(tmp_path / "m.jpg", icc_profile=grey(1.0))
    assert read_image(tmp_path / "m.jpg").min() > 127 and not read_mask(tmp_path / "m.jpg", (16, 16)).any()


# ------------------------------------------------------------------ what a set says of it
def again(folder, **more):
    """Writes the pictures of a set again."""
    for path in sorted((folder / "images").iterdir()):
        with Image.open(path) as image:
            image.load()
        image.save(path, **more)
    return folder


@pytest.mark.parametrize(("more", "words"), [
    ({"icc_profile": profile(P3, 2.2, "Display P3")}, ("10 of 10 images", "(Display P3)", "converted to it")),
    ({"icc_profile": b"x" * 300}, ("10 of 10 images", "cannot be used", "as if they were sRGB's")),
    ({"icc_profile": profile(P3, 2.2, "P3")[:150]}, ("cannot be used", "as if they were sRGB's")),
    ({"save_all": True, "append_images": [Image.new("RGB", (24, 16))]}, ("files of several pictures", "the first of each")),
])  # fmt: skip
def test_a_set_in_other_colours_says_so(tmp_path, more, words):
    said(load_dataset(again(scene(tmp_path), **more)), *words)


def test_profiles_of_one_name_are_one_sentence(tmp_path):
    """As of programs that write a profile for each picture; and its name is one line."""
    scene(tmp_path)
    for k, path in enumerate(sorted((tmp_path / "images").iterdir())):
        with Image.open(path) as image:
            image.load()
        image.save(path, icc_profile=profile(P3, 1.8 + 0.02 * k, "My\nscreen"))
    said(load_dataset(tmp_path), "10 of 10 images", "(My screen)")


def test_inks_without_a_profile_are_told(tmp_path):
    scene(tmp_path)
    for path in (tmp_path / "images").iterdir():
        buffer = io.BytesIO()
        Image.open(path).convert("CMYK").save(buffer, "JPEG")
        path.write_bytes(buffer.getvalue())
    said(load_dataset(tmp_path), "inks (CMYK)", "as if they were sRGB's")


def test_what_follows_the_first_picture_of_a_tiff_does_not_decide(tmp_path):
    """Neither another page's profile, nor that its place in the file is nonsense."""
    with TiffImagePlugin.AppendingTiffWriter(str(tmp_path / "a.tif"), True) as file:
        for more in ({}, {"icc_profile": profile(P3, 2.2, "P3")}):
            Image.fromarray(COLOURS).save(file, format="TIFF", **more)
            file.newFrame()
    header = image_header(tmp_path / "a.tif")
    assert header.is_several and header.colours is None and (read_image(tmp_path / "a.tif") == COLOURS).all()
    data = bytearray(save(tmp_path / "b.tif").read_bytes())
    (first,) = struct.unpack("<I", data[4:8])
    (entries,) = struct.unpack("<H", data[first : first + 2])
    after = first + 2 + 12 * entries
    data[after : after + 4] = struct.pack("<I", 20)
    (tmp_path / "b.tif").write_bytes(data)
    assert image_header(tmp_path / "b.tif").size == (6, 1)


def test_planes_of_sixteen_bits_are_refused(tmp_path):
    """Pillow takes the planes of such a TIFF for 8-bit ones, and shows high and low bytes side by side."""
    path, size = tmp_path / "a.tif", 6 * 4
    entries = [(256, 3, 1, 6), (257, 3, 1, 4), (258, 3, 3, 150), (259, 3, 1, 1), (262, 3, 1, 2), (273, 4, 3, 160),
               (277, 3, 1, 3), (278, 3, 1, 4), (279, 4, 3, 180), (284, 3, 1, 2)]  # fmt: skip
    head = b"II*\0" + struct.pack("<IH", 8, len(entries))
    head += b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)
    head = head.ljust(150, b"\0") + struct.pack("<3H", 16, 16, 16)
    head = head.ljust(160, b"\0") + struct.pack("<3I", *(200 + 2 * size * i for i in range(3)))
    head = head.ljust(180, b"\0") + struct.pack("<3I", *(2 * size,) * 3)
    path.write_bytes(head.ljust(200, b"\0") + bytes(6 * size))
    with pytest.raises(InputError, match="16 bits with a plane for each colour"):
        read_image(path)
