"""RUN/refined_poses.json: where refining put the training cameras, for scores of training views and for other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from nerfvol.datasets.dataset import Dataset
from nerfvol.datasets.frame import Frame
from nerfvol.errors import InputError
from nerfvol.files.atomic import read_json, write_json
from nerfvol.training.phase import RefinedPoses


def write_refined(path: Path, refined: RefinedPoses, frame: Frame) -> str:
    """Writes the poses (camera to world, OpenGL axes, units of the given poses) and returns a sentence for a person."""
    poses = refined.poses.copy()
    poses[:, :3, 3] = frame.back(poses[:, :3, 3])
    rows = [
        {"photograph": name, "moved_pixels": round(float(pixels), 3), "transform_matrix": pose.tolist()}
        for name, pixels, pose in zip(refined.names, refined.pixels, poses, strict=True)
    ]
    write_json(path, {"axes": "camera to world, x right, y up, looking down -z", "photographs": rows})
    middle, most = float(np.median(refined.pixels)), float(refined.pixels.max())
    return (
        f"cameras were refined: what they show moved by {middle:.2f} pixels in the median, {most:.1f} at most ({path.name}); "
        "scores are given plain and after a fit of each held-out view's pose"
    )


def with_refined(dataset: Dataset, path: Path) -> Dataset:
    """``dataset`` with the poses of the file where it names its views; itself where there is no file.

    Raises:
        InputError: the file is damaged.
    """
    if not path.is_file():
        return dataset
    try:
        rows = {
            row["photograph"]: np.array(row["transform_matrix"], np.float64) for row in read_json(path)["photographs"]
        }
        cameras = [
            replace(camera, c2w=rows[name]) if name in rows else camera
            for camera, name in zip(dataset.cameras, dataset.names, strict=True)
        ]
    except (LookupError, TypeError, ValueError) as error:
        raise InputError(f"{path}: expected the poses that a run refined, but it is damaged ({error})") from error
    return replace(dataset, cameras=cameras)
