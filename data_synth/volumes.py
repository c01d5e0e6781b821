"""Import and export of density volumes: OpenVDB, npz, raw files, and what scanners write."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np

from data_synth import media, medical
from data_synth.errors import InputError, RenderWarning
from data_synth.files import replacing
from data_synth.jit import in_bands, kernel
from data_synth.vdb import read_vdb
from data_synth.vdb_write import write_vdb

KNOWN = ", ".join((".vdb", ".npz", ".npy", ".raw", *medical.SUFFIXES))


def read_volume(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """(samples (nx, ny, nz) float32, voxel size (3,)) of a .vdb, .npz, .npy, .raw, .mhd, .mha, .nrrd, .nii or .nii.gz file.

    vdb: the grid called density, or the first; another one by its name, as in smoke.vdb:flame. npz: the array "density",
    or the first 3D one, with an optional "voxel_size". raw: a name that ends in _NXxNYxNZ_TYPE.raw, such as
    head_256x256x128_uint8.raw, x fastest.
    """
    text, colon, name = str(path).rpartition(":")
    given = Path(path)
    if colon and text.endswith(".vdb") and not given.exists():
        given = Path(text)
    else:
        name = ""
    if not given.is_file():
        raise InputError(f"{given}: expected a volume file ({KNOWN}), found no such file")
    spacing = np.ones(3)
    if given.suffix == ".vdb":
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
    grid = read_vdb(path, name)
    if grid.others and name is None:
        others = ", ".join(grid.others)
        notice = f"{path}: took the grid {grid.name}; {path.name}:NAME takes another ({others})"
        warnings.warn(notice, RenderWarning, stacklevel=3)
    return grid.values, grid.voxel_size


def _checked(path: Path, values: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if values.dtype.kind not in "fiub":
        raise InputError(f"{path}: expected an array of numbers, got {values.dtype}")
    if values.ndim != 3 or min(values.shape) < 2:
        raise InputError(f"{path}: expected samples in 3 dimensions, at least 2 along each, got shape {values.shape}")
    values = values.astype(np.float32, copy=False)  # a volume may be half of memory
    if not np.isfinite(values).all():
        wrong = int(values.size - np.isfinite(values).sum())
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

    Of a medium with detail below its grid at twice as many along each side.
    """
    finer = 2 if m.detail.octaves else 1
    sigma, cell = sampled(m, finer) * np.float32(m.sigma_t[1]), media.triple(c / finer for c in m.cell)
    with replacing(out_dir / "density.npz") as temporary:
        np.savez_compressed(temporary, density=sigma, lo=m.lo, hi=m.hi, voxel_size=cell)
    write_vdb(out_dir / "density.vdb", sigma, cell, m.lo)


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
        x = m.lo[0] + i * m.cell[0] / finer
        for j in range(out.shape[1]):
            y = m.lo[1] + j * m.cell[1] / finer
            for k in range(out.shape[2]):
                out[i, j, k] = media.density(m, (x, y, m.lo[2] + k * m.cell[2] / finer))
