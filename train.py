"""``python train.py --data DIR --out RUN ...`` is ``nerfvol train``; without arguments it runs the demo.

The demo makes a synthetic scene, trains an octree on it with configs/demo.yaml, scores it on views it has not seen and
renders a video, all in the folder ``demo``.
"""

import sys
from pathlib import Path

from nerfvol.cli.main import guard
from nerfvol.cli.main import main as command


def main(arguments: list[str]) -> int:
    """Run the command line; the exit code."""
    if arguments:
        return command(["train", *arguments])

    def demo() -> int:
        from nerfvol.cli.demo import run_demo

        return run_demo(Path(__file__).resolve().parent / "configs" / "demo.yaml", Path("demo"))

    return guard(demo)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
