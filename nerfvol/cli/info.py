"""``nerfvol info``: what an octree file holds, and which compute path runs on this machine."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from nerfvol import __version__
from nerfvol.files import run_folder
from nerfvol.kernels import ops
from nerfvol.machine import describe_hardware
from nerfvol.octree.io import describe_octree, load_octree
from nerfvol.octree.tree import Octree


def octree_statistics(octree: Octree) -> dict[str, Any]:
    """Counts, leaves by level, the volume share of leaves in the root cube and their bounding box, JSON-able."""
    levels, counts = np.unique(octree.leaf_level, return_counts=True)
    half = octree.leaf_sizes()[:, None] / 2
    centers = octree.leaf_centers()
    return {
        "nodes": octree.n_nodes,
        "leaves": octree.n_leaves,
        "vertices": octree.n_vertices,
        "leaves_by_level": {int(level): int(count) for level, count in zip(levels, counts, strict=True)},
        "finest_grid": 2**octree.max_level,
        "filled_share": float((8.0 ** -levels.astype(float) * counts).sum()),
        "leaf_bounds": [(centers - half).min(axis=0).tolist(), (centers + half).max(axis=0).tolist()],
        "bytes_in_memory": int(
            octree.values.nbytes + octree.corners.nbytes + octree.leaf_ijk.nbytes + octree.leaf_level.nbytes
        ),
    }


def run_info(options: InfoOptions) -> int:
    """Print the record, or only the machine's part where no file is named."""
    record: dict[str, Any] = {
        "nerfvol": __version__,
        "hardware": describe_hardware(),
        "kernel_paths": ops.available_isas(),
    }
    if options.target:
        path = run_folder.octree_path(options.target)
        octree, _ = load_octree(path)
        record["file"] = {"path": str(path), "bytes": path.stat().st_size, **describe_octree(path)}
        record["octree"] = octree_statistics(octree)
    if options.json:
        print(json.dumps(record, indent=2))
    else:
        _print(record)
    return 0


def _print(record: dict[str, Any]) -> None:
    hardware = record["hardware"]
    if "file" in record:
        file, stats = record["file"], record["octree"]
        print(f"file            {file['path']} ({file['bytes'] / 1e6:.1f} MB, {file['storage']})")
        print(f"format          {file['format']} {file['version']}, written by nerfvol {file['nerfvol']}")
        print(f"root cube       {_numbers(file['aabb'][0])} to {_numbers(file['aabb'][1])}")
        print(f"leaves          {stats['leaves']:,} of {stats['nodes']:,} nodes, {stats['vertices']:,} vertices")
        levels = ", ".join(f"{2**level}³: {count:,}" for level, count in stats["leaves_by_level"].items())
        print(f"by resolution   {levels}")
        print(f"filled          {100 * stats['filled_share']:.3g} % of the root cube")
        print(f"colour          {file['colour']}, SH degree {file['sh_degree']}")
        print(f"density         {file['density']}, scale {file['density_scale']:g}")
        for key, value in file["metadata"].items():
            print(f"{key:15s} {json.dumps(value)}")
    print(f"nerfvol         {record['nerfvol']}")
    print(f"machine         {hardware['cpu']}, {hardware['cores']} cores, {hardware['memory_gib']} GiB")
    others = [path for path in record["kernel_paths"] if path != hardware["kernel_path"]]
    print(f"compute path    {hardware['kernel_path']}" + (f" (also: {', '.join(others)})" if others else ""))


def _numbers(values: list[float]) -> str:
    return " ".join(f"{value:.4g}" for value in values)


@dataclass
class InfoOptions:
    """``nerfvol info``."""

    target: str = ""
    json: bool = False
