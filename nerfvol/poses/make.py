"""``make_poses``: photographs or a video to a folder that training reads: ``images/``, ``sparse/0`` and ``poses.json``."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nerfvol import __version__
from nerfvol.datasets.images import FORMATS, map_threads
from nerfvol.errors import InputError
from nerfvol.files.atomic import ensure_writable_folder, read_json, write_json
from nerfvol.machine import describe_hardware
from nerfvol.measure.sharpness import sharpness
from nerfvol.poses import sources, video
from nerfvol.poses.child import Progress, require_pycolmap, run_engine
from nerfvol.poses.engine import MODEL, PLACED, Job
from nerfvol.poses.masks import copy_masks, find_masks
from nerfvol.poses.verdict import failure, remarks

WORK, IMAGES, MASKS, REPORT = "poses_work", "images", "masks", "poses.json"
DETAILED = 150_000
"""Pixels above which features are looked for in the picture itself; below, in one of twice the size."""
Say = Callable[[str], object]
Engine = Callable[[Job, Progress], dict[str, Any]]


@dataclass(frozen=True)
class PoseSettings:
    """``frames``: most frames taken of a video. ``size``: longest side of the pictures that are written, pixels.
    ``features``: most features a picture. ``mapper``: auto, global or incremental. ``fisheye``: OpenCV's fisheye model
    instead of a radial one. ``seed``, ``threads``: as everywhere."""

    frames: int = 120
    size: int = 1600
    features: int = 3000
    mapper: str = "auto"
    fisheye: bool = False
    seed: int = 0
    threads: int = 0


def make_poses(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    settings: PoseSettings | None = None,
    say: Say = print,
    progress: Progress | None = None,
    engine: Engine = run_engine,
) -> dict[str, Any]:
    """Cameras of a folder of photographs, or of a video, by structure from motion (COLMAP, GLOMAP).

    Writes upright pictures to ``out/images``, the model to ``out/sparse/0`` (COLMAP's format) and what happened to
    ``out/poses.json``, whose content is returned. An interrupted call goes on where it was; a finished one with the same
    pictures and settings returns at once.

    Args:
        source: the folder or the video.
        out: the folder to write, made where it is missing.
        settings: see PoseSettings.
        say: gets each sentence that a person should see.
        progress: the bar; default: one of its own.
        engine: what places the cameras; tests give another.

    Raises:
        InputError: no pictures, a video that does not decode, pictures from which no cameras follow (what to do is in the
            sentence), or pycolmap is missing.
    """
    settings, started = settings or PoseSettings(), time.perf_counter()
    path = Path(source)
    if not path.exists():
        raise InputError(f"{path}: expected a folder of photographs or a video, but there is no such folder or file")
    if path.is_file() and not sources.is_video(path):
        known = ", ".join(sources.VIDEO_SUFFIXES)
        raise InputError(f"{path}: expected a folder of photographs or a video ({known})")
    if engine is run_engine:
        require_pycolmap()
    mark = _mark(path, settings)
    folder = Path(out)
    if (done := finished(folder, mark)) is not None:
        say(f"the cameras are there already: {folder}")
        return done
    if path.resolve() == (folder / IMAGES).resolve():
        raise InputError(f"--out {folder}: its images would be written over the photographs; give another folder")
    ensure_writable_folder(folder)
    work = folder / WORK
    if not (work / "mark.json").is_file() or read_json(work / "mark.json") != mark:
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir()
        write_json(work / "mark.json", mark)
    with progress or Progress() as bar:
        photographs, record, messages = gather(path, folder / IMAGES, work, settings, bar)
        for message in messages:
            say(message)
        groups = sources.camera_groups(photographs, settings.fisheye)
        if len(groups) > 1:
            say(f"{len(groups)} cameras: " + "; ".join(f"{len(g.names)} of {g.width}x{g.height}" for g in groups))
        small = np.median([p.width * p.height for p in photographs]) < DETAILED
        job = Job(
            str((folder / IMAGES).resolve()), str(work.resolve()), [asdict(group) for group in groups],
            settings.features, -1 if small else 0, settings.threads, settings.seed, settings.mapper,
            str((folder / MASKS).resolve()) if (folder / MASKS).is_dir() else "",
        )  # fmt: skip
        result = engine(job, bar)
    names = job.names
    if (sentence := failure(result, names, record.get("sharpness"))) is not None:
        write_json(folder / REPORT, _report(mark, result, names, record, groups, started) | {"failed": sentence})
        raise InputError(f"{path}: {sentence}")
    for remark in remarks(result, names):
        say(remark)
    report = _report(mark, result, names, record, groups, started)
    _publish(work, folder)
    write_json(folder / REPORT, report)
    shutil.rmtree(work, ignore_errors=True)
    return report


def gather(
    path: Path, images: Path, work: Path, settings: PoseSettings, bar: Progress
) -> tuple[list[sources.Photograph], dict[str, Any], list[str]]:
    """The pictures in ``images``: photographs, what the report says of them, and sentences for a person."""
    listed = work / "pictures.json"
    if listed.is_file():  # an earlier call came so far
        saved = read_json(listed)
        return [sources.Photograph(**row) for row in saved["photographs"]], saved["record"], []
    messages: list[str] = []
    shutil.rmtree(images, ignore_errors=True)
    if path.is_file():
        total = video.video_frames(path) or 1000
        judged = video.judge_video(path, lambda n: bar.at("frames", 0.6 * n, total) if n % 20 == 0 else None)
        chosen = video.choose_frames(judged, settings.frames)
        n = len(judged.sharpness)
        if len(chosen) < 3:
            raise InputError(
                f"{path}: nothing moves in the video's {n} frames; walk around the subject while it records"
            )
        video.write_frames(path, chosen, images, settings.size)
        paths = sorted(images.iterdir())
        photographs, bad = sources.copy_photographs(paths, images, settings.size)
        sharp = float(np.median(judged.sharpness[chosen]))
        messages.append(f"{len(chosen)} of {n} frames are taken: the sharpest of each part in which something moves")
        if video.is_high_range(path):
            done = "its frames are converted to an ordinary one (BT.709)"
            if not video.converts_high_range():
                done = "its frames look pale, since this ffmpeg has no filter zscale to convert them"
            messages.append(f"the video has a high dynamic range (HLG or PQ): {done}")
        record: dict[str, Any] = {"frames": n, "chosen": chosen, "sharpness": sharp}
    else:
        paths = sources.find_photographs(path)
        photographs, bad = sources.copy_photographs(paths, images, settings.size)
        bad += sources.left_out(paths)
        bad += copy_masks(find_masks(path, paths), paths[0].parent, photographs, images.parent / MASKS)
        some = (
            [photographs[i] for i in np.unique(np.linspace(0, len(photographs) - 1, 16).round().astype(int))]
            if photographs
            else []
        )
        sharp = float(np.median(map_threads(lambda p: picture_sharpness(images / p.name), some))) if some else 0.0
        record = {"sharpness": sharp}
    bar.at("frames", 1, 1)
    messages += bad
    if len(photographs) < 3:
        raise InputError(
            f"{path}: fewer than three of its pictures can be read; {bad[0] if bad else 'it holds too few'}"
        )
    write_json(listed, {"photographs": [asdict(p) for p in photographs], "record": record})
    return photographs, record, messages


def picture_sharpness(path: Path) -> float:
    """Sharpness of a picture file as of a video's frames: of 320 pixels along its longer side."""
    from PIL import Image

    with Image.open(path, formats=FORMATS) as image:
        image.draft("L", (2 * video.JUDGED_SIZE, 2 * video.JUDGED_SIZE))
        grey = image.convert("L")
        scale = min(1.0, video.JUDGED_SIZE / max(grey.size))
        size = [max(8, round(side * scale)) for side in grey.size]
        return sharpness(np.asarray(grey.resize((size[0], size[1]), Image.Resampling.BOX)))


def finished(folder: Path, mark: dict[str, Any] | None = None) -> dict[str, Any] | None:
    """The report of a folder whose cameras are there, made of the same pictures by the same settings; else None."""
    if not (folder / REPORT).is_file() or not (folder / "sparse" / "0" / "images.bin").is_file():
        return None
    report = read_json(folder / REPORT)
    same = isinstance(report, dict) and "failed" not in report and (mark is None or report.get("made_of") == mark)
    return report if same else None


def _mark(path: Path, settings: PoseSettings) -> dict[str, Any]:
    """What a result depends on: the files by name, size and time of change, and the settings."""
    files = [path] if path.is_file() else sources.find_photographs(path)
    n = len(files)
    masks = {} if path.is_file() else find_masks(path, files)
    files += [mask.path for found in masks.values() for mask in found]
    seen = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]
    digest = hashlib.sha256(json.dumps(seen).encode()).hexdigest()[:16]
    settled = {key: value for key, value in asdict(settings).items() if key != "threads"}
    return {"source": str(path.resolve()), "files": n, "digest": digest, "settings": settled}


