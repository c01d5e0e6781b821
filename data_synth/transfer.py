"""Transfer functions: what opacity and colour a value of a scan has, and which values of a scan matter.

A function is (n, 5) control points value, opacity, red, green, blue, values ascending, linear in between and constant beyond.
In a file they are lines of five numbers, separated by blanks or commas (a line of names may come first), or JSON: a list of
such rows, or of {"value": ..., "opacity": ..., "colour": [r, g, b]}, or an object with such a list under "points".
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from data_synth.errors import InputError

LARGEST = 1 << 20  # bytes of a file
AIR = 0.1  # part of all samples that a single bin must hold to be what surrounds a scan
TOP = 0.995  # of the samples that are not air: values beyond count as the largest


def read(path: str | os.PathLike) -> np.ndarray:
    """The control points of a file, values in the volume's own unit; opacity and colours in [0, 1]."""
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST:
            raise InputError(f"{path}: expected a transfer function of at most {LARGEST >> 10} KiB")
        text = path.read_text("utf-8")
        rows = _json(text) if path.suffix == ".json" else _lines(text)
        points = np.array(rows, float)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise InputError(f"{path}: expected lines of value, opacity, red, green, blue: {str(error)[:100]}") from error
    shape = points.ndim == 2 and points.shape[1] == 5 and len(points) > 1
    if not shape or not np.isfinite(points).all() or (np.diff(points[:, 0]) <= 0).any():
        raise InputError(f"{path}: expected two or more lines of value, opacity, red, green, blue, values ascending")
    if points[:, 1:].min() < 0 or points[:, 1:].max() > 1:
        raise InputError(f"{path}: expected opacities and colours in [0, 1]")
    return points


def _lines(text: str) -> list[list[float]]:
    lines = [line.split("#")[0].replace(",", " ").replace(";", " ").split() for line in text.splitlines()]
    lines = [line for line in lines if line]
    if lines and all(word.isalpha() for word in lines[0]) and "value" in [word.lower() for word in lines[0]]:
        lines = lines[1:]
    return [[float(word) for word in line] for line in lines]


def _json(text: str) -> list[Any]:
    data = json.loads(text)
    if isinstance(data, dict):
        data = data["points"]
    if not isinstance(data, list):
        raise ValueError("a list of points was expected")
    rows = []
    for point in data:
        if isinstance(point, dict):
            colour = point["colour"] if "colour" in point else point["color"]
            point = [point["value"], point["opacity"], *colour]
        if not isinstance(point, list) or any(isinstance(x, bool) or not isinstance(x, (int, float)) for x in point):
            raise ValueError(f"no point is {json.dumps(point)[:60]}")
        rows.append(point)
    return rows


def window(samples: np.ndarray) -> tuple[float, float]:
    """(what counts as 0, what counts as 1) of a scan: its surroundings, if a bin of the histogram holds a tenth of all, and the
    value below which 99.5 % of the rest lie, so that a few bright samples of metal do not darken the body."""
    low, high = float(samples.min()), float(samples.max())
    if not low < high:
        return low, high
    counts, edges = np.histogram(samples, 256)
    fullest = int(np.argmax(counts[:128]))
    if counts[fullest] > AIR * samples.size:
        low = float(edges[fullest]) if fullest == 0 else float(edges[fullest + 1])
        rest = samples[samples >= edges[fullest + 1]]
        if rest.size:
            high = float(np.quantile(rest, TOP, method="inverted_cdf"))
    return (low, high) if low < high else (low, float(samples.max()))
