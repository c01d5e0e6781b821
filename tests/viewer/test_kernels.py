"""The page's kernels: made from the sources that are here, and the same pictures as the native ones."""

import hashlib
import json
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from nerfvol.cameras.paths import orbit_cameras
from nerfvol.export.page import resource
from nerfvol.export.page_size import stored
from nerfvol.models import load_model
from nerfvol.native import native
from nerfvol.octree.lod import prefiltered_nodes
from nerfvol.octree.tree import Octree
from nerfvol.views import OctreeModel
from tests.viewer.scenes import ball, cloud_of_splats

ROOT = Path(__file__).resolve().parents[2]
CSRC = ROOT / "nerfvol" / "kernels" / "csrc"
EPS, BACKGROUND, SIZE = 1 / 255, [1.0, 0.5, 0.0], (150, 101)
DRIVER = """
const fs = require("fs"), { Engine } = require(process.argv[2]);
(async () => {
  const job = JSON.parse(fs.readFileSync(process.argv[3])), module = await WebAssembly.compile(fs.readFileSync(job.kernels));
  for (const task of job.tasks) {
    let engine;
    try { engine = await Engine.open(module, new Uint8Array(fs.readFileSync(task.model))); }
    catch (error) { fs.writeFileSync(task.out, error.constructor.name + ": " + error.message); continue; }
    const rows = Math.ceil(task.view.height / 16), parts = [];
    for (const band of task.bands) {
      engine.begin(task.view, band[0], Math.min(band[1], rows));
      for (let row = band[0]; row < Math.min(band[1], rows); ++row) engine.draw(row);
      parts.push(["rgb", "trans", "depth", "median", "normal"].map((name) => engine.floats(name)));
    }
    fs.writeFileSync(task.out, Buffer.concat(parts.flat().map((a) => Buffer.from(a.buffer))));
  }
})();
"""


def test_the_kernels_were_made_from_these_sources():
    if not CSRC.is_dir():
        pytest.skip("the sources are not here")
    stamp = json.loads(resource("kernels.json"))
    stale = [
        name
        for name, digest in stamp["sources"].items()
        if hashlib.sha256((CSRC / name).read_bytes()).hexdigest() != digest
    ]
    assert not stale, f"{', '.join(stale)} changed since kernels.wasm was built: run make wasm and commit what it makes"
    assert hashlib.sha256(resource("kernels.wasm")).hexdigest() == stamp["wasm"]
    assert {"web.cpp", "simd.h", "render.h", "splat_render.h", "topology.cpp"} <= stamp["sources"].keys()


