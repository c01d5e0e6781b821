"""Models inside web pages: an HTML file that holds a model's file, byte by byte, in base64 (docs/viewer.md).

Reading takes the text of one element and nothing else: no script is run, no reference followed.
"""

from __future__ import annotations

import base64
import binascii
import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from nerfvol.errors import InputError
from nerfvol.files.atomic import explain_os_error

SUFFIXES = (".html", ".htm")
OPENING = '<script id="model" type="application/octet-stream">'
CLOSING = "</script>"


def is_page(path: str | os.PathLike[str]) -> bool:
    """Whether a file of that name is taken for a page."""
    return Path(path).suffix.lower() in SUFFIXES


def model_element(data: bytes) -> str:
    """The element of a page that holds ``data``."""
    return OPENING + base64.b64encode(data).decode("ascii") + CLOSING


def read_model(path: str | os.PathLike[str]) -> bytes:
    """The bytes of the model's file in the page ``path``.

    Raises:
        InputError: it cannot be read, holds no model, or one that is cut off.
    """
    try:
        page = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {explain_os_error(error)}") from error
    start = page.rfind(OPENING.encode())
    if start < 0:
        raise InputError(f"{path} holds no model: it is no page that nerfvol export wrote")
    end = page.find(CLOSING.encode(), start)
    if end < 0:
        raise InputError(f"{path} is not whole: the model in it is cut off")
    try:
        return base64.b64decode(page[start + len(OPENING) : end], validate=True)
    except binascii.Error as error:
        raise InputError(f"{path} is damaged: the model in it is no base64 ({error})") from error


@contextlib.contextmanager
def model_file(path: Path) -> Iterator[Path]:
    """``path``, or, where that is a page, a temporary file of the model in it; errors name the page."""
    if not is_page(path):
        yield path
        return
    data = read_model(path)
    with tempfile.TemporaryDirectory() as folder:
        inside = Path(folder) / "model.safetensors"
        inside.write_bytes(data)
        try:
            yield inside
        except InputError as error:
            raise InputError(str(error).replace(str(inside), f"the model in {path}")) from error
