"""Masks of photographs whose cameras are sought: copied as the photographs are, and no features where they leave pixels out."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerfvol.datasets.load import load_dataset
from nerfvol.errors import InputError
from nerfvol.poses.engine import DATABASE, Job, extract
from nerfvol.poses.make import make_poses
from nerfvol.poses.masks import copy_masks, find_masks
from nerfvol.poses.sources import camera_groups, copy_photographs, find_photographs
from tests.poses.test_make import SETTINGS, photos, stub  # noqa: F401  (a fixture)

OUT = np.zeros((48, 64), bool)
OUT[10:30, 40:64] = True
"""What each mask leaves out."""


def write_masks(folder: Path, convention: str, names: list[str], out: np.ndarray = OUT) -> None:
    kept, dropped = (Image.fromarray(np.where(o, 0, 255).astype(np.uint8)) for o in (out, ~out))
    (folder / "masks").mkdir(exist_ok=True)
    for name in names:
        if convention == "dynamic":
            dropped.save(folder / f"dynamic_mask_{Path(name).stem}.png")
        elif convention == "beside":
            kept.save(folder / f"{Path(name).stem}_mask.png")
        else:
            kept.save(folder / "masks" / (f"{name}.png" if convention == "colmap" else f"{Path(name).stem}.png"))


@pytest.mark.parametrize("convention", ["colmap", "by stem", "dynamic", "beside"])
def test_masks_go_with_their_photographs_into_the_scene(photos, tmp_path, convention):  # noqa: F811
    names = [path.name for path in find_photographs(photos)]
    write_masks(photos, convention, names[:4])
    assert [path.name for path in find_photographs(photos)] == names  # masks are no photographs
    said = []
    make_poses(photos, tmp_path / "out", SETTINGS, said.append, engine=stub)
    assert any(sentence.startswith("4 of 9 photographs have masks") for sentence in said)
    data = load_dataset(tmp_path / "out", "train")
    masks = {name: data.mask(i) for i, name in enumerate(data.names)}
    assert (masks["p1"] == np.where(OUT, 0, 255)).all() and masks["p7"] is None
    (photos / "masks").joinpath("p7.png").write_bytes((tmp_path / "out" / "masks" / "p1.png.png").read_bytes())
    make_poses(photos, tmp_path / "out", SETTINGS, said.append, engine=stub)  # another mask: begun anew
    assert (tmp_path / "out" / "masks" / "p7.png.png").is_file()


@pytest.mark.parametrize("painted", ["as stored", "upright"])
def test_copies_are_upright_and_of_the_photograph_s_size(tmp_path, painted):
    """Orientation 6: what is right in the file is below in the picture. A smaller pixel that shows a part of what is left out
    is left out."""
    exif = Image.Exif()
    exif[0x0112] = 6
    (tmp_path / "in" / "masks").mkdir(parents=True)
    for k in range(3):
        Image.new("RGB", (64, 48)).save(tmp_path / "in" / f"p{k}.jpg", exif=exif)
    mask = np.full((48, 64), 255, np.uint8)
    mask[:, 41:] = 0
    mask = np.rot90(mask, -1) if painted == "upright" else mask
    Image.fromarray(mask).save(tmp_path / "in" / "masks" / "p1.png")
    paths = find_photographs(tmp_path / "in")
    photographs, _ = copy_photographs(paths, tmp_path / "out" / "images", 32)
    copy_masks(find_masks(tmp_path / "in", paths), tmp_path / "in", photographs, tmp_path / "out" / "masks")
    made = np.asarray(Image.open(tmp_path / "out" / "masks" / "p1.jpg.png"))
    assert made.shape == (32, 24) and (made[:20] == 255).all() and (made[20:] == 0).all()


@pytest.mark.parametrize("out,sentence", [
    (np.zeros((30, 64), bool), "p0.png: expected a mask of 64x48 pixels like its image, got 64x30"),
    (np.ones((48, 64), bool), "the masks of all 9 photographs leave nothing to look at"),
])  # fmt: skip
def test_masks_that_cannot_be_are_one_sentence(photos, tmp_path, out, sentence):  # noqa: F811
    write_masks(photos, "by stem", [path.name for path in find_photographs(photos)], out)
    with pytest.raises(InputError, match=sentence):
        make_poses(photos, tmp_path / "out", SETTINGS, lambda said: None, engine=stub)


def test_what_is_masked_has_no_features(tmp_path):
    """One photograph of noise with a mask, two without any."""
    pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap")
    rng, paths = np.random.default_rng(0), []
    (tmp_path / "images").mkdir()
    for k in range(3):
        noise = rng.integers(0, 255, (24, 32, 3), np.uint8)
        Image.fromarray(noise).resize((320, 240), Image.Resampling.BICUBIC).save(tmp_path / "images" / f"p{k}.png")
        paths.append(tmp_path / "images" / f"p{k}.png")
    photographs, _ = copy_photographs(paths, tmp_path / "scene" / "images", 320)
    (tmp_path / "masks").mkdir()
    half = np.full((240, 320), 255, np.uint8)
    half[:, 160:] = 0
    Image.fromarray(half).save(tmp_path / "masks" / "p1.png")
    copy_masks(find_masks(tmp_path, paths), tmp_path / "images", photographs, tmp_path / "scene" / "masks")
    groups = [dataclasses.asdict(group) for group in camera_groups(photographs)]
    (tmp_path / "work").mkdir()
    folders = (str(tmp_path / "scene" / "images"), str(tmp_path / "work"))
    extract(Job(*folders, groups, threads=1, masks=str(tmp_path / "scene" / "masks")), lambda *progress: None)
    with pycolmap.Database.open(tmp_path / "work" / DATABASE) as database:
        places = {image.name: database.read_keypoints(image.image_id) for image in database.read_all_images()}
    right = {name: float((np.asarray(points)[:, 0] > 161).mean()) for name, points in places.items()}
    assert right["p1.png"] == 0 and len(places["p1.png"]) > 20 and right["p0.png"] > 0.3 and right["p2.png"] > 0.3
