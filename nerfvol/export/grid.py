"""An octree or a field on a dense grid: ``.npz .npy`` (numpy), ``.nii .nii.gz`` (NIfTI-1), ``.vti`` (VTK image data).

Samples are at the centres of cubic voxels of the box around the leaves or occupied cells: density, the opacity of a voxel
along its side, or colour (the mean over directions, as in the training images; bytes in NIfTI and VTK, which have no other
colours). Axes are the scene's.

- ``.npz``: ``density`` (``opacity``, ``color``), index order x, y, z, with ``lo``, ``hi`` and ``voxel_size`` (3,), as the
  density.npz of a synthetic scene; next to an ``.npy`` lies a .json of the same name that says the same.
- NIfTI-1 (Cox et al. 2004; nifti1.h): x fastest; sform and qform take an index to the voxel's centre in the scene; units
  are not stated.
- ``.vti``: point data at the voxels' centres, appended raw.
"""

from __future__ import annotations

import gzip
import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from nerfvol.errors import InputError
from nerfvol.files.atomic import atomic_write, write_json
from nerfvol.models import Model
from nerfvol.neural import FieldModel
from nerfvol.octree.points import octree_colour, octree_density
from nerfvol.views import OctreeModel

_Sampled = OctreeModel | FieldModel
Quantity = Literal["sigma", "opacity", "color"]
RESOLUTION = 256
LARGEST = 2048
_RUN = 1 << 18  # samples that are asked for at a time
_PER_SAMPLE = 400  # bytes of such a sample
_NAMES = {"sigma": "density", "opacity": "opacity", "color": "color"}


class _Grid:
    """Where the voxels are. lo, hi (3,): the box, hi moved out to whole voxels; voxel: its side; shape: (nx, ny, nz)."""

    def __init__(self, model: Model, resolution: int) -> None:
        if not 1 <= resolution <= LARGEST:
            raise InputError(f"--resolution must lie between 1 and {LARGEST}, got {resolution}")
        self.lo, hi = model.aabb()
        self.voxel = float((hi - self.lo).max() / resolution)
        counts = np.maximum(np.ceil((hi - self.lo) / self.voxel - 1e-6), 1).astype(int)
        self.hi = self.lo + counts * self.voxel
        self.shape = (int(counts[0]), int(counts[1]), int(counts[2]))
        self.first = self.lo + 0.5 * self.voxel
        """Middle of the first voxel."""

    def places(self, at: int, count: int, order: Literal["C", "F"]) -> NDArray[np.float64]:
        """Middles (n, 3) of ``count`` voxels from number ``at`` on; C: z fastest, F: x fastest."""
        index = np.arange(at, min(at + count, int(np.prod(self.shape))))
        return self.first + np.stack(np.unravel_index(index, self.shape, order=order), axis=1) * self.voxel


def memory(model: Model, resolution: int = RESOLUTION, quantity: Quantity = "sigma") -> int:
    """Bytes that writing takes: the grid in float32 once, and a run of samples."""
    shape = _Grid(model, resolution).shape
    channels = 3 if quantity == "color" else 1
    return 4 * channels * int(np.prod(shape, dtype=object)) + _PER_SAMPLE * _RUN


def write(
    model: Model, path: str | os.PathLike[str], resolution: int = RESOLUTION, quantity: Quantity = "sigma"
) -> int:
    """The grid with ``resolution`` voxels along the longest side of the leaves' box."""
    assert isinstance(model, OctreeModel | FieldModel)
    grid = _Grid(model, resolution)
    ending = next(ending for ending in _WRITERS if Path(path).name.lower().endswith(ending))
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        _WRITERS[ending](file, model, grid, quantity)
    if ending == ".npy":
        box = {"lo": grid.lo.tolist(), "hi": grid.hi.tolist(), "voxel_size": [grid.voxel] * 3}
        write_json(Path(path).with_suffix(".json"), {"quantity": quantity, **box})
    return Path(path).stat().st_size


def _runs(model: _Sampled, grid: _Grid, quantity: Quantity, order: Literal["C", "F"]) -> Iterator[NDArray[np.float32]]:
    """The samples (n,) or (n, 3), run by run."""
    for at in range(0, int(np.prod(grid.shape)), _RUN):
        places = grid.places(at, _RUN, order)
        if quantity == "color":
            yield np.clip(_colour(model, places), 0, 1).astype(np.float32)
            continue
        sigma = _density(model, places)
        yield (sigma if quantity == "sigma" else -np.expm1(-sigma * grid.voxel)).astype(np.float32)


def _density(model: _Sampled, places: NDArray[np.float64]) -> NDArray[np.float64]:
    return octree_density(model.octree, places) if isinstance(model, OctreeModel) else model.density(places)


