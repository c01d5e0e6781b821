"""What is assumed where nobody says otherwise; free of every import, for commands and operators share it."""

from __future__ import annotations

WHITE = (1.0, 1.0, 1.0)
"""The background where nobody says another, RGB in [0, 1]."""


DEFAULT_EARLY_STOP = 1 / 255
"""Transmittance at which a rendered ray ends: what is behind moves an 8-bit colour by less than one step."""


DEFAULT_LOD = 0.8
"""Pixels: a part of the octree that is smaller is drawn as one cell. More costs sharpness (docs/experiments.md)."""
