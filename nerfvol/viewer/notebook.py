"""Models in notebooks: the page in a frame, or a picture where the page would make the notebook too large."""

from __future__ import annotations

import html

from nerfvol.export.page import build_page, page_settings, poster
from nerfvol.export.page_size import stored
from nerfvol.models import Model

MOST_BYTES = 6_000_000
"""Of a compact model in a cell: notebooks keep their cells' output, eight bytes for six."""
HEIGHT = 480
"""Of the frame, pixels."""


def repr_html(model: Model) -> str:
    """A frame with the model's page (srcdoc: no file and no server), or the first view as a picture."""
    settings = page_settings(model, f"{model.kind}")
    picture = poster(model, settings)
    data = stored(model)
    if len(data) > MOST_BYTES:
        note = f"{len(data) / 1e6:.1f} MB, too large for a notebook's cell: nerfvol view shows it"
        return f'<figure><img src="{picture}" style="max-width:100%" alt=""><figcaption>{note}</figcaption></figure>'
    page = html.escape(build_page(settings, picture, data), quote=True)
    style = f"width:100%;height:{HEIGHT}px;border:0"
    return f'<iframe srcdoc="{page}" style="{style}" sandbox="allow-scripts allow-downloads" title="{model.kind}"></iframe>'
