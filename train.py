"""``python train.py --data DIR --out RUN ...`` is ``nerfvol train``; without arguments it is ``nerfvol demo``."""

import sys

from nerfvol.cli.main import main

if __name__ == "__main__":
    arguments = sys.argv[1:]
    sys.exit(main(["train", *arguments] if arguments else ["demo"]))
