"""What the fuzzer damages and who reads it: a file of every kind, made here, small."""

from __future__ import annotations

import contextlib
import copy
import json
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from nerfvol.cameras.paths import load_cameras
from nerfvol.config.assemble import assemble, read_yaml
from nerfvol.config.training import Config
from nerfvol.datasets.load import load_dataset
from nerfvol.files.arrayfile import ArrayFile, write_arrays
from nerfvol.files.checkpoint import save_checkpoint
from nerfvol.measure.truth import load_grid
from nerfvol.models import load_model
from nerfvol.octree.io import save_octree
from nerfvol.octree.tree import Octree
from nerfvol.splats.io import save_splats
from nerfvol.splats.splats import Splats
from nerfvol.training.saved import read_saved
from tests.fixtures import scenes
from tests.splats.written import compressed, unit_chunk

ODD: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 2**31, 2**63, 10**400, -(10**400), 0.5, 1e-320, 1e308, -1e308, float("nan"), float("inf"), "",
    "x", "1e3", "\x1b]0;x\x07", "\ud800", "../../x", "a\0b", [], [[]], [1], [None] * 3, {}, {"a": []}, "9" * 5000,
)  # fmt: skip


# ------------------------------------------------------------------ damage
def places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths to all values inside a document."""
    found = [at] if at else []
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inside in items:
        found += places(inside, (*at, key))
    return found


def odd(rng: random.Random) -> Any:
    """A copy: what is damaged next must not be the list itself."""
    return copy.deepcopy(rng.choice(ODD))


def damaged(document: Any, rng: random.Random) -> Any:
    """The document with one to three of its values changed, gone, doubled or moved."""
    document = json.loads(json.dumps(document))
    for _ in range(rng.randint(1, 3)):
        known = places(document)
        if not known:
            return odd(rng)
        *way, last = rng.choice(known)
        parent = document
        for key in way:
            parent = parent[key]
        kind = rng.randrange(5)
        if kind == 0 and isinstance(parent, dict):
            parent[rng.choice(("format", "frames", "k1", "aabb", "camera_model", "mask_path", "x" * 70))] = odd(rng)
        elif kind == 1 and isinstance(parent, (dict, list)):
            del parent[last]
        elif kind == 2 and isinstance(parent[last], (int, float)) and not isinstance(parent[last], bool):
            factor, more = rng.choice((-1, 0, 2, 0.33, 1e6, 1e-6, 1e300)), rng.choice((0, 1, 1e6))
            with contextlib.suppress(OverflowError):
                parent[last] = parent[last] * factor + more
        elif kind == 3 and isinstance(parent, list):
            parent.insert(rng.randrange(len(parent) + 1), copy.deepcopy(parent[last]))
        else:
            parent[last] = odd(rng)
    return document


def broken(data: bytes, rng: random.Random) -> bytes:
    """Bytes with some flipped, cut, or overwritten with extreme numbers."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        if not out:
            break
        at, kind = rng.randrange(len(out)), rng.randrange(4)
        if kind == 0:
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del out[at:]
        elif kind == 2:
            out[at : at + 8] = rng.choice(
                (b"\xff" * 8, b"\0" * 8, np.float64("nan").tobytes(), (2**40).to_bytes(8, "little"))
            )
        else:
            out[at:at] = bytes(rng.randrange(256) for _ in range(rng.randint(1, 9)))
    return bytes(out)


# ------------------------------------------------------------------ what is read
def of_json(path: Path) -> Callable[[random.Random], None]:
    whole = json.loads(path.read_text())

    def change(rng: random.Random) -> None:
        path.write_text(json.dumps(damaged(whole, rng)), encoding="utf-8", errors="surrogatepass")

    return change


def of_bytes(path: Path) -> Callable[[random.Random], None]:
    whole = path.read_bytes()

    def change(rng: random.Random) -> None:
        path.write_bytes(broken(whole, rng))

    return change


def of_header(path: Path) -> Callable[[random.Random], None]:
    """The document in the header of an array file."""
    with ArrayFile(path, "file") as file:
        document, arrays = file.document, {name: file.read(name) for name in file.shapes}

    def change(rng: random.Random) -> None:
        with contextlib.suppress(ValueError):  # a document that JSON cannot hold
            write_arrays(path, arrays, damaged(document, rng))

    return change


