"""Makes the pictures of docs/gallery.md again: ``python tools/gallery.py [NAME ...] [--volumes DIR] [--out DIR]``.

Every picture is a command line of ``nerfvol synth``, printed before it runs. Those of real volumes (smoke.vdb, stent.npz) want
the folder that holds them.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from data_synth.cli import main as synth

ROOT = Path(__file__).resolve().parent.parent
TRACED = "--integrator path --spp 16 --denoise --size"
PICTURES = {
    "cloud": f"cloud {TRACED} 480x360",
    "cumulonimbus": f"cumulonimbus {TRACED} 360x360",
    "stratus": f"stratus {TRACED} 640x400",
    "cloudscape": "cloudscape --set detail=0 --set resolution=400 --integrator path --spp 48 --denoise --size 480x300",
    "explosion": f"explosion {TRACED} 360x360",
    "phantom": f"phantom {TRACED} 480x480",
    "smoke": f"smoke {TRACED} 480x480",
    "stent": f"phantom --volume {{volumes}}/stent.npz {TRACED} 360x360",
    "real_smoke": f"smoke --volume {{volumes}}/smoke.vdb {TRACED} 480x480",
    "fog": "fog --side 3 --size 640x480",
    "mist": f"mist {TRACED} 640x480",
    "solids": f"solids {TRACED} 640x480",
    "cloth": f"cloth {TRACED} 480x480",
    "leaf": f"leaf {TRACED} 480x360",
    "showcase": "showcase --size 480x480",
}


def main(argv: list[str]) -> int:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("names", nargs="*", help=f"of {', '.join(PICTURES)}; all if none")
    p.add_argument("--volumes", type=Path, help="folder of real volumes; without it their pictures are left out")
    p.add_argument("--out", type=Path, default=ROOT / "docs" / "gallery")
    args = p.parse_args(argv)
    for name in args.names or PICTURES:
        line = PICTURES.get(name)
        if line is None:
            p.error(f"expected one of {', '.join(PICTURES)}, got {name}")
        if "{volumes}" in line and args.volumes is None:
            print(f"{name}: left out, it wants --volumes")
            continue
        words = [*line.format(volumes=args.volumes).split(), "--picture", str(args.out / f"{name}.jpg")]
        print("nerfvol synth", *words, flush=True)
        if code := synth(words):
            return code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
