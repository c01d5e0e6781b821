"""RUN/photographs.html: the photographs as thumbnails beside what the model shows of them, the worst first, in one file."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from nerfvol.files.atomic import write_text
from nerfvol.files.pictures import error_map, to_uint8

MOST = 200
"""Photographs on the page, the worst: three thumbnails each make it two or three megabytes."""
SIDE = 180
"""Pixels along the longer side of a thumbnail, at most."""
_STYLE = """body{font:15px system-ui,sans-serif;margin:2em auto;max-width:62em;padding:0 1em;background:#fff;color:#222}
figure{display:flex;gap:.6em;margin:0 0 1em;align-items:center;flex-wrap:wrap}img{image-rendering:auto;border-radius:3px}
figcaption{flex:1 1 16em}b.bad{color:#b00020}small{color:#666}
@media(prefers-color-scheme:dark){body{background:#181818;color:#ddd}small{color:#999}b.bad{color:#ff6b6b}}"""

Pictures = tuple[NDArray[np.floating], NDArray[np.floating]]
"""A photograph (h, w, 3) and what the model shows of it, after its colour map, both in [0, 1]."""


def write_page(
    path: Path, title: str, advice: str, entries: Sequence[tuple[str, str, str]], pictures: Iterable[Pictures]
) -> None:
    """Writes the page. ``entries``: name, what is known of it, remark ("": nothing wrong), the worst first;
    ``pictures``: of the first MOST of them, in this order."""
    rows = [_figure(*entry, *both) for entry, both in zip(entries[:MOST], pictures, strict=False)]
    rest = len(entries) - len(rows)
    more = f"<p>{rest} more photographs fit better than these; photographs.csv has them all.</p>" if rest > 0 else ""
    text = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style><h1>{html.escape(title)}</h1>"
        f"<p>{html.escape(advice)}.</p><p><small>Each row: the photograph, what the model shows from there, and where they "
        f"differ. The worst first.</small></p>{''.join(rows)}{more}</html>\n"
    )
    write_text(path, text)


def _figure(name: str, known: str, remark: str, photograph: NDArray[np.floating], shown: NDArray[np.floating]) -> str:
    said = f'<br><b class="bad">{html.escape(remark)}</b>' if remark else ""
    shown = np.clip(shown, 0, 1).astype(np.float32)
    panels = photograph.astype(np.float32), shown, error_map(photograph.astype(np.float32), shown)
    caption = f"<figcaption><b>{html.escape(name)}</b><br>{html.escape(known)}{said}</figcaption>"
    return f"<figure>{''.join(map(_image, panels))}{caption}</figure>"


def _image(picture: NDArray[np.floating]) -> str:
    image = Image.fromarray(to_uint8(picture))
    scale = min(1.0, SIDE / max(image.size))
    width, height = (max(1, round(side * scale)) for side in image.size)
    data = io.BytesIO()
    image.resize((width, height), Image.Resampling.BOX).save(data, format="JPEG", quality=80)
    code = base64.b64encode(data.getvalue()).decode()
    return f'<img width="{width}" height="{height}" alt="" src="data:image/jpeg;base64,{code}">'