def _colour(model: _Sampled, places: NDArray[np.float64]) -> NDArray[np.float64]:
    return octree_colour(model.octree, places) if isinstance(model, OctreeModel) else model.colour(places)


def _numbers(runs: Iterator[NDArray[np.float32]], quantity: Quantity) -> Iterator[bytes]:
    """Bytes of float32 numbers, or of colours as bytes."""
    for run in runs:
        yield (np.rint(255 * run).astype(np.uint8) if quantity == "color" else run.astype("<f4")).tobytes()


def _write_npz(file: BinaryIO, model: _Sampled, grid: _Grid, quantity: Quantity) -> None:
    values = _whole(model, grid, quantity)
    box = {"lo": grid.lo, "hi": grid.hi, "voxel_size": np.full(3, grid.voxel)}
    np.savez_compressed(file, **{_NAMES[quantity]: values, **box})


def _write_npy(file: BinaryIO, model: _Sampled, grid: _Grid, quantity: Quantity) -> None:
    np.save(file, _whole(model, grid, quantity))


def _whole(model: _Sampled, grid: _Grid, quantity: Quantity) -> NDArray[np.float32]:
    channels = (3,) if quantity == "color" else ()
    values = np.empty((*grid.shape, *channels), np.float32)
    flat, at = values.reshape(-1, *channels), 0
    for run in _runs(model, grid, quantity, "C"):
        flat[at : at + len(run)] = run
        at += len(run)
    return values


def _write_nifti(file: BinaryIO, model: _Sampled, grid: _Grid, quantity: Quantity) -> None:
    file.write(_nifti_header(grid, quantity))
    for part in _numbers(_runs(model, grid, quantity, "F"), quantity):
        file.write(part)


def _write_nifti_gz(file: BinaryIO, model: _Sampled, grid: _Grid, quantity: Quantity) -> None:
    with gzip.GzipFile(filename="", mode="wb", fileobj=file, compresslevel=6, mtime=0) as packed:
        _write_nifti(packed, model, grid, quantity)  # type: ignore[arg-type]


def _nifti_header(grid: _Grid, quantity: Quantity) -> bytes:
    """348 bytes and four more that say: no extensions."""
    header = bytearray(352)
    put = lambda at, form, *values: struct.pack_into("<" + form, header, at, *values)  # noqa: E731
    put(0, "i", 348)
    put(40, "8h", 3, *grid.shape, 1, 1, 1, 1)
    put(70, "2h", *((128, 24) if quantity == "color" else (16, 32)))  # datatype and bits: RGB24 or float32
    put(76, "8f", 1, grid.voxel, grid.voxel, grid.voxel, 0, 0, 0, 0)
    put(108, "3f", 352, 1, 0)  # where the numbers begin, slope and intercept
    put(148, "80s", f"nerfvol {_NAMES[quantity]}".encode())
    put(252, "2h", 2, 2)  # qform and sform: aligned to the coordinates of something else, here the scene
    put(268, "3f", *grid.first)  # qoffset; the quaternion is (1, 0, 0, 0)
    for axis in range(3):
        row = [0.0, 0.0, 0.0, float(grid.first[axis])]
        row[axis] = grid.voxel
        put(280 + 16 * axis, "4f", *row)
    put(344, "4s", b"n+1\0")
    return bytes(header)


def _write_vti(file: BinaryIO, model: _Sampled, grid: _Grid, quantity: Quantity) -> None:
    extent = " ".join(f"0 {n - 1}" for n in grid.shape)
    triple = lambda values: " ".join(repr(float(v)) for v in values)  # noqa: E731
    kind, channels, size = ("UInt8", 3, 1) if quantity == "color" else ("Float32", 1, 4)
    name = _NAMES[quantity]
    file.write(
        f"""<?xml version="1.0"?>
<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">
<ImageData WholeExtent="{extent}" Origin="{triple(grid.first)}" Spacing="{triple([grid.voxel] * 3)}">
<Piece Extent="{extent}">
<PointData Scalars="{name}">
<DataArray type="{kind}" Name="{name}" NumberOfComponents="{channels}" format="appended" offset="0"/>
</PointData>
</Piece>
</ImageData>
<AppendedData encoding="raw">
_""".encode()
    )
    file.write(struct.pack("<Q", int(np.prod(grid.shape, dtype=object)) * channels * size))
    for part in _numbers(_runs(model, grid, quantity, "F"), quantity):
        file.write(part)
    file.write(b"\n</AppendedData>\n</VTKFile>\n")


_WRITERS: dict[str, Callable[[BinaryIO, _Sampled, _Grid, Quantity], None]] = {
    ".npz": _write_npz, ".npy": _write_npy, ".nii.gz": _write_nifti_gz, ".nii": _write_nifti, ".vti": _write_vti,
}  # fmt: skip
