"""Which pictures a folder holds, upright copies of them, and which camera took them."""

import threading

import numpy as np
import pytest
from PIL import Image, PngImagePlugin

from nerfvol.datasets.images import read_image
from nerfvol.errors import InputError
from nerfvol.poses import sources
from nerfvol.poses.sources import camera_groups, copy_photographs, find_photographs
from tests.datasets.test_colours import COLOURS, P3, profile, srgb_of

EXIF, FOCAL, FOCAL_35, ORIENTATION, MODEL = 0x8769, 0x920A, 0xA405, 0x0112, 0x0110


def save(path, size=(40, 30), model=None, focal=None, film=None, orientation=None, picture=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    if picture is None:
        picture = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    exif = Image.Exif()
    if model is not None:
        exif[MODEL] = model
    if orientation is not None:
        exif[ORIENTATION] = orientation
    inner = {tag: value for tag, value in ((FOCAL, focal), (FOCAL_35, film)) if value is not None}
    if inner:
        exif.get_ifd(EXIF).update(inner)
    Image.fromarray(picture).save(path, exif=exif, quality=98)
    return path


def test_focal_length_of_35_mm_film(tmp_path):
    """A 27 mm lens on film sees a diagonal of 43.27 mm; a picture of 40x30 pixels has one of 50."""
    save(tmp_path / "in/a.jpg", model="P1", focal=4.2, film=27)
    (photograph,), _ = copy_photographs([tmp_path / "in/a.jpg"], tmp_path / "out", 1000)
    assert photograph.focal == pytest.approx(27 * 50 / np.hypot(36, 24))
    assert "P1" in photograph.camera and "4.20" in photograph.camera


def test_copies_are_upright_and_of_the_size_that_was_asked_for(tmp_path):
    """Orientation 6: the picture's top is at the right of what is stored."""
    picture = np.zeros((60, 100, 3), np.uint8)
    picture[:, 50:] = 255
    save(tmp_path / "in/a.jpg", orientation=6, picture=picture)
    (photograph,), _ = copy_photographs([tmp_path / "in/a.jpg"], tmp_path / "out", 50)
    image = np.asarray(Image.open(tmp_path / "out" / photograph.name).convert("L")).astype(float)
    assert (photograph.width, photograph.height) == (30, 50) == image.shape[::-1]
    assert image[:20].mean() < 20 and image[30:].mean() > 235


def test_what_needs_no_change_is_copied_byte_by_byte(tmp_path):
    path = save(tmp_path / "in/a.jpg")
    copy_photographs([path], tmp_path / "out", 1000)
    assert (tmp_path / "out/a.jpg").read_bytes() == path.read_bytes()


@pytest.mark.parametrize("turn", [1, 6])
def test_copies_have_the_colours_that_the_photograph_states(tmp_path, turn):
    """Phones photograph in Display P3; a copy that is turned or smaller has no profile, one byte by byte has its own."""
    picture = np.repeat(np.repeat(COLOURS, 16, axis=0), 16, axis=1)
    exif = Image.Exif()
    exif[ORIENTATION] = turn
    Image.fromarray(picture).save(tmp_path / "a.jpg", exif=exif, quality=98, icc_profile=profile(P3, 2.2, "Display P3"))
    for size in (48, 1000):
        (photograph,), _ = copy_photographs([tmp_path / "a.jpg"], tmp_path / f"out{size}", size)
        copy = read_image(tmp_path / f"out{size}" / photograph.name)
        # The middle of each patch, a sixth of the longer side of the picture; JPEG twice.
        along = copy.swapaxes(0, 1) if copy.shape[0] > copy.shape[1] else copy
        step = along.shape[1] / 6
        found = along[along.shape[0] // 2, [int(step * (k + 0.5)) for k in range(6)]]
        assert np.abs(found - srgb_of(COLOURS, P3, 2.2)[0]).max() <= 8


def test_copies_have_the_colours_of_a_pngs_code_points(tmp_path):
    """A PNG without EXIF is decoded to look for it behind the pixels, which closes the file."""
    info = PngImagePlugin.PngInfo()
    info.add(b"cICP", bytes((12, 13, 0, 1)))
    Image.new("RGB", (64, 64), (200, 100, 50)).save(tmp_path / "a.png", pnginfo=info)
    copy_photographs([tmp_path / "a.png"], tmp_path / "out", 32)
    copy = read_image(tmp_path / "out/a.jpg")
    assert np.abs(copy.astype(int) - read_image(tmp_path / "a.png")[:32, :32]).max() <= 3


def test_photographs_reach_no_other_decoders(tmp_path, monkeypatch):
    """What is named .png and is PostScript would start another program."""
    from PIL import EpsImagePlugin

    monkeypatch.setattr(EpsImagePlugin, "EpsImageFile", lambda *a: pytest.fail("PostScript is decoded"))
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\n")
    (tmp_path / "b.jpg").write_bytes(b"\0\0\0\x18ftypheic" + bytes(99))  # as programs rename what phones write
    copies, bad = copy_photographs([tmp_path / "a.png", tmp_path / "b.jpg"], tmp_path / "out", 100)
    assert not copies and len(bad) == 2
    assert "a.png is left out" in bad[0] and "its content is PostScript" in bad[0]
    assert "b.jpg is left out" in bad[1] and "its content is HEIC" in bad[1] and "convert it to JPEG" in bad[1]


def test_groups_by_size_camera_and_focal_length(tmp_path):
    paths = [save(tmp_path / f"in/a{i}.jpg", model="P1", focal=4.2, film=27) for i in range(3)]
    paths += [
        save(tmp_path / "in/zoomed.jpg", model="P1", focal=9.0, film=58),
        save(tmp_path / "in/other.jpg", size=(30, 40)),
    ]
    photographs, _ = copy_photographs(paths, tmp_path / "out", 1000)
    groups = camera_groups(photographs)
    assert [len(group.names) for group in groups] == [3, 1, 1]
    assert [group.known for group in groups] == [True, False, True]
    assert groups[1].focal == pytest.approx(1.2 * 40) and groups[0].model == "SIMPLE_RADIAL"


def test_a_damaged_picture_is_left_out_by_name(tmp_path):
    good = save(tmp_path / "in/a.jpg")
    bad = tmp_path / "in/b.jpg"
    bad.write_bytes(good.read_bytes()[:200])
    photographs, messages = copy_photographs([good, bad], tmp_path / "out", 1000)
    assert [p.name for p in photographs] == ["a.jpg"] and len(messages) == 1 and "b.jpg is left out" in messages[0]


def test_names_that_differ_by_their_ending_do_not_meet(tmp_path):
    paths = [save(tmp_path / "in/a.jpg", size=(400, 300)), save(tmp_path / "in/a.png", size=(400, 300))]
    photographs, _ = copy_photographs(paths, tmp_path / "out", 100)
    assert len({p.name for p in photographs}) == 2


@pytest.mark.parametrize("files,sentence", [
    ([], "three photographs or more .* holds none"),
    (["a.heic", "b.HEIC"], r"2 HEIC pictures need pillow-heif \(pip install 'nerfvol\[heic\]'\); or export"),
    (["walk.mp4"], "give the video itself: walk.mp4"),
    (["a.jpg"], "holds only 1"),
])  # fmt: skip
def test_what_is_no_folder_of_photographs(tmp_path, monkeypatch, files, sentence):
    monkeypatch.setattr(sources, "reads_heif", lambda: False)
    for name in files:
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=sentence):
        find_photographs(tmp_path)


def test_heic_pictures_beside_others_are_told(tmp_path, monkeypatch):
    monkeypatch.setattr(sources, "reads_heif", lambda: False)
    for name in ("a.jpg", "b.jpg", "c.jpg", "d.HEIC"):
        (tmp_path / name).touch()
    found = sources.find_photographs(tmp_path)
    assert len(found) == 3 and sources.left_out(found)[0].startswith("1 HEIC pictures are left out")
    (tmp_path / "d.HEIC").unlink()
    assert sources.left_out(found) == []


def test_heic_pictures_are_read_where_pillow_heif_is(tmp_path):
    """As a phone writes them: turned by EXIF, which the copy is not any more."""
    pytest.importorskip("pillow_heif", reason="needs pillow-heif")
    assert sources.reads_heif()
    picture = np.zeros((48, 64, 3), np.uint8)
    picture[:, :32] = (200, 40, 20)
    for k in range(3):
        (tmp_path / "in").mkdir(exist_ok=True)
        Image.fromarray(picture).save(tmp_path / "in" / f"IMG_{k}.HEIC", format="HEIF", quality=95)
    paths = find_photographs(tmp_path / "in")
    copies, bad = copy_photographs(paths, tmp_path / "out", 1000)
    assert not bad and [c.name for c in copies] == ["IMG_0.jpg", "IMG_1.jpg", "IMG_2.jpg"]
    with Image.open(tmp_path / "out" / "IMG_1.jpg") as copy:
        assert copy.size == (64, 48) and np.abs(np.asarray(copy)[24, 10].astype(int) - (200, 40, 20)).max() < 12


def test_two_thousand_photographs_are_not_in_memory_at_once(tmp_path, monkeypatch):
    """As many are decoded at a time as there are threads, and nothing of them is kept: bytes are counted, not megabytes of
    pictures made. The bound is one picture for each thread; all of them would be 2,000."""
    (tmp_path / "in").mkdir()
    Image.fromarray(np.zeros((30, 40, 3), np.uint8)).save(tmp_path / "in" / "0000.jpg")
    data = (tmp_path / "in" / "0000.jpg").read_bytes()
    for k in range(1, 2000):
        (tmp_path / "in" / f"{k:04d}.jpg").write_bytes(data)
    held, most, lock = [0], [0], threading.Lock()
    transpose, resize = sources.ImageOps.exif_transpose, Image.Image.resize

    def counted(image):
        with lock:
            held[0] += len(image.getbands()) * image.width * image.height
            most[0] = max(most[0], held[0])
        return transpose(image)

    def shrunk(image, *args, **keywords):
        out = resize(image, *args, **keywords)
        with lock:
            held[0] -= len(image.getbands()) * image.width * image.height
        return out

    monkeypatch.setattr(sources.ImageOps, "exif_transpose", counted)
    monkeypatch.setattr(Image.Image, "resize", shrunk)
    monkeypatch.setattr("nerfvol.datasets.images.usable_cores", lambda: 3)
    copies, bad = copy_photographs(find_photographs(tmp_path / "in"), tmp_path / "out", 20)
    assert len(copies) == 2000 and not bad and held[0] == 0
    assert 0 < most[0] <= 3 * 30 * 40 * 3