def _publish(work: Path, folder: Path) -> None:
    """Moves the model to ``sparse/0`` whole: a folder that is there is never half a model."""
    target = folder / "sparse" / "0"
    target.parent.mkdir(exist_ok=True)
    shutil.rmtree(target, ignore_errors=True)
    (work / MODEL / PLACED).unlink(missing_ok=True)
    os.replace(work / MODEL, target)


def _report(
    mark: dict[str, Any],
    result: dict[str, Any],
    names: list[str],
    record: dict[str, Any],
    groups: list[sources.CameraGroup],
    started: float,
) -> dict[str, Any]:
    placed = set(result["registered"])
    features = list(result["features"].values())
    return {
        "registered": len(placed), "photographs": len(names),
        "left_out": [name for name in names if name not in placed],
        "error_pixels": result.get("error_pixels"), "points": result.get("points"),
        "track_length": result.get("track_length"), "mapper": result.get("mapper"), "tried": result["tried"],
        "pairs": result["pairs"], "verified_pairs": len(result["links"]), "motion": result["motion"],
        "median_features": int(np.median(features)) if features else 0, "features": result["features"],
        "cameras": result.get("cameras", []), "groups": [group.describe() for group in groups],
        "seconds": {**result["seconds"], "all": round(time.perf_counter() - started, 2)},
        "repeats": "features, pairs and matches bit for bit with one seed; poses to rounding, since the mapper's threads add "
        "up in the order in which they come",
        **record, "made_of": mark, "nerfvol": __version__, "pycolmap": result.get("pycolmap"),
        "hardware": describe_hardware(),
    }  # fmt: skip
