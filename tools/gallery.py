"""Makes the pictures of docs/gallery.md again: ``python tools/gallery.py [NAME ...] [--volumes DIR] [--out DIR]``.

The page itself is the list: below each heading stands the command that made the picture, and that is what runs here. Those of
real volumes (smoke.vdb, stent.npz) want the folder that holds them.
"""

from __future__ import annotations

import argparse
import re
import shlex
import sys
import time
from pathlib import Path

from data_synth.cli import main as synth

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "gallery.md"


def commands(page: str) -> list[list[str]]:
    """The words after ``nerfvol synth`` of every command of the page, from top to bottom."""
    return [shlex.split(line) for line in re.findall(r"^    nerfvol synth (.+)$", page, re.M)]


def option(words: list[str], name: str) -> str | None:
    """What follows an option of a command, None where it is not there."""
    return words[words.index(name) + 1] if name in words else None


def pictures(page: str) -> dict[str, list[str]]:
    """The commands that write a picture which the page shows, by its name."""
    shown = set(re.findall(r"\]\(gallery/(\w+)\.jpg\)", page))
    made = {str(option(words, "--picture")).removesuffix(".jpg"): words for words in commands(page)}
    return {name: words for name, words in made.items() if name in shown}


def main(argv: list[str]) -> int:
    listed = pictures(PAGE.read_text())
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("names", nargs="*", help=f"of {', '.join(listed)}; all if none")
    p.add_argument("--volumes", type=Path, help="folder of real volumes; without it their pictures are left out")
    p.add_argument("--out", type=Path, default=PAGE.parent / "gallery")
    p.add_argument("--smaller", type=int, default=1, metavar="N", help="drafts with 1/N of the width and of the height")
    args = p.parse_args(argv)
    for name in args.names or listed:
        if name not in listed:
            p.error(f"expected one of {', '.join(listed)}, got {name}")
        words = list(listed[name])
        words[words.index("--picture") + 1] = str(args.out / f"{name}.jpg")
        volume = option(words, "--volume")
        if volume is not None:
            if args.volumes is None:
                print(f"{name}: left out, it wants --volumes")
                continue
            words[words.index("--volume") + 1] = str(args.volumes / volume)
        size = [int(n) // args.smaller for n in str(option(words, "--size")).split("x")]
        words[words.index("--size") + 1] = "x".join(map(str, size))
        print("nerfvol synth", shlex.join(words), flush=True)
        started = time.process_time()
        if code := synth(words):
            return code
        print(f"{name}: {time.process_time() - started:.0f} CPU s")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
