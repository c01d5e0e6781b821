"""Several media as one value whose type does not depend on how many there are, so that nothing is compiled anew."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from data_synth.detail import Detail
from data_synth.fields import Columns
from data_synth.jit import jit
from data_synth.media import Medium
from data_synth.microflakes import Table
from data_synth.phase import NO_OWN, Phase

ARRAYS = ("offsets", "samples", "attributes", "brick_max", "brick_min", "albedo", "Le", "fields", "faults")


class Media(NamedTuple):
    """numbers: (n, 56) the numbers of each medium; first: (n + 1, 12) where its arrays start in the arrays of all."""

    numbers: np.ndarray
    first: np.ndarray
    offsets: np.ndarray
    samples: np.ndarray
    attributes: np.ndarray
    brick_max: np.ndarray
    brick_min: np.ndarray
    albedo: np.ndarray
    Le: np.ndarray
    fields: np.ndarray
    faults: np.ndarray
    S: np.ndarray
    detail: np.ndarray
    flakes: np.ndarray


def pool(media: Sequence[Medium]) -> Media:
    """Put the arrays of several media one behind the other."""
    numbers, first = np.zeros((len(media), 56)), np.zeros((len(media) + 1, 12), np.int64)
    for k, m in enumerate(media):
        row = [m.kind, *m.lo, *m.hi, *m.cells, *m.bricks, *m.cell, m.max_density, *m.sigma_t, m.base, m.falloff, m.step]
        row += [m.flake_area, m.phase.kind, m.phase.g1, m.phase.g2, m.phase.mix, *m.columns, m.function]
        row += [*m.detail.tiles, m.detail.erosion, m.detail.octaves, m.detail.n, m.detail.p]
        row += [m.phase.micro, m.phase.roughness, m.phase.ior, *m.phase.table[1:], m.detail.contrast]
        numbers[k, : len(row)] = row
        first[k + 1] = first[k] + [len(array) for array in _arrays(m)]
    empty = [np.zeros(0, np.int64), np.zeros(0, np.float32), np.zeros(0, np.float32), np.zeros(0), np.zeros(0)]
    empty += [np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, np.float32), np.zeros(0), np.zeros((0, 6))]
    empty += [np.zeros(0, np.float32), np.zeros(0)]
    own = [_arrays(m) for m in media]
    return Media(numbers, first, *(np.concatenate(a) for a in zip(empty, *own, strict=True)))


def _arrays(m: Medium) -> list[np.ndarray]:
    return [*(getattr(m, name) for name in ARRAYS), m.phase.S, m.detail.values, m.phase.table.values]


@jit
def medium_at(media, k):
    """Medium k of the pool."""
    n, a, b = media.numbers[k], media.first[k], media.first[k + 1]
    return Medium(
        int(n[0]),
        (n[1], n[2], n[3]),
        (n[4], n[5], n[6]),
        (int(n[7]), int(n[8]), int(n[9])),
        (int(n[10]), int(n[11]), int(n[12])),
        (n[13], n[14], n[15]),
        media.offsets[a[0] : b[0]],
        media.samples[a[1] : b[1]],
        media.attributes[a[2] : b[2]],
        media.brick_max[a[3] : b[3]],
        media.brick_min[a[4] : b[4]],
        n[16],
        (n[17], n[18], n[19]),
        media.albedo[a[5] : b[5]],
        media.Le[a[6] : b[6]],
        n[20],
        n[21],
        n[22],
        n[23],
        Phase(
            int(n[24]),
            n[25],
            n[26],
            n[27],
            media.S[a[9] : b[9]],
            int(n[43]),
            n[44],
            n[45],
            Table(media.flakes[a[11] : b[11]], int(n[46]), int(n[47]), int(n[48])),
            NO_OWN,
        ),
        media.fields[a[7] : b[7]],
        Columns(int(n[28]), int(n[29]), int(n[30]), int(n[31]), int(n[32]), int(n[33]), int(n[34])),
        int(n[35]),
        media.faults[a[8] : b[8]],
        Detail(media.detail[a[10] : b[10]], int(n[41]), int(n[42]), (n[36], n[37], n[38]), n[39], int(n[40]), n[49]),
    )
