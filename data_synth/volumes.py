"""Import and export of density volumes: OpenVDB, npz, raw files, and what scanners write."""

from __future__ import annotations

import os
import warnings
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_synth import blackbody, lookups, media, medical
from data_synth.bricks import BRICK, SIDE, Sparse
from data_synth.errors import InputError, RenderWarning
from data_synth.files import replacing
from data_synth.jit import in_bands, kernel
from data_synth.vdb import grid_names, read_blocks, read_vdb
from data_synth.vdb_write import SparseGrid, write_grids, write_vdb

COLOUR = ("Cd", "color", "colour")
TEMPERATURE, FLAME = ("temperature",), ("flame", "flames", "heat", "burn")
KELVIN = 200.0
"""Temperatures of which none is above this are fractions of the hottest one."""
LARGE = 1 << 28
"""Samples of a dense array (1 GiB) beyond which media stay in bricks."""
GRIDS = (".vdb", ".nvdb")
"""Files of named grids."""
KNOWN = ", ".join((*GRIDS, ".npz", ".npy", ".raw", *medical.SUFFIXES))


@dataclass
class Volume:
    """A density and what else an OpenVDB file holds of the same voxels, None for what it does not.

    spacing: voxel size. colour: three numbers a voxel. heat: temperature or flame, scaled to [0, 1]; hottest: kelvin of 1 where
    the file says so; burns: whether heat is the part that burns, all of it equally hot.
    """

    density: np.ndarray | Sparse
    spacing: np.ndarray
    colour: Sparse | None = None
    heat: Sparse | None = None
    hottest: float | None = None
    burns: bool = False

    def upright(self) -> Volume:
        """With y up turned to z up, right-handed: x, y, z -> x, -z, y."""
        turned = [_upright(v) for v in (self.density, self.colour, self.heat)]
        return replace(self, density=turned[0], colour=turned[1], heat=turned[2], spacing=self.spacing[[0, 2, 1]])

    def glow(self, kelvin: float, heat: float) -> np.ndarray:
        """(n, 3) radiance over ``heat``: black bodies, with luminance ``heat`` at ``kelvin``, which is the hottest of what
        is given as a fraction."""
        if self.burns:
            return heat * np.linspace(0.0, 1.0, 2)[:, None] * blackbody.glow(kelvin, kelvin)
        return heat * blackbody.glow(np.linspace(0.0, self.hottest or kelvin, 256).clip(1.0), kelvin)


def is_turned(up: str) -> bool:
    """Whether a file whose axis ``up`` is upright is to be turned; InputError where that is neither y nor z."""
    if up not in ("y", "z"):
        raise InputError(f"expected up to be y or z, got {up}")
    return up == "y"


def _upright(v: Any) -> Any:
    if v is None or isinstance(v, Sparse):
        return v and v.upright()
    return np.ascontiguousarray(v[:, :, ::-1].transpose(0, 2, 1))


def open_volume(path: str | os.PathLike, uses: Collection[str] = ("colour", "heat")) -> Volume:
    """A density file of any kind, of an OpenVDB file in blocks and with the further grids of ``uses`` that it holds.

    Cd (color) is colour, temperature heat, else flame (flames, heat, burn). A sentence says what is taken and what not.
    """
    text, colon, _ = str(path).rpartition(":")
    given = Path(path)
    if given.suffix not in GRIDS or not given.is_file() or (colon and text.endswith(GRIDS)):
        return Volume(*read_volume(path))
    held, unknown = grid_names(given)
    found = read_blocks(given)
    if found is None:
        return Volume(*read_volume(path))
    volume = Volume(_checked(f"{given}:{found.name}", found.volume, found.voxel_size)[0], found.voxel_size)
    wanted = {"colour": [n for n in COLOUR if held.get(n) == 3][:1]}
    wanted["heat"] = [n for n in TEMPERATURE + FLAME if held.get(n) == 1][:1]
    taken = []
    for what, name in ((use, name) for use in uses for name in wanted[use]):
        try:
            other = read_blocks(given, name)
            if other is not None:
                _checked(f"{given}:{name}", other.volume, other.voxel_size)
        except InputError as error:
            said = f"{name} cannot be read and is left out: {error}"
            warnings.warn(f"{given}: {said}", RenderWarning, stacklevel=2)
            continue
        if other is None or not np.allclose(other.voxel_size, found.voxel_size) or np.any(other.origin != found.origin):
            warnings.warn(
                f"{given}: {name} lies on another grid than {found.name} and is left out", RenderWarning, stacklevel=2
            )
            continue
        moved = Sparse(other.volume.corner + other.first - found.first, other.volume.blocks, found.volume.size)
        taken.append(f"{name} as {what}")
        if what == "colour":
            volume.colour = moved.map(lambda v: np.clip(v, 0.0, 1.0))
        else:
            largest = moved.max() or 1.0
            volume.heat, volume.burns = moved.map(lambda v, n=largest: np.clip(v / n, 0.0, 1.0)), name in FLAME
            volume.hottest = largest if name in TEMPERATURE and largest > KELVIN else None
    names = {t.split(" ")[0] for t in taken} | {found.name}
    left = [n for n in (*held, *unknown) if n not in names]
    if taken or left:
        said = f"took {', '.join([f'{found.name} as density', *taken])}" + (f", not {', '.join(left)}" if left else "")
        warnings.warn(f"{given}: {said}; {given.name}:NAME takes one alone", RenderWarning, stacklevel=2)
    return volume


