"""``.html``: the model in a page that draws it: interface, kernels as WebAssembly and model in one file for a double click.

Models are stored compact (page_size.py keeps a limit of bytes). The page asks the network for nothing; its
Content-Security-Policy says so to the browser. Everything in it but the model is fixed text of the package ``viewer``, whose
hashes the policy names, and escaped words.
"""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import os
import zlib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from nerfvol import __version__
from nerfvol.cameras.camera import Camera, Intrinsics
from nerfvol.cameras.paths import default_orbit, orbit_cameras
from nerfvol.defaults import WHITE
from nerfvol.errors import InputError
from nerfvol.export.page_size import fitted, stored
from nerfvol.files.atomic import write_text
from nerfvol.files.page import model_element
from nerfvol.files.pictures import to_uint8
from nerfvol.models import Model
from nerfvol.views import OctreeModel, depth_range

POSTER_SIZE = (1120, 630)
POSTER_BYTES = 60_000
ENGINE = ("engine.js", "worker.js")
REMOTE = "remote.js"
PAGE = ("engine.js", "camera.js", "draw.js", REMOTE, "view.js", "path.js")


def memory(model: Model, max_bytes: int | None = None) -> int:
    """Bytes that writing takes: a coarser copy, codes, the page's text."""
    if isinstance(model, OctreeModel):
        return 3 * model.octree.values.nbytes + 100 * model.octree.n_leaves
    return 4 * int(model.describe()["bytes_in_memory"])


def write(model: Model, path: str | os.PathLike[str], max_bytes: int | None = None) -> int:
    """The page; the file's bytes, at most ``max_bytes``.

    Raises:
        InputError: the limit is too small, or the path cannot be written.
    """
    text = page_text(model, Path(path).stem, max_bytes)
    write_text(path, text)
    return len(text.encode())


def page_text(part: Model, name: str, max_bytes: int | None = None) -> str:
    """The page called ``name`` as text; arguments and errors of :func:`write`."""
    settings = page_settings(part, name)
    picture = poster(part, settings)
    data = stored(part)
    page = build_page(settings, picture, data)
    if max_bytes is None or len(page) <= max_bytes:
        return page
    room = (max_bytes - (len(page) - 4 * -(-len(data) // 3))) * 3 // 4
    if room < 2000:
        raise InputError(f"--max-bytes is {max_bytes}, the page takes {len(page) - len(data) * 4 // 3} without a model")
    return build_page(settings, picture, fitted(part, len(data), room))


def resource(name: str) -> bytes:
    """A file of this package; InputError where the installation lacks it."""
    try:
        return resources.files("nerfvol.viewer").joinpath(name).read_bytes()
    except FileNotFoundError as error:
        hint = "; make wasm builds it" if name.endswith(".wasm") else ""
        raise InputError(f"this installation of nerfvol lacks viewer/{name}{hint}") from error


def page_settings(model: Model, name: str) -> dict[str, Any]:
    """What the page knows of a model before it has opened it: words, background, orbit, range of depths; JSON-able."""
    orbit: dict[str, Any] = default_orbit(model.aabb())
    known = model.metadata.get("orbit")
    if isinstance(known, dict) and {"center", "radius", "elevation_deg"} <= known.keys():
        orbit = dict(known)
    cameras = orbit_cameras(4, orbit, (96, 96))
    return {
        "name": name, "orbit": orbit, "background": list(model.metadata.get("background", WHITE)),
        "depths": list(depth_range(model, cameras)), "box": np.asarray(model.aabb(), float).tolist(),
    }  # fmt: skip


def first_camera(orbit: Mapping[str, Any], width: int, height: int) -> Camera:
    """The page's first view in a picture of this size: the orbit's first, whose shorter side fills the shorter side."""
    camera = orbit_cameras(1, orbit, None)[0]
    lens = camera.intrinsics
    focal = lens.fx * min(width, height) / min(lens.width, lens.height)
    return Camera(Intrinsics(width, height, focal, focal, width / 2, height / 2), camera.c2w)


def poster(model: Model, settings: Mapping[str, Any]) -> str:
    """The first view as a WebP of at most POSTER_BYTES, as a data: address."""
    from PIL import Image

    picture = model.render(first_camera(settings["orbit"], *POSTER_SIZE), settings["background"])["rgb"]
    image = Image.fromarray(to_uint8(picture))
    for quality in (80, 60, 40, 20, 5):
        data = io.BytesIO()
        image.save(data, "WEBP", quality=quality, method=4)
        if data.tell() <= POSTER_BYTES:
            break
    return "data:image/webp;base64," + base64.b64encode(data.getvalue()).decode()


def build_page(settings: Mapping[str, Any], poster_address: str, model: bytes | None) -> str:
    """The page's text. model: the file in it, compact; None: it comes from the page's server (viewer/server.py)."""
    names = [name for name in PAGE if name != REMOTE or model is None]
    script = "const remote = null;\n" if model is not None else ""
    script += "\n".join(resource(name).decode().replace('"use strict";', "") for name in names)
    script = f'"use strict";\n{script}'
    style = resource("style.css").decode()
    worker = "\n".join(resource(name).decode() for name in ENGINE)
    for text in (script, worker):
        assert "</script" not in text
    served = " 'self'" if model is None else ""
    policy = (
        f"default-src 'none'; script-src {_hash(script)} 'wasm-unsafe-eval' blob:; style-src {_hash(style)}; "
        f"img-src data: blob:{served}; worker-src blob:; connect-src data:{served}; base-uri 'none'; form-action 'none'"
    )
    parts = {
        "policy": policy, "version": __version__, "title": html.escape(settings["name"]), "style": style,
        "poster": poster_address, "settings": json.dumps(settings, allow_nan=False).replace("<", "\\u003c"),
        "worker": worker, "kernels": base64.b64encode(zlib.compress(resource("kernels.wasm"), 9)).decode(),
        "model": "" if model is None else model_element(model), "script": script,
    }  # fmt: skip
    pieces = resource("page.html").decode().split("{{")
    out = [pieces[0]]
    for piece in pieces[1:]:
        name, _, rest = piece.partition("}}")
        out += [parts[name], rest]
    return "".join(out)


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
