"""Which photographs fit the model badly, and what may be wrong with them: a table, and a sentence with advice.

Errors are of small pictures after the photograph's colour map: what stays is a wrong pose, something that moved, or a blur so
large that it shows at an eighth of the size. Sharpness is compared with the neighbours by name, which show about the same.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.datasets.averages import area_average
from nerfvol.datasets.dataset import Dataset
from nerfvol.files.atomic import write_text
from nerfvol.measure.colour_fit import apply_map, exposure
from nerfvol.measure.sharpness import sharpness
from nerfvol.training.phase import FinalPhase
from nerfvol.training.photograph_page import MOST, write_page

JUDGED_SIZE = 320
"""Pixels along the longer side, at least, of pictures whose sharpness is looked at."""
BLURRED = 0.5
"""Of the neighbours' median sharpness."""
NEIGHBOURS = 4
"""To each side."""
ODD_EXPOSURE = 1.4
"""Exposure, or its inverse, from which on a photograph is called bright or dark."""
OFF_PIXELS = 5.0
"""Of a refined pose, from which on a photograph's remark says so."""
BAD_DB, BAD_DEVIATIONS = 3.0, 3.5
"""A photograph is bad that lies so many dB below the median and so many robust deviations."""
NAMED = 5


@dataclass(frozen=True)
class Row:
    """psnr: of a small picture after its colour map, dB; sharpness: of its neighbours' median; exposure: of the mean; moved: by
    how many pixels refining its pose moved what it shows, None where poses stayed; index: of the training view."""

    name: str
    psnr: float
    sharpness: float
    exposure: float
    moved: float | None
    remark: str
    index: int


def write_table(path: Path, dataset: Dataset, phase: FinalPhase) -> str:
    """Writes a row for each training photograph as CSV, the worst first, and the page of thumbnails beside it; returns a
    sentence for a person."""
    small: _Small = {}
    rows = sorted(make_rows(dataset, phase, small), key=lambda row: row.psnr)
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    out.writerow(
        ["photograph", "psnr_small_db", "sharpness_of_neighbours", "exposure_of_mean", "pose_moved_pixels", "remark"]
    )
    for row in rows:
        moved = "" if row.moved is None else f"{row.moved:.2f}"
        out.writerow([row.name, f"{row.psnr:.2f}", f"{row.sharpness:.2f}", f"{row.exposure:.3f}", moved, row.remark])
    write_text(path, text.getvalue())
    said, page = advice(rows, path.name), path.with_suffix(".html")
    entries = [(row.name, _known(row), row.remark) for row in rows]
    write_page(
        page, f"{len(rows)} photographs", said, entries, (_pictures(phase, row.index, small) for row in rows[:MOST])
    )
    return f"{said.removesuffix(')')}; thumbnails: {page.name})"


def _known(row: Row) -> str:
    moved = "" if row.moved is None else f", pose moved by {row.moved:.1f} pixels"
    return f"{row.psnr:.1f} dB, sharpness {row.sharpness:.2f} of neighbours', exposure {row.exposure:.2f} of the mean{moved}"


_Small = dict[int, tuple[NDArray[np.uint8], NDArray[np.uint8], Any]]
"""By view: its small photograph, what the model shows, both of 8 bits, and the pixels' weights."""


def _pictures(phase: FinalPhase, i: int, small: _Small) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """View i small, as it was taken and as the model shows it; what is masked is black in both."""
    photograph, shown, weight = small[i] if i in small else _eight_bits(*phase.seen(i))
    counts = np.asarray(weight)[..., None] > 0
    mapped = apply_map(phase.appearance.maps[i], shown / np.float32(255))
    return photograph / np.float32(255) * counts, np.clip(mapped, 0, 1) * counts


def _eight_bits(photograph: Any, shown: Any, weight: Any) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Any]:
    first, second = (np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8) for picture in (photograph, shown))
    return first, second, weight