def run_node(folder: Path, tasks: list[dict]) -> None:
    if (node := shutil.which("node")) is None:
        pytest.skip("needs Node")
    kernels = folder / "kernels.wasm"
    kernels.write_bytes(resource("kernels.wasm"))
    (folder / "driver.js").write_text(DRIVER)
    (folder / "engine.js").write_bytes(resource("engine.js"))
    (folder / "job.json").write_text(json.dumps({"kernels": str(kernels), "tasks": tasks}))
    done = subprocess.run(
        [node, folder / "driver.js", folder / "engine.js", folder / "job.json"],
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr


def web_view(camera, lod: float) -> dict:
    lens = camera.intrinsics
    return {
        "c2w": camera.c2w.ravel().tolist(), "fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy, "width": lens.width,
        "height": lens.height, "background": BACKGROUND, "eps": EPS, "lod": lod, "outputs": ["depth", "median", "normal"],
    }  # fmt: skip


def read_bands(path: Path, bands: list[list[int]]) -> dict[str, np.ndarray]:
    """The outputs, each row from the band that drew it."""
    width, height = SIZE
    floats, at = np.fromfile(path, np.float32), 0
    out = {}
    for first, last in bands:
        for name, channels in (("rgb", 3), ("opacity", 1), ("depth", 1), ("median_depth", 1), ("normal", 3)):
            picture = floats[at : at + width * height * channels].reshape(height, width, channels)
            at += picture.size
            out.setdefault(name, np.zeros_like(picture))[16 * first : 16 * last] = picture[16 * first : 16 * last]
    assert at == len(floats)
    out["opacity"] = 1 - out["opacity"]
    return {name: picture[..., 0] if picture.shape[2] == 1 else picture for name, picture in out.items()}


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """(name, lod) -> what the web's kernels draw and what the native ones draw, of one model in two bands."""
    folder = tmp_path_factory.mktemp("node")
    if native() is None:
        pytest.skip("needs the compiled kernels")
    models = {f"octree{d}": ball(d) for d in range(4)} | {
        f"splats{d}": cloud_of_splats(d, mode="plain" if d == 2 else "mip") for d in range(4)
    }
    bands, tasks, native_pictures = [[0, 3], [3, 7]], [], {}
    for name, model in models.items():
        path = folder / f"{name}.safetensors"
        path.write_bytes(stored(model))
        model, camera = load_model(path), orbit_cameras(5, model.metadata["orbit"], SIZE)[2]
        for lod in (0.0, 20.0) if name.startswith("octree") else (0.0,):
            tasks.append(
                {
                    "model": str(path),
                    "view": web_view(camera, lod),
                    "bands": bands,
                    "out": str(folder / f"{name}_{lod:g}.bin"),
                }
            )
            outputs = ("rgb", "opacity", "depth", "median_depth", "normal")
            native_pictures[name, lod] = model.render(camera, BACKGROUND, outputs, EPS, lod), Path(tasks[-1]["out"])
        if isinstance(model, OctreeModel):
            shorten(model.octree)
            for lod in (0.0, 20.0):
                image = model.render(camera, BACKGROUND, outputs, EPS, lod)
                native_pictures[name + " short", lod] = image, native_pictures[name, lod][1]
    run_node(folder, tasks)
    return {key: (read_bands(path, bands), image) for key, (image, path) in native_pictures.items()}


def bfloat16(x: np.ndarray) -> np.ndarray:
    """The nearest float32 that has eight bits of precision, ties to even."""
    bits = x.view(np.uint32)
    return ((bits + 0x7FFF + (bits >> 16 & 1)) >> 16 << 16).astype(np.uint32).view(np.float32)


def shorten(octree: Octree) -> None:
    """Rounds an octree's numbers as a page stores them: the vertices', then those of the nodes made of them."""
    octree.values[...] = bfloat16(octree.values)
    octree.prefiltered = None
    nodes = prefiltered_nodes(octree)
    nodes.values[...] = bfloat16(nodes.values)


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("lod", [0.0, 20.0])
def test_an_octree_looks_the_same(pictures, degree, lod):
    web, image = pictures[f"octree{degree}", lod]
    assert image["opacity"].max() > 0.9 and image["opacity"].min() < 0.1
    for name in ("rgb", "opacity"):  # a number is off by 2^-9 of itself; they and their weights' sums are about 1
        assert np.sqrt(((web[name] - image[name]) ** 2).mean()) < 2**-9, name


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("lod", [0.0, 20.0])
def test_an_octree_of_short_numbers_looks_the_same(pictures, degree, lod):
    """Of numbers that lie between two short ones a rounding of float32 decides: some in 10^5, each seen by few pixels."""
    web, image = pictures[f"octree{degree} short", lod]
    for name in ("rgb", "opacity"):
        off = np.abs(web[name] - image[name])
        assert np.quantile(off, 0.999) < 1e-4 and off.max() < 2**-7, name
    for name in ("depth", "median_depth", "normal"):  # a median jumps, a normal turns where two leaves are as good
        assert np.quantile(np.abs(web[name] - image[name]), 0.999) < 1e-3, name


def test_levels_of_detail_are_drawn(pictures):
    fine, coarse = pictures["octree1", 0.0][0]["rgb"], pictures["octree1", 20.0][0]["rgb"]
    assert np.abs(fine - coarse).max() > 0.02


@pytest.mark.parametrize("degree", range(4))
def test_splats_look_the_same(pictures, degree):
    """Up to alphas that lie on the limit of 1/255 or on that of the last layer: there a rounding decides."""
    web, image = pictures[f"splats{degree}", 0.0]
    assert image["opacity"].max() > 0.9 and image["opacity"].min() < 0.1
    for name in ("rgb", "opacity", "depth", "median_depth", "normal"):
        off = np.abs(web[name] - image[name])
        assert np.quantile(off, 0.99) < 1e-4, name
        assert np.sqrt((off**2).mean()) < 1e-2, name


def test_damaged_models_get_a_sentence(tmp_path):
    camera = orbit_cameras(1, ball().metadata["orbit"], (32, 32))[0]
    tasks = []
    rng = np.random.default_rng(3)
    for kind, data in (("octree", stored(ball(0, 4))), ("splats", stored(cloud_of_splats(0, 40)))):
        for i in range(12):
            bad = bytearray(data)
            if i < 4:
                bad = bad[: int(len(data) * (0.05 + 0.25 * i))]
            else:
                for at in rng.integers(0, len(data), 4 * i):
                    bad[at] = rng.integers(0, 256)
            (tmp_path / f"{kind}{i}").write_bytes(bytes(bad))
            tasks.append(
                {
                    "model": str(tmp_path / f"{kind}{i}"),
                    "view": web_view(camera, 0.0),
                    "bands": [[0, 2]],
                    "out": str(tmp_path / f"{kind}{i}.out"),
                }
            )
    run_node(tmp_path, tasks)
    for task in tasks[:4] + tasks[12:16]:
        said = Path(task["out"]).read_bytes()
        assert said.startswith(b"ModelError: The model in this page cannot be used"), said[:200]
    for task in tasks:
        said = Path(task["out"]).read_bytes()[:200]
        assert not said.startswith((b"Error", b"TypeError", b"RangeError", b"RuntimeError", b"SyntaxError")), said