def read_volume(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """(samples (nx, ny, nz) float32, voxel size (3,)) of a .vdb, .nvdb, .npz, .npy, .raw, .mhd, .mha, .nrrd, .nii or
    .nii.gz file.

    vdb, nvdb: the grid called density, or the first; another one by its name, as in smoke.vdb:flame. npz: the array "density",
    or the first 3D one, with an optional "voxel_size". raw: a name that ends in _NXxNYxNZ_TYPE.raw, such as
    head_256x256x128_uint8.raw, x fastest.
    """
    text, colon, name = str(path).rpartition(":")
    given = Path(path)
    if colon and text.endswith(GRIDS) and not given.exists():
        given = Path(text)
    else:
        name = ""
    if not given.is_file():
        raise InputError(f"{given}: expected a volume file ({KNOWN}), found no such file")
    spacing = np.ones(3)
    if given.suffix in GRIDS:
        values, spacing = _read_grid(given, name or None)
    elif given.suffix in (".npz", ".npy"):
        values, spacing = _read_numpy(given)
    elif given.suffix == ".raw":
        values = _read_raw(given)
    elif given.name.endswith(medical.SUFFIXES):
        values, spacing = medical.read(given)
    else:
        raise InputError(f"{given}: expected a volume that ends in {KNOWN}")
    return _checked(given, values, spacing)


def _read_grid(path: Path, name: str | None) -> tuple[np.ndarray, np.ndarray]:
    grid = read_vdb(path, name, density=True)
    if grid.others and name is None:
        others = ", ".join(grid.others)
        notice = f"{path}: took the grid {grid.name}; {path.name}:NAME takes another ({others})"
        warnings.warn(notice, RenderWarning, stacklevel=3)
    return grid.values, grid.voxel_size


def _checked(path: str | os.PathLike, values: Any, spacing: np.ndarray) -> tuple[Any, np.ndarray]:
    """The samples, an array or ``Sparse``, in single precision, and the voxel size."""
    numbers = values.blocks if isinstance(values, Sparse) else values
    if numbers.dtype.kind not in "fiub":
        raise InputError(f"{path}: expected an array of numbers, got {numbers.dtype}")
    if len(values.shape) != 3 + (isinstance(values, Sparse) and numbers.ndim > 4) or min(values.shape[:3]) < 2:
        raise InputError(f"{path}: expected samples in 3 dimensions, at least 2 along each, got shape {values.shape}")
    if isinstance(values, np.ndarray):
        values = numbers = values.astype(np.float32, copy=False)  # a volume may be half of memory
    if not np.isfinite(numbers).all():
        wrong = int(numbers.size - np.isfinite(numbers).sum())
        raise InputError(f"{path}: expected finite samples, got {wrong} that are infinite or no number")
    if spacing.dtype.kind not in "fiu" or spacing.shape != (3,) or not (np.isfinite(spacing) & (spacing > 0)).all():
        raise InputError(f"{path}: expected a voxel size of three positive numbers, got {spacing}")
    return values, spacing.astype(float)


def _read_numpy(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        with open(path, "rb") as file:
            stored = np.load(file, allow_pickle=False)
            if path.suffix == ".npy" and isinstance(stored, np.ndarray):
                return stored, np.ones(3)
            if path.suffix == ".npy" or isinstance(stored, np.ndarray):
                held = ("one array", "an archive of arrays")[path.suffix == ".npy"]
                raise InputError(
                    f"{path}: it holds {held}; such a file's name ends in {'.npy' if path.suffix == '.npz' else '.npz'}"
                )
            names = [n for n in ("density", *stored.files) if n in stored.files and stored[n].ndim == 3]
            if not names:
                raise InputError(f"{path}: expected a 3D array, got {', '.join(stored.files) or 'nothing'}")
            spacing = stored["voxel_size"] if "voxel_size" in stored.files else np.ones(3)
            return stored[names[0]], np.broadcast_to(spacing, (3,)) if spacing.size == 1 else spacing
    except (InputError, MemoryError):
        raise
    except Exception as error:  # numpy parses headers as Python literals: damage raises whatever parsers and zlib do
        why = (str(error).splitlines() or [""])[0][:100] or type(error).__name__
        raise InputError(f"{path}: cannot be read as a numpy volume: {why}") from error


def _read_raw(path: Path) -> np.ndarray:
    try:
        *_, size, kind = path.stem.split("_")
        shape = [int(n) for n in size.split("x")]
        return np.fromfile(path, dtype=np.dtype(kind)).reshape(shape[::-1]).transpose(2, 1, 0)
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: expected a name like name_256x256x128_uint8.raw that fits its size") from error


def write_density(m: media.Medium, out_dir: Path) -> None:
    """density.npz and density.vdb: green extinction in 1/u at the samples of a grid medium, and where they are.

    Of a medium with detail below its grid at twice as many along each side, unless that is too many.
    """
    if is_large(m):
        _write_bricks(m, out_dir)
        return
    finer = 2 if m.detail.octaves and not is_large(m, 2) else 1
    sigma, cell = sampled(m, finer) * np.float32(m.sigma_t[1]), media.triple(c / finer for c in m.cell)
    with replacing(out_dir / "density.npz") as temporary:
        np.savez_compressed(temporary, density=sigma, lo=m.lo, hi=m.hi, voxel_size=cell)
    write_vdb(out_dir / "density.vdb", sigma, cell, m.lo)


def is_large(m: media.Medium, finer: int = 1) -> bool:
    """Whether a dense array of its samples, ``finer`` to a cell, is not made."""
    return float(np.prod(finer * np.array(m.cells, float) + 1)) > LARGE


def _write_bricks(m: media.Medium, out_dir: Path) -> None:
    """density.vdb alone, from the bricks."""
    warnings.warn(
        f"{out_dir}: density.npz would be a dense array of {m.cells} cells and is left out; density.vdb has its voxels",
        RenderWarning, stacklevel=4,
    )  # fmt: skip
    brick = np.stack(np.unravel_index(np.flatnonzero(m.offsets >= 0), m.bricks), axis=1)
    samples = m.samples.reshape(len(brick), SIDE, SIDE, SIDE)
    own = samples > 0  # of samples that several bricks hold, the last brick alone along an axis has the upper ones
    for axis in range(3):
        upper = [slice(None)] * 4
        upper[axis + 1] = slice(BRICK, SIDE)
        own[tuple(upper)] &= (brick[:, axis] == m.bricks[axis] - 1).reshape(-1, 1, 1, 1)
    k, *inside = np.nonzero(own)
    coords = (brick[k] * BRICK + np.stack(inside, axis=1)).astype(np.int32)
    values = samples[own]
    if m.detail.octaves:
        in_bands(lambda a, b: _erode(m, coords, values, a, b), len(values), 1 << 16)
    values = values * np.float32(m.sigma_t[1])
    write_grids(out_dir / "density.vdb", [SparseGrid("density", coords, values, m.cell, m.lo)], half=False)


@kernel
def _erode(m, coords, values, first, last):
    for s in range(first, last):
        values[s] = lookups.density(m, lookups.vertex(m, coords[s, 0], coords[s, 1], coords[s, 2], 1))


def sampled(m: media.Medium, finer: int = 1) -> np.ndarray:
    """The (finer (nx - 1) + 1, ...) float32 density, detail and all, at the vertices of a grid medium's cells, cut."""
    if finer == 1 and m.detail.octaves == 0:
        return media.dense(m)
    out = np.empty([finer * n + 1 for n in m.cells], np.float32)
    in_bands(lambda a, b: _sample(m, finer, out, a, b), len(out), 4)
    return out


@kernel
def _sample(m, finer, out, first, last):
    for i in range(first, last):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                out[i, j, k] = lookups.density(m, lookups.vertex(m, i, j, k, finer))
