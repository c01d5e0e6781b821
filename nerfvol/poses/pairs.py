"""Which pairs of photographs to match: all where that is cheap; else neighbours by name and those that look alike.

Two photographs look alike where the residuals of their features to a small vocabulary, summed by word, point the same way
(VLAD: Jegou et al., "Aggregating local descriptors into a compact image representation", CVPR 2010). The vocabulary is made
of the photographs' own descriptors, so that nothing is downloaded; it finds where a walk meets its own path again.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Descriptors = NDArray[np.uint8]
WORDS = 64
ROUNDS = 8
PER_PICTURE = 600
"""Descriptors of a picture that are looked at."""
ALL = "all pairs"
ALL_PAIRS = 3200
"""Most pairs of which all are matched: those that share nothing are dear, for RANSAC looks longest there (15 ms each)."""
NEIGHBOURS = 5
ALIKE = 6


def in_order(name: str) -> list[tuple[int, str]]:
    """A key that sorts names as people number them: 2.jpg before 10.jpg."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"([0-9]+)", name.lower())]


def choose_pairs(descriptors: Sequence[Descriptors], seed: int = 0) -> tuple[list[tuple[int, int]], str]:
    """Pairs (i, j), i < j, of pictures with the SIFT ``descriptors`` (n_i, 128) uint8, in the order of their names; and how
    they were chosen, in words."""
    n = len(descriptors)
    if n * (n - 1) / 2 <= ALL_PAIRS:
        return [(i, j) for i in range(n) for j in range(i + 1, n)], ALL
    steps = [*range(1, NEIGHBOURS + 1), *(2**k for k in range(3, n.bit_length()) if 2**k < n)]
    pairs = {(i, i + step) for step in steps for i in range(n - step)}
    pairs |= alike(descriptors, seed)
    return sorted(pairs), f"neighbours by name and the {ALIKE} that look most alike"


def alike(descriptors: Sequence[Descriptors], seed: int = 0) -> set[tuple[int, int]]:
    """For each picture its ALIKE most similar ones, neighbours by name left out, as pairs (i, j), i < j."""
    vectors = _vlad(descriptors, seed)
    similarity = vectors @ vectors.T
    n = len(vectors)
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= NEIGHBOURS
    similarity[near] = -np.inf
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :ALIKE]
    found = {(min(i, int(j)), max(i, int(j))) for i in range(n) for j in order[i] if np.isfinite(similarity[i, j])}
    return found


def _vlad(descriptors: Sequence[Descriptors], seed: int) -> NDArray[np.float32]:
    """(n, WORDS * 128) unit vectors; zero for a picture without features."""
    random = np.random.default_rng(seed)
    some = []
    for own in descriptors:
        rows = own if len(own) <= PER_PICTURE else own[np.sort(random.permutation(len(own))[:PER_PICTURE])]
        some.append(rows.astype(np.float32))
    everything = np.concatenate(some)
    if len(everything) < WORDS:
        return np.zeros((len(some), 1), np.float32)
    # Vocabulary: k-means from random descriptors.
    sample = everything[random.permutation(len(everything))[: 200 * WORDS]]
    words = sample[:WORDS].copy()
    for _ in range(ROUNDS):
        nearest = _nearest(sample, words)
        for k in range(WORDS):
            if (members := sample[nearest == k]).size:
                words[k] = members.mean(0)
    out = np.zeros((len(some), WORDS, sample.shape[1]), np.float32)
    for picture, rows in zip(out, some, strict=True):
        if len(rows):
            nearest = _nearest(rows, words)
            np.add.at(picture, nearest, rows - words[nearest])
    out = np.sign(out) * np.sqrt(np.abs(out))  # tames words that occur in bursts
    out = out.reshape(len(some), -1)
    length = np.linalg.norm(out, axis=1, keepdims=True)
    return (out / np.where(length > 0, length, 1)).astype(np.float32)


def _nearest(rows: NDArray[np.float32], words: NDArray[np.float32]) -> NDArray[np.intp]:
    return np.argmin((words * words).sum(1) - 2 * rows @ words.T, axis=1)
