"""Damaged files of splats and points: each must load, or be refused in one sentence, quickly and in little memory.

``python -m tests.splats.fuzz --rounds 5000 --seed 1`` tries many; the tests try some.
"""

from __future__ import annotations

import argparse
import gzip
import importlib.util
import struct
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from nerfvol.errors import InputError
from nerfvol.models import load_model
from nerfvol.splats.ply import save_ply
from nerfvol.splats.plyfile import write_ply
from nerfvol.splats.spz import save_spz
from tests.splats.scenes import random_splats
from tests.splats.written import compressed, unit_chunk

MOST_BYTES = 64 << 20
"""Of Python's and numpy's memory, for files of some kilobytes."""
MOST_SECONDS = 20.0
"""Of the processor. Nothing of the kind takes a tenth; more is a loop that goes by a number in the file."""
NUMBERS = (0, 1, 255, 1 << 16, (1 << 31) - 1, (1 << 32) - 1)
WORDS = b"-1 0 1e9 99999999999999999999 nan list double char ascii vertex".split() + [b"\n", b""]


def damaged(data: bytes, random: np.random.Generator) -> bytes:
    """``data`` with one to four changes: bits, cuts, pieces twice or elsewhere, numbers and words that lie."""
    out = bytearray(data)
    for _ in range(random.integers(1, 5)):
        if not out:
            break
        at, kind = int(random.integers(len(out)) * random.random() ** 2), random.integers(7)  # rather in the header
        size = int(random.integers(1, 64))
        if kind == 0:
            out[at] ^= 1 << int(random.integers(8))
        elif kind == 1:
            del out[at:]
        elif kind == 2:
            del out[at : at + size]
        elif kind == 3:
            out[at:at] = out[at : at + size] * int(random.integers(1, 4))
        elif kind == 4:
            out[at : at + 4] = struct.pack("<I", NUMBERS[random.integers(len(NUMBERS))])
        elif kind == 5:
            out[at:at] = random.bytes(size)
        else:
            words = bytes(out[:600]).split(b" ")
            k = int(random.integers(len(words)))
            words[k] = WORDS[random.integers(len(WORDS))]
            out[:600] = b" ".join(words)
    return bytes(out)


def sources(folder: Path) -> dict[str, tuple[str, bytes, Callable[[bytes], bytes]]]:
    """Good files by name: their suffix, what is damaged of them, and what then is done to it to make a file."""

    def as_it_is(data: bytes) -> bytes:
        return data

    def written(suffix: str, save: Callable[[Path], object]) -> tuple[str, bytes, Callable[[bytes], bytes]]:
        save(folder / f"good{suffix}")
        return suffix, (folder / f"good{suffix}").read_bytes(), as_it_is

    splats, rng = random_splats(40, 4, 0), np.random.default_rng(0)
    points = {c: rng.normal(size=40).astype(np.float32) for c in "xyz"}
    points |= {c: rng.integers(0, 255, 40).astype(np.uint8) for c in ("red", "green", "blue")}
    rows = b"".join(b"%g %g %g %d\n" % (*rng.normal(size=3), k) for k in range(30))
    text = b"ply\nformat ascii 1.0\nelement vertex 30\n" + b"".join(b"property float %c\n" % c for c in b"xyz")
    out = {
        "splats.ply": written(".ply", lambda path: save_ply(path, splats)),
        "points.ply": written(".ply", lambda path: write_ply(path, [], points)),
        "text.ply": (".ply", text + b"property uchar red\nend_header\n" + rows, as_it_is),
    }
    compressed(folder / "packed.ply", [unit_chunk()], rng.integers(0, 1 << 32, (40, 4)).tolist(),
               rng.integers(0, 256, (40, 9)).tolist())  # fmt: skip
    out["packed.ply"] = (".ply", (folder / "packed.ply").read_bytes(), as_it_is)
    out["rows.splat"] = (".splat", b"".join(
        struct.pack("<6f8B", *rng.normal(size=3), *rng.uniform(0, 1, 3), *rng.integers(0, 256, 8)) for _ in range(40)
    ), as_it_is)  # fmt: skip
    if not importlib.util.find_spec("gsply"):
        return out
    out["3.spz"] = written(".spz", lambda path: save_spz(path, splats, 3))
    if importlib.util.find_spec("zstandard"):
        out["4.spz"] = written(".spz", lambda path: save_spz(path, splats, 4))
    inner = gzip.decompress(out["3.spz"][1])
    return out | {"inside.spz": (".spz", inner, lambda data: gzip.compress(data, 1, mtime=0))}


def verdict(path: Path) -> str:
    """What became of a file: "loaded", or the sentence. AssertionError where the sentence is none, or it took too much."""
    began = time.process_time()
    tracemalloc.start()
    try:
        load_model(path)
        said = "loaded"
    except InputError as error:
        said = str(error)
        assert str(path) in said and "\n" not in said and len(said) < 600 + len(str(path)), said
    finally:
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert most < MOST_BYTES, f"{most / 2**20:.0f} MB"
    assert time.process_time() - began < MOST_SECONDS, "it took too long"
    return said.replace(str(path), "FILE")


def verdicts(name: str, folder: Path, rounds: int, seed: int) -> Iterator[str]:
    """Of ``rounds`` damaged files of the source ``name``; one that is no verdict is kept in ``folder``, and raised."""
    suffix, good, finish = sources(folder)[name]
    for k in range(rounds):
        path = folder / f"damaged_{seed}_{k}{suffix}"
        path.write_bytes(finish(damaged(good, np.random.default_rng([seed, k]))))
        try:
            yield verdict(path)
        except Exception as error:
            raise AssertionError(f"{path} (seed {seed}, round {k}): {type(error).__name__}: {error}") from error
        path.unlink()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp())
    for name in sources(folder):
        said = list(verdicts(name, folder, options.rounds, options.seed))
        print(f"{name}: {said.count('loaded')} of {len(said)} loaded, {len(set(said))} different verdicts", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
