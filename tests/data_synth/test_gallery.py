"""docs/gallery.md: every command is understood, and made the picture above it; so are the commands of docs/data_synth.md."""

import re
from pathlib import Path

import pytest
from PIL import Image

from data_synth import checks, cli, integrators, scenes
from data_synth.cli_options import parser
from tools import gallery

DOCS = Path(__file__).parents[2] / "docs"
GALLERY, COURSE = ((DOCS / name).read_text() for name in ("gallery.md", "data_synth.md"))
LINES = [line.split("#")[0].split() for line in re.findall(r"^nerfvol synth (.+)$", COURSE, re.M)]
COMMANDS = gallery.commands(GALLERY) + [words for words in LINES if words[0] in scenes.SCENES and "--help" not in words]


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_commands_are_understood(words):
    """All that can be said of them before a scene is made, which takes seconds. The integrators are those of the page's table,
    which test_docs.py compares with the scenes."""
    args = parser().parse_args(words)
    assert (args.picture or "").endswith(".jpg") or args.out
    defaults, given = scenes.parameters_of(args.scene), cli._parameters(args)
    for light in given.pop("light", "sun").split(","):
        scenes.named_light(light)
    for key, value in given.items():
        checks.parameter(args.scene, key, value, defaults[key])
    known = re.search(rf"^\| {args.scene} \| (.*?) \|", COURSE, re.M)
    assert known is not None
    name = args.integrator or known[1].split(", ")[0]
    assert name in known[1].split(", ")
    own = {key: getattr(args, key) for key in cli.OWN if getattr(args, key) is not None}
    assert set(own) <= integrators.options(name)
    integrators.make(name, **own)
    assert min(cli._size(args.size)) > 0
    if args.place is not None:
        cli._place(args.place, scenes.make("sphere"))


def test_the_gallery_shows_every_scene_and_its_pictures_are_of_the_size_their_commands_say():
    listed = gallery.pictures(GALLERY)
    files = {path.stem for path in (DOCS / "gallery").glob("*.jpg")}
    assert set(scenes.SCENES) <= set(listed)
    assert files == set(re.findall(r"\]\(gallery/(\w+)\.jpg\)", GALLERY + COURSE))
    for name, words in listed.items():
        with Image.open(DOCS / "gallery" / f"{name}.jpg") as picture:
            assert "{}x{}".format(*picture.size) == gallery.option(words, "--size"), name
        assert (DOCS / "gallery" / f"{name}.jpg").stat().st_size < 200_000, name
