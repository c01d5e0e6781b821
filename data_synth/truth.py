"""truth.npz: what a scene is made of, exactly, as arrays of numbers that need no data_synth to be read.

| array                                   | content                                                                     |
|-----------------------------------------|-----------------------------------------------------------------------------|
| ``mediumK_kind``                        | homogeneous, grid, exponential, function or rgb_grid; K = 0, 1, ... as       |
|                                         | boundaries number them                                                      |
| ``mediumK_lo``, ``_hi``                 | its box                                                                     |
| ``mediumK_sigma_t``                     | (3,) extinction per density in 1/u                                          |
| ``mediumK_density``, ``_attribute``     | samples at the vertices of a grid from lo to hi; the attribute only if any  |
| ``mediumK_micro``, ``_roughness``,     | of other microflakes: ``microflakes.py``; D: (n, rows + 1, columns) normals  |
| ``_ior``, ``_D``                        | at polar angles 0 ... pi/2 and azimuths 0 ... 2 pi; none: S                  |
| ``mediumK_noise``, ``_curl``, ``_tiles``| of a cloud with detail below its grid, as ``detail.py`` erodes the density;  |
| ``mediumK_erosion``, ``_octaves``,      | z from lo to hi is its height in [0, 1]                                      |
| ``_contrast``                           |                                                                             |
| ... of kind rgb_grid                    | density and albedo are (nx, ny, nz, 3): extinction in 1/u, and albedo       |
| ... above 2^28 samples                  | no dense arrays: ``_cells``, ``_offsets`` (first sample of each brick of 8^3 |
|                                         | cells, -1: empty), ``_samples``, ``_attributes``, ``_fields``, ``_columns`` |
| ``mediumK_height``                      | exponential: density exp(-(z - lo_z) / height)                              |
| ... function                            | ``_function``: its name, ``_source``: its text; ``_density``: samples of it,|
|                                         | 64 cells along the longest side; ``_majorant``: (bx, by, bz)                |
| ``mediumK_albedo``, ``_Le``             | (n, 3) tables over the attribute in [0, 1], linear in between; or grids,    |
|                                         | (nx, ny, nz, 1 or 3), trilinear as the density                              |
| ``mediumK_phase``, ``_g``, ``_S``       | its name; g1, g2 and the weight of the first lobe; (n, 6) SGGX matrices     |
| ``mediumK_g_grid``, ``_S_grid``         | (nx, ny, nz) in place of g1, (nx, ny, nz, 6) in place of S, where they vary |
| ``number``, ``number_lo``, ``number_hi``| medium at each vertex of a grid, -1 for none; media are cut by boundaries   |
| ``shapes``, ``triangles``, ``materials``| tables as ``surfaces`` and ``materials`` describe them                      |
| ``solidK_material``, ``_lo``,        | of each level set (``crossings.py``): (3,) lowest vertex and edges of a cell, |
|  ``_cell``, ``_offsets``, ``_samples``| (bx, by, bz) first sample of each brick of 8^3 cells, -1: outside, -2: inside |
| ``layers``, ``layers_D``, ``lights``    | tables as ``spongecake``, ``microflakes`` and ``lights`` describe them       |
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_synth import level_sets, media, microflakes, spongecake, surfaces
from data_synth import materials as stuff
from data_synth import phase as phases
from data_synth.channels import Channels
from data_synth.detail import Detail
from data_synth.files import replacing
from data_synth.functions import COMPILED
from data_synth.volumes import is_large

if TYPE_CHECKING:
    from data_synth.scene import Scene

RESOLUTION = 64  # cells along the longest side of ``number``
KINDS = {
    media.HOMOGENEOUS: "homogeneous", media.GRID: "grid", media.EXPONENTIAL: "exponential", media.FUNCTION: "function",
}  # fmt: skip
PHASES = ("isotropic", "rayleigh", "henyey_greenstein", "sggx_specular", "sggx_diffuse", "microflakes")


def write(scene: Scene, path: Path) -> None:
    """Write the file."""
    arrays: dict[str, np.ndarray] = {}
    for k, m in enumerate((scene.medium, *scene.media)):
        if m is not None:
            described = _channels(m) if isinstance(m, Channels) else _medium(m)
            arrays |= {f"medium{k}_{name}": np.asarray(value) for name, value in described.items()}
    lo, hi, number = numbers(scene)
    geometry, layers = surfaces.geometry(scene.shapes, scene.triangles), spongecake.stack(scene.layers)
    for k, s in enumerate(scene.level_sets):
        described = s._asdict() | {"offsets": s.offsets.reshape(s.bricks)}
        arrays |= {f"solid{k}_{name}": np.asarray(value) for name, value in described.items() if name != "bricks"}
    arrays |= {
        "number": number, "number_lo": lo, "number_hi": hi, "shapes": geometry.shapes, "triangles": geometry.triangles,
        "materials": scene.boundaries(), "layers": layers.rows, "layers_D": layers.table.D,
        "lights": np.array(scene.lights, float).reshape(-1, 16),
    }  # fmt: skip
    with replacing(path) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)


def _channels(m: Channels) -> dict[str, object]:
    grids = {"density": m, "albedo": [one._replace(samples=one.attributes) for one in m]}
    own = {name: np.stack([media.dense(one) for one in media_], -1) for name, media_ in grids.items()}
    glow = m.Le
    if m.red.columns.Le >= 0:
        glow = np.concatenate([media.dense_of(one, one.fields, one.columns.Le) for one in m], axis=-1)
    return _medium(m.red) | own | {"kind": "rgb_grid", "Le": glow, "attribute": np.zeros(0)}


def _medium(m: media.Medium) -> dict[str, object]:
    out: dict[str, object] = {
        "kind": KINDS[m.kind], "lo": m.lo, "hi": m.hi, "sigma_t": m.sigma_t, "albedo": m.albedo, "Le": m.Le,
        "phase": PHASES[m.phase.kind], "g": (m.phase.g1, m.phase.g2, m.phase.mix), "S": m.phase.S,
    }  # fmt: skip
    if m.phase.kind == phases.FLAKES:
        micro = list(microflakes.MICRO)[m.phase.micro]
        out |= {"micro": micro, "roughness": m.phase.roughness, "ior": m.phase.ior, "D": m.phase.table.D}
    if m.kind == media.GRID:
        if m.detail.octaves:
            out |= _detail(m.detail)
        if is_large(m):
            return out | _in_bricks(m)
        out["density"] = media.dense(m)
        if m.attributes.size > 1:
            out["attribute"] = media.dense(m._replace(samples=m.attributes))
        out |= _fields(m)
    if m.kind == media.FUNCTION:
        out |= _function(m)
    if m.kind == media.EXPONENTIAL:
        out["height"] = 1.0 / m.falloff
    return out


def _detail(d: Detail) -> dict[str, object]:
    size = d.n**3
    return {
        "noise": d.values[:size].reshape((d.n,) * 3), "curl": d.values[size:].reshape(d.p, d.p, 2), "tiles": d.tiles,
        "erosion": d.erosion, "octaves": d.octaves, "contrast": d.contrast,
    }  # fmt: skip


def _in_bricks(m: media.Medium) -> dict[str, object]:
    return {"cells": m.cells, "offsets": m.offsets, "samples": m.samples, "attributes": m.attributes,
            "fields": m.fields, "columns": m.columns}  # fmt: skip


def _fields(m: media.Medium) -> dict[str, object]:
    """The grids of what varies."""
    c, out = m.columns, {}
    for name, first, columns in (
        ("albedo", c.albedo, 1 + 2 * c.albedo_step), ("Le", c.Le, 1 + 2 * c.Le_step), ("g_grid", c.g, 1), ("S_grid", c.S, 6),
    ):  # fmt: skip
        if first >= 0:
            grid = media.dense_of(m, m.fields, first, columns)
            out[name] = grid[..., 0] if name == "g_grid" else grid
    return out


def _function(m: media.Medium) -> dict[str, object]:
    known, box = COMPILED[m.function], np.array(m.hi) - m.lo
    cells = np.maximum(np.rint(box / box.max() * RESOLUTION).astype(int), 1)
    axes = [np.linspace(a, b, n + 1) for a, b, n in zip(m.lo, m.hi, cells, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    density = np.array([known.call(*p) for p in points], np.float32).reshape(cells + 1)
    return {
        "function": known.name, "source": known.source, "density": density, "majorant": m.brick_max.reshape(m.bricks),
    }  # fmt: skip


def described(scene: Scene) -> dict[str, dict[str, object]]:
    """What truth.npz tells of each medium, in words: its kind, and of each array whether it is a grid, and of which shape."""
    out: dict[str, dict[str, object]] = {}
    for k, m in enumerate((scene.medium, *scene.media)):
        if m is None:
            continue
        one = m.red if isinstance(m, Channels) else m
        grid, c = [n + 1 for n in one.cells], one.columns
        told: dict[str, object] = {"kind": "rgb_grid" if isinstance(m, Channels) else KINDS[one.kind]}
        if one.kind == media.GRID:
            told["density"] = [*grid, 3] if isinstance(m, Channels) else grid
        if m is one and one.attributes.size > 1:
            told["attribute"] = "grid"
        varied = {"albedo": c.albedo >= 0 or isinstance(m, Channels), "Le": c.Le >= 0, "g": c.g >= 0, "S": c.S >= 0}
        told |= {name: "grid" for name, is_grid in varied.items() if is_grid}
        if one.detail.octaves:
            told["detail"] = f"{one.detail.octaves} octaves"
        if one.kind == media.FUNCTION:
            told["density"] = f"the function {COMPILED[one.function].name}"
        out[f"medium{k}"] = told
    return out


def numbers(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(lo, hi, (nx, ny, nz) int8): the number of the medium at the vertices of a grid over the media's boxes.

    Boundaries are spheres, boxes, half-spaces and level sets; those made of triangles count as the ambient medium.
    """
    boxes = [(m.lo, m.hi) for m in (scene.medium, *scene.media) if m is not None] or [tuple(scene.aabb)]
    lo, hi = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    cells = np.maximum(np.rint((hi - lo) / (hi - lo).max() * RESOLUTION).astype(int), 1)
    p = np.stack(
        np.meshgrid(*[np.linspace(a, b, n + 1) for a, b, n in zip(lo, hi, cells, strict=True)], indexing="ij"), -1
    )
    ambient = stuff.CLEAR if scene.bounded or scene.medium is None else 0
    number, best = np.full(p.shape[:3], ambient, np.int8), np.full(p.shape[:3], -np.inf)
    rows, shapes = scene.boundaries(), surfaces.geometry(scene.shapes).shapes
    solids = [(int(shape[1]), shape, _holds) for shape in shapes]
    solids += [(s.material, s, level_sets.holds) for s in scene.level_sets]
    for material, shape, holds in sorted(solids, key=lambda solid: solid[0]):  # of equal priorities the later counts
        row = rows[material]
        if row[0] in (stuff.DIELECTRIC, stuff.NULL) and row[15] >= 0:
            here = holds(shape, p) & (row[14] >= best)
            number[here], best[here] = row[13], row[14]
    for k, m in enumerate((scene.medium, *scene.media)):
        if m is not None:
            number[(number == k) & ~((p >= m.lo) & (p <= m.hi)).all(axis=-1)] = stuff.CLEAR
    return lo, hi, number


def _holds(shape: np.ndarray, p: np.ndarray) -> np.ndarray:
    if shape[0] == surfaces.PLANE:
        return np.asarray((p - shape[2:5]) @ shape[5:8] < 0)
    if shape[0] == surfaces.SPHERE:
        return ((p - shape[2:5]) ** 2).sum(axis=-1) < shape[5] ** 2
    return np.asarray(((p > shape[2:5]) & (p < shape[5:8])).all(axis=-1))
