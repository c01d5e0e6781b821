"""Import and export of density volumes: OpenVDB, npz and raw files."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np

from data_synth import media
from data_synth.errors import InputError
from data_synth.image import replacing
from data_synth.vdb import read_vdb
from data_synth.vdb_write import write_vdb


def read_volume(path: str | os.PathLike) -> tuple[np.ndarray, np.ndarray]:
    """(samples (nx, ny, nz) float32, voxel size (3,)) of a .vdb, .npz, .npy or .raw file.

    npz: the array "density", or the first 3D one, with an optional "voxel_size". raw: a name that ends in
    _NXxNYxNZ_TYPE.raw, such as head_256x256x128_uint8.raw, x fastest.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: expected a volume file (.vdb, .npz, .npy or .raw), found no such file")
    spacing = np.ones(3)
    if path.suffix == ".vdb":
        grid = read_vdb(path)
        values, spacing = grid.values, grid.voxel_size
    elif path.suffix in (".npz", ".npy"):
        values, spacing = _read_numpy(path)
    elif path.suffix == ".raw":
        values = _read_raw(path)
    else:
        raise InputError(f"{path}: expected a volume that ends in .vdb, .npz, .npy or .raw")
    values = np.asarray(values, np.float32)
    if values.ndim != 3 or min(values.shape) < 2 or not np.isfinite(values).all():
        raise InputError(f"{path}: expected finite samples in 3 dimensions, got shape {values.shape}")
    return values, np.asarray(spacing, float)


def _read_numpy(path: Path) -> tuple[np.ndarray, np.ndarray]:
    try:
        with open(path, "rb") as file:
            stored = np.load(file, allow_pickle=False)
            if path.suffix == ".npy":
                return stored, np.ones(3)
            names = [n for n in ("density", *stored.files) if n in stored.files and stored[n].ndim == 3]
            if not names:
                raise InputError(f"{path}: expected a 3D array, got {', '.join(stored.files) or 'nothing'}")
            spacing = stored["voxel_size"] if "voxel_size" in stored.files else np.ones(3)
            return stored[names[0]], spacing
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: cannot be read as a numpy volume: {error}") from error


def _read_raw(path: Path) -> np.ndarray:
    try:
        *_, size, kind = path.stem.split("_")
        shape = [int(n) for n in size.split("x")]
        return np.fromfile(path, dtype=np.dtype(kind)).reshape(shape[::-1]).transpose(2, 1, 0)
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: expected a name like name_256x256x128_uint8.raw that fits its size") from error


def write_density(m: media.Medium, out_dir: Path) -> None:
    """density.npz and density.vdb: green extinction in 1/u at the samples of a grid medium, and where they are."""
    sigma = media.dense(m) * np.float32(m.sigma_t[1])
    with replacing(out_dir / "density.npz") as temporary:
        np.savez_compressed(temporary, density=sigma, lo=m.lo, hi=m.hi, voxel_size=m.cell)
    write_vdb(out_dir / "density.vdb", sigma, m.cell, m.lo)