def make_rows(dataset: Dataset, phase: FinalPhase, small: _Small | None = None) -> list[Row]:
    """A row for each photograph of ``dataset``, in its order; ``small`` keeps the pictures that were drawn for it, of the first
    MOST views."""
    maps = phase.appearance.maps
    errors = np.empty(len(dataset))
    for i in range(len(dataset)):
        seen = phase.seen(i)
        errors[i] = _psnr(*seen, maps[i])
        if small is not None and i < MOST:
            small[i] = _eight_bits(*seen)
    own = dataset.pyramid((1, 1, 1), 1, lambda image: sharpness(_grey(image)))
    sharp = relative_to_neighbours(np.array(own), dataset.names)
    bad, refined = outliers(errors), phase.refined()
    rows = []
    for i, name in enumerate(dataset.names):
        gain = exposure(maps[i])
        remarks = ["fits badly"] if bad[i] else []
        remarks += ["blurred"] if sharp[i] < BLURRED else []
        remarks += ["bright"] if gain > ODD_EXPOSURE else ["dark"] if gain < 1 / ODD_EXPOSURE else []
        moved = None if refined is None else float(refined.pixels[i])
        remarks += ["pose was off"] if moved is not None and moved > OFF_PIXELS else []
        rows.append(Row(name, float(errors[i]), float(sharp[i]), gain, moved, ", ".join(remarks), i))
    return rows


def advice(rows: Sequence[Row], table: str) -> str:
    """One sentence: which photographs to look at, and what to do with them."""
    bad = sorted((row for row in rows if "fits badly" in row.remark), key=lambda row: row.psnr)
    blurred = [row.name for row in rows if "blurred" in row.remark and row not in bad]
    usual = float(np.median([row.psnr for row in rows]))
    if bad:
        names = ", ".join(f"{row.name} ({row.psnr:.0f} dB)" for row in bad[:NAMED])
        more = f" and {len(bad) - NAMED} more" if len(bad) > NAMED else ""
        what = "blurred, take them again" if all("blurred" in row.remark for row in bad) else (
            "something moved, or their poses are wrong: leave them out"
        )  # fmt: skip
        said = f"{len(bad)} of {len(rows)} photographs fit badly, where {usual:.0f} dB is usual"
        return f"{said}: {names}{more}; {what} ({table})"
    if blurred:
        names = ", ".join(blurred[:NAMED])
        more = f" and {len(blurred) - NAMED} more" if len(blurred) > NAMED else ""
        said = f"{len(blurred)} of {len(rows)} photographs are blurred: {names}{more}"
        return f"{said}; the scene is sharper without them ({table})"
    return f"no photograph fits much worse than the others ({table})"


def outliers(psnr: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which of the values (n,) lie far below the others."""
    middle = np.median(psnr)
    deviation = 1.4826 * np.median(np.abs(psnr - middle))
    return psnr < middle - max(BAD_DB, BAD_DEVIATIONS * float(deviation))


def relative_to_neighbours(values: NDArray[np.floating], names: Sequence[str]) -> NDArray[np.float64]:
    """Each value (n,) over the median of its neighbours by name."""
    order = sorted(range(len(names)), key=lambda i: names[i])
    out = np.ones(len(values))
    for place, i in enumerate(order):
        near = [
            order[k] for k in range(max(0, place - NEIGHBOURS), min(len(order), place + NEIGHBOURS + 1)) if k != place
        ]
        middle = float(np.median(values[near])) if near else 0.0
        out[i] = values[i] / middle if middle > 0 else 1.0
    return out


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    small = area_average(image, max(1, max(image.shape[:2]) // JUDGED_SIZE))
    return small[..., :3].mean(axis=2).astype(np.uint8)


def _psnr(photograph: Any, shown: Any, weight: Any, colour_map: Any) -> float:
    difference = np.clip(apply_map(colour_map, np.clip(shown, 0, 1)), 0, 1) - photograph
    total = float(np.sum(weight, dtype=np.float64)) * 3
    error = float((difference.astype(np.float64) ** 2 * np.asarray(weight)[..., None]).sum())
    return -10 * float(np.log10(max(error / max(total, 1e-9), 1e-10)))