def targets(folder: Path) -> list[tuple[str, Callable[[random.Random], None], Callable[[], object]]]:
    """(name, what damages a file, what reads it)."""
    found = []

    def add(name: str, change: Callable[[random.Random], None], read: Callable[[], object]) -> None:
        found.append((name, change, read))

    def sets(name: str, write: Callable[..., object], *files: str) -> None:
        for file in files:
            home = folder / f"{name}_{len(found)}"
            home.mkdir()
            write(home, scenes.ring(), scenes.random_images())
            path = home / file
            change = of_json(path) if path.suffix == ".json" else of_bytes(path)
            add(f"{name} {file}", change, lambda home=home: load_dataset(home, threads=1).points)

    sets("nerfstudio", scenes.write_nerfstudio, "transforms.json")
    sets("ngp", scenes.write_instant_ngp, "transforms.json", "images/view_003.png")
    sets("colmap", scenes.write_colmap, "sparse/0/images.bin", "sparse/0/cameras.bin")
    sets("text", lambda *a: scenes.write_colmap(*a, text=True), "sparse/0/images.txt", "sparse/0/cameras.txt")
    sets("llff", scenes.write_llff, "poses_bounds.npy")
    sets("nsvf", scenes.write_nsvf, "intrinsics.txt", "pose/0_view_001.txt")

    octree = Octree.from_leaves([1] * 8, np.argwhere(np.ones((2, 2, 2))), [0, 0, 0], 1.0)
    orbit = {"center": [0.5, 0.5, 0.5], "radius": 2.0, "elevation_deg": 20.0, "up": [0, 0, 1], "size": [16, 16]}
    for storage in ("float32", "compact"):
        for how in (of_header, of_bytes):
            path = folder / f"octree_{storage}_{len(found)}.safetensors"
            save_octree(path, octree, {"orbit": orbit, "background": [1, 1, 1]}, storage)
            add(f"octree {storage} {how.__name__}", how(path), lambda path=path: draw(path))
    normal = lambda *shape: np.random.default_rng(0).normal(size=shape).astype(np.float32)  # noqa: E731
    splats = Splats(normal(9, 3), normal(9, 3) - 3, normal(9, 4), normal(9), normal(9, 3, 4))
    for how in (of_header, of_bytes):
        path = folder / f"splats_{len(found)}.safetensors"
        save_splats(path, splats, {"near": 0.01, "orbit": orbit})
        add(f"splats {how.__name__}", how(path), lambda path=path: draw(path))
    rng = np.random.default_rng(0)
    path = folder / "packed.ply"
    compressed(path, [unit_chunk()], rng.integers(0, 1 << 32, (9, 4)).tolist(), rng.integers(0, 256, (9, 9)).tolist())
    add("packed ply", of_bytes(path), lambda path=path: draw(path))
    path = folder / "rows.splat"
    row = [("means", "<f4", 3), ("scales", "<f4", 3), ("rest", "u1", 8)]
    rows = np.zeros(9, row)
    rows["means"], rows["scales"], rows["rest"] = normal(9, 3), np.exp(normal(9, 3) - 3), rng.integers(0, 256, (9, 8))
    path.write_bytes(rows.tobytes())
    add("splat rows", of_bytes(path), lambda path=path: draw(path))
    for how in (of_header, of_bytes):
        path = folder / f"checkpoint_{len(found)}.safetensors"
        state = {"phase": "octree", "elapsed": 1.0, "phase_started": 0.5, "running": 0.1, "log_bytes": 0, "results": {},
                 "steps": {"octree": 3}, "trainer": {"values": np.zeros(3, np.float32)}}  # fmt: skip
        save_checkpoint(path, state)
        add(f"checkpoint {how.__name__}", how(path), lambda path=path: read_saved(path))
    path = folder / "path.json"
    frames = [{"transform_matrix": camera.c2w.tolist()} for camera in scenes.ring(3)]
    path.write_text(json.dumps({"camera_angle_x": 0.7, "w": 16, "h": 16, "frames": frames}))
    add("camera path", of_json(path), lambda: load_cameras(path))
    grid = folder / "density.npz"
    np.savez_compressed(grid, density=np.ones((3, 3, 3)), lo=np.zeros(3), hi=np.ones(3), voxel_size=np.full(3, 1 / 3))
    add("truth", of_bytes(grid), lambda: load_grid(grid))
    yaml = folder / "run.yaml"
    yaml.write_text(
        "seed: 3\ntime_budget: 5m\nbackground: [1, 0, 0]\noctree:\n  steps: 5\n  levels: [5, 6]\nfield:\n  rate: 1e-3\n"
    )
    add("settings", of_bytes(yaml), lambda: assemble(Config, (read_yaml(yaml), str(yaml)), say=lambda sentence: None))
    plain = {"seed": 3, "time_budget": "5m", "background": [1, 0, 0], "octree": {"steps": 5, "sh_degree": 1}}
    values: list[Any] = [plain]
    add("setting's values", lambda rng: values.__setitem__(0, damaged(plain, rng)),
        lambda: assemble(Config, (values[0] if isinstance(values[0], dict) else {}, "a.yaml"), say=len))  # fmt: skip
    return found


def draw(path: Path) -> None:
    """What ``nerfvol render FILE --orbit 1`` does with a model's file."""
    from nerfvol.cameras.paths import orbit_cameras
    from nerfvol.cli.target import open_target

    target = open_target(str(path))
    for camera in orbit_cameras(1, target.orbit(), (8, 8)):
        target.model.render(camera, target.background)
    load_model(path).describe()
