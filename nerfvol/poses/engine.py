"""Structure from motion by pycolmap (COLMAP and GLOMAP), in a process of its own: ``python -m nerfvol.poses.engine JOB``.

A process of its own because the library prints, cannot be interrupted between two of its lines and ends the process where
it fails a check. It goes on from what its database holds: a killed run loses the pictures in hand. JOB is a JSON file with
the fields of :class:`Job`; each line of stdout is JSON: ``{"step": "features", "done": 8, "of": 100}``. The result is
``result.json`` in the job's folder ``work``, the model in ``work/model``.

Everything that draws random numbers gets the job's seed. Features, pairs and matches repeat bit for bit; the mappers'
least squares add up in the order in which threads come, so that poses repeat to rounding (docs/photographs.md).
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nerfvol.files.atomic import read_json, write_json
from nerfvol.poses.pairs import ALL, choose_pairs, in_order
from nerfvol.poses.turning import parallax

DATABASE, MODEL, RESULT, PLACED = "database.db", "model", "result.json", "placed"
AT_ONCE, PAIRS_AT_ONCE = 8, 200
ENOUGH = 0.9
"""Share of the photographs that the first mapper must place; else the other one has a try."""
MOST_MORE_PAIRS = 12_000
"""Pairs of photographs that were left out with all others, at most, that are matched before it is given up."""
MOST_TRIALS = 2000
"""Of RANSAC for a pair: finds seven right matches where 44 % are right, with 99.9 % (COLMAP's 10,000: where 35 % are). Pairs
that share nothing cost all of them."""
TRACKS = 200
"""Points a photograph, the longest tracks first, from which the global mapper finds cameras; all others are triangulated after
that. 119 frames of a walk: 46 CPU seconds instead of 153, cameras as near to the truth (docs/experiments.md)."""
GOOD_PAIR = 20
"""Verified matches of a pair that says something about how the camera moved."""


@dataclass(frozen=True)
class Job:
    """What is asked of the engine. ``groups``: each with names, width, height, model, focal, known. ``octave``: 0, or -1 to
    look for features in a picture of twice the size. ``mapper``: auto, global or incremental. ``masks``: folder of NAME.png,
    black where photograph NAME has no features; "" for none."""

    images: str
    work: str
    groups: list[dict[str, Any]]
    features: int = 3000
    octave: int = 0
    threads: int = 0
    seed: int = 0
    mapper: str = "auto"
    masks: str = ""

    @property
    def names(self) -> list[str]:
        """All photographs, in the order of their names."""
        return sorted(name for group in self.groups for name in group["names"])


Report = Callable[[str, float, float], None]


def run(job: Job, report: Report) -> dict[str, Any]:
    """Features, matches, cameras; the result as ``result.json`` has it. ``report(step, done, of)`` gets the progress."""
    import pycolmap

    pycolmap.set_random_seed(job.seed)
    work = Path(job.work)
    shutil.rmtree(work / MODEL, ignore_errors=True)
    seconds: dict[str, float] = {}
    with _Timed(seconds, "features"):
        extract(job, report)
    with _Timed(seconds, "matching"):
        how = match(job, report)
    result = _map(job, report, seconds) | {"pairs": how}
    left_out = sorted(set(job.names) - set(result["registered"]))
    again = how != ALL and len(left_out) > (1 - ENOUGH) * len(job.names)
    if again and len(left_out) * len(job.names) <= MOST_MORE_PAIRS:
        with _Timed(seconds, "more matching"):
            how = match(job, report, left_out)
        second = _map(job, report, seconds)
        if len(second["registered"]) > len(result["registered"]):
            result = second | {"pairs": how}
    result |= {"pycolmap": pycolmap.__version__, "seconds": {k: round(v, 2) for k, v in seconds.items()}}
    write_json(work / RESULT, result)
    return result


def _map(job: Job, report: Report, seconds: dict[str, float]) -> dict[str, Any]:
    """Cameras from the matches there are: by the first mapper that places enough, or by the one that places most."""
    counts, links, motion = look(job)
    result: dict[str, Any] = {"features": counts, "links": links, "motion": motion}
    placed: list[str] = []
    tried = {}
    if links:
        with _Timed(seconds, "mapping"):
            for mapper in ("global", "incremental") if job.mapper == "auto" else (job.mapper,):
                model = place(job, mapper, report)
                tried[mapper] = 0 if model is None else model.num_reg_images()
                if model is not None and model.num_reg_images() > len(placed):
                    placed = sorted(image.name for image in model.images.values() if image.has_pose)
                    result |= _describe(model) | {"mapper": mapper}
                    _keep(model, Path(job.work) / MODEL, len(placed))
                if len(placed) >= ENOUGH * len(job.names):
                    break
    return result | {"registered": placed, "tried": tried}


def _keep(model: Any, folder: Path, placed: int) -> None:
    """Writes the model unless one of more photographs is there."""
    most = folder / PLACED
    if most.is_file() and int(most.read_text()) >= placed:
        return
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    model.write(str(folder))
    most.write_text(str(placed))


class _Timed:
    def __init__(self, into: dict[str, float], name: str) -> None:
        self.into, self.name = into, name

    def __enter__(self) -> None:
        self.started = time.perf_counter()

    def __exit__(self, *failure: object) -> None:
        self.into[self.name] = self.into.get(self.name, 0.0) + time.perf_counter() - self.started


def extract(job: Job, report: Report) -> None:
    """SIFT features of the photographs that have none yet, a few at a time; one camera a group."""
    import pycolmap

    path = Path(job.work) / DATABASE
    with _open(path) as database:
        if not database.num_cameras():
            for number, group in enumerate(job.groups, 1):
                camera = pycolmap.Camera.create_from_model_name(
                    number, group["model"], group["focal"], group["width"], group["height"]
                )
                camera.has_prior_focal_length = group["known"]
                database.write_camera(camera, use_camera_id=True)
                rig = pycolmap.Rig()
                rig.add_ref_sensor(pycolmap.sensor_t(pycolmap.SensorType.CAMERA, number))
                database.write_rig(rig)
        there = {image.name for image in database.read_all_images() if database.exists_descriptors(image.image_id)}
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu, options.num_threads = False, job.threads or -1
    options.sift.first_octave, options.sift.max_num_features = job.octave, job.features
    done, all_names = len(there), job.names
    report("features", done, len(all_names))
    for number, group in enumerate(job.groups, 1):
        missing = [name for name in sorted(group["names"]) if name not in there]
        for masked in (False, True):  # a reader with masks refuses pictures that have none
            reader = pycolmap.ImageReaderOptions()
            reader.existing_camera_id = number
            if masked:
                reader.mask_path = job.masks
            names = [name for name in missing if _has_mask(job, name) == masked]
            for first in range(0, len(names), AT_ONCE):
                few = names[first : first + AT_ONCE]
                pycolmap.extract_features(
                    path, job.images, few, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
                    extraction_options=options,
                )  # fmt: skip
                done += len(few)
                report("features", done, len(all_names))


def _has_mask(job: Job, name: str) -> bool:
    return bool(job.masks) and (Path(job.masks) / f"{name}.png").is_file()


def match(job: Job, report: Report, left_out: Sequence[str] = ()) -> str:
    """Matches and verifies the pairs that are not matched yet; how pairs were chosen, in words. ``left_out``: photographs to
    match with all others."""
    import pycolmap

    work = Path(job.work)
    with _open(work / DATABASE) as database:
        images = sorted(database.read_all_images(), key=lambda image: in_order(image.name))
        descriptors = [np.asarray(_array_of(database.read_descriptors(image.image_id))) for image in images]
        wanted, how = choose_pairs(descriptors, job.seed)
        if left_out:
            far = [k for k, image in enumerate(images) if image.name in set(left_out)]
            more = {(min(i, j), max(i, j)) for i in far for j in range(len(images)) if i != j}
            wanted, how = sorted(more | set(wanted)), f"{how}; {len(far)} that were left out with all"
        missing = [
            (images[i].name, images[j].name)
            for i, j in wanted
            if not database.exists_two_view_geometry(images[i].image_id, images[j].image_id)
        ]
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu, matching.num_threads = False, job.threads or -1
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed, verification.ransac.max_num_trials = job.seed, MOST_TRIALS
    pairing = pycolmap.ImportedPairingOptions()
    listed = work / "pairs.txt"
    pairing.match_list_path = str(listed)
    report("matching", len(wanted) - len(missing), len(wanted))
    for first in range(0, len(missing), PAIRS_AT_ONCE):
        few = missing[first : first + PAIRS_AT_ONCE]
        listed.write_text("".join(f"{a} {b}\n" for a, b in few))
        pycolmap.match_image_pairs(work / DATABASE, matching, pairing, verification)
        report("matching", len(wanted) - len(missing) + first + len(few), len(wanted))
    return how


def look(job: Job) -> tuple[dict[str, int], list[tuple[str, str, int]], dict[str, float]]:
    """What was found before any camera is placed: features by photograph; verified pairs with their number of matches; how
    many of these say something about motion, and the parallax in them (poses.turning)."""
    import pycolmap

    sizes = {name: (group["width"], group["height"]) for group in job.groups for name in group["names"]}
    kinds = pycolmap.TwoViewGeometryConfiguration
    useless = (kinds.UNDEFINED, kinds.DEGENERATE, kinds.WATERMARK)
    with _open(Path(job.work) / DATABASE) as database:
        names = {image.image_id: image.name for image in database.read_all_images()}
        counts = {name: database.num_keypoints_for_image(number) for number, name in names.items()}
        points = {number: _positions(database.read_keypoints(number), *sizes[name]) for number, name in names.items()}
        pair_ids, geometries = database.read_two_view_geometries()
    links, matched = [], []
    for pair, geometry in zip(pair_ids, geometries, strict=True):
        matches = np.asarray(geometry.inlier_matches)
        if not len(matches) or geometry.config in useless:
            continue
        first, second = pycolmap.pair_id_to_image_pair(pair)
        links.append((names[first], names[second], len(matches)))
        if len(matches) >= GOOD_PAIR:
            matched.append((points[first][matches[:, 0]], points[second][matches[:, 1]]))
    return counts, sorted(links), {"good_pairs": len(matched), "parallax": parallax(matched)}


def _positions(keypoints: Any, width: int, height: int) -> NDArray[np.float64]:
    """(n, 2) relative to the middle of the picture, in longer sides."""
    rows = np.asarray(_array_of(keypoints), dtype=np.float64)
    xy = rows[:, :2] if len(rows) else np.zeros((0, 2))
    return (xy - (width / 2, height / 2)) / max(width, height)


def place(job: Job, mapper: str, report: Report) -> Any:
    """The largest model that a mapper makes, or None."""
    import pycolmap

    work = Path(job.work)
    out = work / mapper
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir()
    pycolmap.set_random_seed(job.seed)
    n = len(job.names)
    report(f"{mapper} mapping", 0, n)
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.random_seed = options.mapper.random_seed = job.seed
        options.mapper.rotation_averaging.random_seed = options.mapper.global_positioning.random_seed = job.seed
        options.num_threads = job.threads or -1
        options.mapper.track_required_tracks_per_view = TRACKS
        models = pycolmap.global_mapping(work / DATABASE, job.images, out, options)
    else:
        placed = iter(range(1, n + 1))
        steps = pycolmap.IncrementalPipelineOptions()
        steps.random_seed = steps.mapper.random_seed = steps.triangulation.random_seed = job.seed
        steps.num_threads = job.threads or -1
        steps.min_model_size = 3

        def one_more() -> None:
            report("incremental mapping", next(placed, n), n)

        models = pycolmap.incremental_mapping(
            work / DATABASE, job.images, out, steps, initial_image_pair_callback=one_more, next_image_callback=one_more
        )
    shutil.rmtree(out, ignore_errors=True)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _describe(model: Any) -> dict[str, Any]:
    """Of a model: reprojection error, points, cameras as they came out."""
    cameras = []
    for number, camera in sorted(model.cameras.items()):
        values = [float(x) for x in camera.params]
        shape = camera.width, camera.height
        cameras.append({"camera": number, "lens": camera.model.name, "width": shape[0], "height": shape[1],
                        "parameters": values, "focal": float(camera.mean_focal_length())})  # fmt: skip
    return {
        "error_pixels": round(model.compute_mean_reprojection_error(), 4), "points": model.num_points3D(),
        "track_length": round(model.compute_mean_track_length(), 2), "cameras": cameras,
    }  # fmt: skip


def _array_of(record: Any) -> Any:
    """The array inside a library's record of descriptors or keypoints."""
    return getattr(record, "data", record)


class _open:
    """A database that is closed at the end of the block."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> Any:
        import pycolmap

        self.database = pycolmap.Database.open(str(self.path))
        return self.database

    def __exit__(self, *failure: object) -> None:
        self.database.close()


def main(arguments: Sequence[str]) -> int:
    """Run the job in the file that is named; the exit code."""

    def report(step: str, done: float, of: float) -> None:
        print(json.dumps({"step": step, "done": done, "of": of}), flush=True)

    run(Job(**read_json(arguments[0])), report)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
