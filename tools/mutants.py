# ruff: noqa: E501
"""Plants a fixed list of bugs, one at a time, in a copy of the source, and asks the tests that should see them.

    python tools/mutants.py [WORD ...]      (make mutants)    with words: only bugs whose file or note holds one

A bug that no test sees is a survivor: it is printed, and the exit code is 1. A bug whose place is no longer in the source is
an error: the list follows the source. The kernels that are installed are used; bugs in C++ are built into a copy of their own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from own_build import ROOT

LIMIT = 300
"""Seconds that the tests of one bug may take: a bug that makes them hang was seen."""


@dataclass(frozen=True)
class Mutant:
    """``old`` stands once in ``file`` and becomes ``new``; ``tests``: paths below tests/, or with ::name; ``note``: the bug."""

    file: str
    old: str
    new: str
    tests: str
    note: str


M = Mutant
PEOPLE, MASKS, FAULTS = "datasets/test_whatever_people_bring.py", "datasets/test_masks.py", "training/test_faults.py"
PROGRAMS = "datasets/test_other_programs.py"
SETS, EXPOSURES, POSE_MASKS = "datasets/test_dataset.py", "starts/test_exposures.py", "poses/test_masks.py"
MUTANTS = (
    # ---------------------------------------------------------------- cameras
    M("nerfvol/cameras/camera.py", "np.arange(width) + 0.5\n        band", "np.arange(width)\n        band", "cameras", "rays through pixels' corners"),
    M("nerfvol/cameras/camera.py", "fx=self.fx / k, fy=self.fy / k, cx=self.cx / k", "fx=self.fx / k, fy=self.fy / k, cx=self.cx", "cameras", "the principal point of smaller pictures"),
    M("nerfvol/cameras/camera.py", "return rigid_pose(whole), float(np.prod(lengths)) ** (1 / 3)", "return rigid_pose(matrix), 1.0", PEOPLE, "scaled axes are refused"),
    M("nerfvol/cameras/lens.py", "x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y", "x * radial + 2 * p1 * x * y - p2 * (s + 2 * x * x), y", "cameras", "a sign in the tangential distortion"),
    M("nerfvol/cameras/lens.py", "found = done & (theta <= fold)", "found = done", MASKS + "::test_the_second_branch_of_a_lens_is_no_picture", "a lens's second branch is taken for its picture"),
    M("nerfvol/cameras/focus.py", "kept = _agreeing(across, origins)", "kept = np.ones(len(origins), dtype=bool)", PEOPLE, "one axis moves the point that all look at"),
    M("nerfvol/cameras/calibration.py", "fx = self.fx * sx if", "fx = self.fx if", PEOPLE, "the focal length of resized pictures"),
    # ---------------------------------------------------------------- datasets
    M("nerfvol/datasets/listing.py", "if scale != 1:", "if False:", PEOPLE, "scaled axes are taken in silence"),
    M("nerfvol/datasets/listing.py", "self.lost.append(listed)\n", "", PEOPLE, "lost poses are passed over in silence"),
    M("nerfvol/datasets/listing.py", 'and not path.name.startswith(".") and not is_mask', "and not is_mask", PEOPLE, "files of operating systems are photographs"),
    M("nerfvol/datasets/listing.py", "MaskFile(mask, black_is_out=False)", "MaskFile(mask)", MASKS, "the convention of dynamic masks"),
    M("nerfvol/datasets/frames.py", "parts.append(pixels if mask.black_is_out else 255 - pixels)", "parts.append(255 - pixels if mask.black_is_out else pixels)", MASKS, "masks the other way round"),
    M("nerfvol/datasets/frames.py", "found |= {id(view) for", "found |= {None for", PEOPLE, "cameras astray stay in"),
    M("nerfvol/datasets/images.py", "Image.open(path, formats=FORMATS)", "Image.open(path)", "datasets/test_images.py", "every decoder is offered to a file"),
    M("nerfvol/datasets/images.py", "6: (1, -1), 7: (-1, -1), 8: (-1, 1)", "6: (-1, 1), 7: (-1, -1), 8: (1, -1)", PEOPLE, "EXIF 6 and 8 change places"),
    M("nerfvol/datasets/images.py", "return ((total + by // np.uint32(2)) // by)", "return (total // by)", "datasets/test_images.py", "averages are cut, not rounded"),
    M("nerfvol/datasets/images.py", "both = area_average(np.concatenate([image, mask[..., None]], axis=2), k)", "both = np.concatenate([area_average(image, k), mask_average(mask, k)[..., None]], axis=2)", MASKS, "what is masked colours averages"),
    M("nerfvol/datasets/kinds.py", "float(np.mean([share >= FAIR_SHARE for share in self.transparent])) >= NEARLY_ALL", "any(share > 0 for share in self.transparent)", PEOPLE, "one pixel of alpha makes an object"),
    M("nerfvol/datasets/kinds.py", "alike = np.abs(colours - common).max(axis=1) <= NOISE", "alike = plain", PEOPLE, "backdrops of two colours are one"),
    M("nerfvol/datasets/transforms.py", "return [f\"{path.name} states what is not used: {named(told, 8)}\"] if told else []", "return []", PEOPLE, "unused keys are passed over in silence"),
    M("nerfvol/datasets/transforms.py", "held = everything - taken\n", "held = everything\n", PEOPLE, "views of training are held out"),
    M("nerfvol/datasets/colmap.py", "best = max(models, key=lambda model: counts[model])", "best = models[0]", PEOPLE, "the first COLMAP model is taken"),
    M("nerfvol/datasets/colmap_files.py", "if below and _is_features(line):", "if below:", PEOPLE, "every second line is no image"),
    M("nerfvol/datasets/tiles.py", "np.where(padding, 0, mask.reshape(-1)[np.maximum(flat, 0)])", "np.where(padding, 0, 255)", MASKS, "masked rays have weight"),
    M("nerfvol/datasets/tiles.py", "return len(self.foreground_tiles) + len(self.background_tiles)", "return len(self.image) + 1", "datasets/test_tiles.py", "the expected loss is not the mean"),
    M("nerfvol/datasets/photographs.py", "np.minimum(mask, own)[..., None]", "np.full_like(mask, 255)[..., None]", MASKS, "splats learn what is masked"),
    M("nerfvol/datasets/frame.py", "octree.size * self.scale, octree.density_scale / self.scale", "octree.size * self.scale, octree.density_scale", FAULTS, "densities in another unit"),
    M("nerfvol/datasets/fingerprint.py", 'said.append(f"{len(gone)} are gone ({named(gone)})")', "pass", FAULTS, "missing pictures are not missed"),
    # ---------------------------------------------------------------- what other programs write
    M("nerfvol/datasets/listing.py", 'return unicodedata.normalize("NFC", name).lower()', "return name.lower()", PROGRAMS, "names of macOS are other names"),
    M("nerfvol/datasets/listing.py", 'address = unquote(re.sub("^file://", "", listed))', "address = listed", PROGRAMS, "addresses are names"),
    M("nerfvol/datasets/listing.py", "if absolute else range(len(parts) - 1, len(parts)):", "if absolute else ():", PROGRAMS, "pictures next to the json"),
    M("nerfvol/datasets/listing.py", 'for name in ("masks", "mask"))', 'for name in ("masks",))', PROGRAMS, "masks in a folder called mask"),
    M("nerfvol/datasets/listing.py", 'f"{path.name}.mask", f"{path.stem}.mask", f"{path.stem}_mask"', 'f"{path.name}.mask", f"{path.stem}.mask", f"{path.stem}.mask"', PROGRAMS, "Metashape's masks"),
    M("nerfvol/datasets/listing.py", "if folder not in self._in_use and not with_mask and frames]", "if False]", PROGRAMS, "masks that fit no image are passed over in silence"),
    M("nerfvol/datasets/transforms.py", "or by_end.get(name) or name\n", "or name\n", PROGRAMS, "lists of bare names"),
    M("nerfvol/datasets/transforms.py", "if f.path in trained)):", "if f.path is trained)):", PROGRAMS, "pictures in two splits"),
    M("nerfvol/datasets/frames.py", "return header.orientation <= 4 or width == height or not", "return width == height or not", PROGRAMS, "orientations that nothing settles"),
    M("nerfvol/datasets/frames.py", "stated = calibration.width is not None and calibration.height is not None\n    return", "stated = False\n    return", PROGRAMS, "orientations that the size settles"),
    M("nerfvol/datasets/kinds.py", "if (apart <= 1e-9).all():", "if False:", PROGRAMS, "poses that are all the same"),
    M("nerfvol/datasets/llff.py", "depths = rows[(rows[:, 15] > 0) & (rows", "depths = rows[(rows", PROGRAMS, "depths behind the camera"),
    M("nerfvol/datasets/llff.py", "rows[np.ix_(lost, np.array([4, 9, 14]))] = rows[stated.argmax(), [4, 9, 14]]", "pass", PROGRAMS, "one row of NaN refuses the set"),
    M("nerfvol/datasets/nsvf.py", "if len(bare) > MOST_LOST * len(images):", "if False:", PROGRAMS, "a set without poses trains"),
    M("nerfvol/datasets/nsvf.py", "return np.array(rows[0]).reshape(4 if len(rows[0]) == 16 else 3, -1)", "return np.array(rows[0]).reshape(4 if len(rows[0]) == 16 else 3, -1).T", PROGRAMS, "a flat matrix by columns"),
    M("nerfvol/datasets/colmap.py", "homes = (folder, folder.parent, folder.parent.parent) if", "homes = (folder,) if", PROGRAMS, "photographs above the model"),
    M("nerfvol/datasets/colmap.py", "if count > 1]:", "if count > 2]:", PROGRAMS, "an image twice"),
    M("nerfvol/datasets/colmap_files.py", "if name.endswith(\"*\") and value]:", "if name.endswith(\"*\") and value > 1]:", PROGRAMS, "terms that the lens lacks"),
    M("nerfvol/datasets/colmap_files.py", '"SIMPLE_FISHEYE": (14, Fisheye', '"SIMPLE_FISHEYE": (14, BrownConrady', PROGRAMS, "a fisheye that is a pinhole"),
    M("nerfvol/cameras/calibration.py", "_WIDEST = 2 * math.tan(math.radians(80))", "_WIDEST = 2 * math.tan(math.radians(89))", PROGRAMS, "focal lengths in millimetres"),
    M("nerfvol/datasets/formats.py", "for place in (path.parent, *sorted(below)) if", "for place in sorted(below) if", PROGRAMS, "the set above the folder"),
    # ---------------------------------------------------------------- damaged pictures
    M("nerfvol/datasets/frames.py", "if wrong and (len(wrong) > max(1, FEW * n) or n < 10):", "if wrong and len(wrong) > max(1, FEW * n):", "datasets/test_transforms.py", "of few pictures a damaged one is left out"),
    M("nerfvol/datasets/frames.py", "if wrong and (len(wrong) > max(1, FEW * n) or n < 10):", "if wrong and (len(wrong) > n // 2 or n < 10):", "datasets/test_transforms.py", "half of the pictures may be damaged"),
    M("nerfvol/datasets/frames.py", "        messages.append(unread_sentence(list(unread.values())))\n", "        pass\n", "datasets/test_transforms.py", "damaged pictures are left out in silence"),
    M("nerfvol/datasets/load.py", "        messages.append(unread_sentence(wrong))\n", "        pass\n", "datasets/test_transforms.py", "truncated pictures are left out in silence"),
    # ---------------------------------------------------------------- extras
    M("nerfvol/octree/plenoctree.py", "values = eval_basis(degree, directions)", "import torch; values = eval_basis(degree, torch.from_numpy(directions)).numpy()", "test_without_torch.py", "PlenOctrees need torch"),
    M("nerfvol/starts/values.py", "held = min(dim, sh.shape[-1])", "held = dim", "starts/test_field.py", "fields of a lower degree"),
    M("nerfvol/starts/values.py", "projector = (weights[:, None] * spherical.eval_basis(degree, dirs))", "projector = (weights[:, None] * spherical.eval_basis(degree, -dirs))", "starts/test_field.py", "view dependence from behind"),
    # ---------------------------------------------------------------- files, settings, terminals
    M("nerfvol/files/atomic.py", "Path(os.path.realpath(named)) if named.is_symlink() else named", "named", "files/test_atomic.py", "a link is replaced"),
    M("nerfvol/files/atomic.py", "    if is_special(path):\n", "    if False:\n", "files/test_atomic.py", "a pipe is replaced"),
    M("nerfvol/files/atomic.py", "        _sync(temporary)\n        os.replace", "        os.replace", "files/test_atomic.py", "renamed before it is on the disk"),
    M("nerfvol/files/atomic.py", "object_pairs_hook=_once", "object_pairs_hook=dict", "files/test_atomic.py", "the second of two keys wins"),
    M("nerfvol/config/assemble.py", "        if self.check_event(yaml.AliasEvent):\n", "        if False:\n", "config/test_config.py", "YAML aliases"),
    M("nerfvol/errors.py", "code < 0x20 or", "code < 0x10 or", "cli/test_terminal.py", "escape codes reach the terminal"),
    M("nerfvol/cli/terminal.py", "            if not self.goes_on:\n                raise\n            self.silence()\n        except UnicodeEncodeError", "            raise\n        except UnicodeEncodeError", "cli/test_terminal.py", "| head ends a training"),
    M("nerfvol/octree/io.py", "        require_memory(n_vertices", "        (lambda *_: None)(n_vertices", "octree/test_io.py", "a bomb is tried"),
    M("nerfvol/training/prepare.py", "PREVIOUS if finished or not kept else UNFINISHED", "PREVIOUS", FAULTS, "a run without a model takes the place of one with"),
    M("nerfvol/training/session.py", '("SIGINT", "SIGTERM", "SIGHUP")', '("SIGINT",)', FAULTS, "kill loses a run"),
    # ---------------------------------------------------------------- mathematics
    M("nerfvol/measure/metrics.py", "mse = float(np.mean(error * error, dtype=np.float64))", "mse = float(np.mean(np.abs(error), dtype=np.float64))", "measure/test_metrics.py", "PSNR of the absolute error"),
    M("nerfvol/measure/scores.py", "psnr(of[seen], truth[seen])", "psnr(of, truth)", MASKS, "masked pixels are scored"),
    M("nerfvol/region.py", "np.ceil(np.log2(np.maximum(distance, 1)))", "np.floor(np.log2(np.maximum(distance, 1)))", "octree test_views.py starts", "levels of the background shells"),
    M("nerfvol/views.py", "pose[:3, 3] = (pose[:3, 3] - middle) / scale", "pose[:3, 3] = pose[:3, 3] / scale", FAULTS, "cameras far from the origin"),
    # ---------------------------------------------------------------- kernels
    M("nerfvol/kernels/csrc/adjoint.h", "g[k] = 2 * weight * residual;", "g[k] = 2 * residual;", "kernels/test_train.py", "gradients without the rays' weights"),
    M("nerfvol/kernels/csrc/train.h", "w = std::max(w, leaf.max_weight);", "w = leaf.max_weight;", "kernels/test_train.py", "the last weight of a leaf is its largest"),
    # ---------------------------------------------------------------- photographs
    M("nerfvol/datasets/load.py", "_small(view.path, state.st_mtime_ns, state.st_size)", "_small(view.path, 0, 0)", SETS, "changed pictures are judged as they were"),
    M("nerfvol/datasets/load.py", "_small(view.path, state.st_mtime_ns, state.st_size)", "_small(view.path, state.st_mtime_ns, 0)", SETS, "pictures of another size are judged as they were"),
    M("nerfvol/datasets/load.py", "lru_cache(maxsize=MOST_JUDGED)", "lru_cache(maxsize=0)", SETS, "each split decodes what it is judged by"),
    M("nerfvol/datasets/photographs.py", "fits = self._most is None or self._bytes + more <= self._most", "fits = True", "datasets/test_photographs.py", "photographs are kept without bound"),
    M("nerfvol/datasets/photographs.py", "self._bytes -= view.image.nbytes", "pass", "datasets/test_photographs.py", "what is dropped counts on"),
    M("nerfvol/training/memory.py", "return dataset.nbytes + kept, kept / wanted", "return kept, kept / wanted", "training/test_memory.py", "the images themselves are not in the estimate"),
    M("nerfvol/poses/sources.py", "    if not heif:\n        return []\n    return [f", "    if True:\n        return []\n    return [f", "poses/test_sources.py", "HEIC pictures beside others are passed over in silence"),
    M("nerfvol/poses/video.py", "select = _any_of(chosen)", "select = '+'.join(map(_any_of, zip(chosen)))", "poses/test_video.py", "more than 100 frames of a video are refused"),
    M("nerfvol/poses/masks.py", "small) < 255] = 0", "small) < 1] = 0", POSE_MASKS, "smaller pixels that show a part of what is masked are seen"),
    M("nerfvol/poses/masks.py", "pixels if mask.black_is_out else 255 - pixels", "pixels", POSE_MASKS, "the convention of dynamic masks, copied"),
    M("nerfvol/poses/masks.py", "1 if painted_upright else orientation", "orientation", POSE_MASKS, "masks that were painted upright are refused"),
    M("nerfvol/poses/engine.py", "reader.mask_path = job.masks", "pass", POSE_MASKS, "features of what is masked"),
    M("nerfvol/poses/engine.py", "if _has_mask(job, name) == masked]", "if masked or not job.masks]", POSE_MASKS, "photographs without a mask get no features"),
    M("nerfvol/poses/make.py", "files += [mask.path for", "[] and [mask.path for", POSE_MASKS, "other masks, the same cameras"),
    M("nerfvol/starts/exposures.py", "right[i] -= ratio", "right[i] -= 0", EXPOSURES, "half of the normal equations"),
    M("nerfvol/starts/exposures.py", "gains /= gains[seen].mean(0)", "gains *= 1.1", EXPOSURES, "the mean exposure is not 1"),
    M("nerfvol/starts/exposures.py", "float(np.sqrt((apart * apart).mean() / 2))", "float(logs.std())", EXPOSURES, "slow changes are a reason for maps"),
    M("nerfvol/starts/exposures.py", "1.4826 * float(np.median(np.abs(left.mean(1))))", "float(left.std())", EXPOSURES, "one pair in a shadow makes all doubtful"),
    M("nerfvol/starts/exposures.py", "< COVERED * n", "< 0", EXPOSURES, "what shares nothing is compared"),
    M("nerfvol/training/train.py", "left >= MEASURED_FROM * len(dataset)", "left >= 0", "training/test_appearance.py", "seconds that a run does not have measure exposures"),
    M("nerfvol/training/train.py", "run.phase != config.representation:", "True:", "training/test_appearance.py", "resumed runs measure exposures again"),
    # ---------------------------------------------------------------- data_synth
    M("data_synth/phase.py", "q = 1.0 + g * g - 2.0 * g * cosine", "q = 1.0 + g * g - g * cosine", "data_synth/test_phase.py", "Henyey-Greenstein's denominator"),
)  # fmt: skip


def main(words: list[str]) -> int:
    chosen = [m for m in MUTANTS if not words or any(word in f"{m.file} {m.note}" for word in words)]
    survivors, stale = [], []
    with tempfile.TemporaryDirectory() as folder:
        copy = _copy(Path(folder))
        for number, mutant in enumerate(chosen, 1):
            path = copy / mutant.file
            text = path.read_text(encoding="utf-8")
            began = time.monotonic()
            if text.count(mutant.old) != 1:
                stale.append(mutant)
                result = "STALE"
            else:
                path.write_text(text.replace(mutant.old, mutant.new), encoding="utf-8")
                seen = _is_seen(copy, mutant)
                path.write_text(text, encoding="utf-8")
                result = "seen" if seen else "SURVIVED"
                survivors += [] if seen else [mutant]
            print(
                f"{number:3d}/{len(chosen)} {result:8s} {time.monotonic() - began:5.0f} s  {mutant.file}: {mutant.note}",
                flush=True,
            )
    print(f"{len(chosen) - len(survivors) - len(stale)} of {len(chosen)} planted bugs seen")
    for mutant in survivors:
        print(f"survivor: {mutant.file}: {mutant.note} (tests/{mutant.tests})")
    for mutant in stale:
        print(f"stale: {mutant.file}: {mutant.old!r} does not stand there once")
    return 1 if survivors or stale else 0


def _copy(folder: Path) -> Path:
    """The tracked and new files of the working tree."""
    copy = folder / "tree"
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.splitlines()
    for name in listed:
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, copy / name)
    return copy


def _is_seen(copy: Path, mutant: Mutant) -> bool:
    """Whether a test fails."""
    places = [str(copy)]
    if mutant.file.endswith((".h", ".cpp")):
        places.insert(0, str(_build(copy)))
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([*places, os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
                   "PYTHONDONTWRITEBYTECODE": "1"}  # fmt: skip
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    try:
        done = subprocess.run(
            [*command, *(f"tests/{test}" for test in mutant.tests.split())], cwd=copy, env=environment, timeout=LIMIT,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return True
    if done.returncode < 0:  # a signal that the bug let through
        return True
    if done.returncode > 1:
        raise SystemExit(f"pytest could not run tests/{mutant.tests} (exit code {done.returncode})")
    return done.returncode == 1


def _build(copy: Path) -> Path:
    """The kernels of the copy, built in it; a second time only what has changed."""
    build = copy / "build" / "mutant"
    generator = ["-G", "Ninja"] if shutil.which("ninja") else []
    options = ["-DSKBUILD_PROJECT_VERSION=mutant", f"-DPython_EXECUTABLE={sys.executable}"]
    quiet = {"check": True, "stdout": subprocess.DEVNULL}
    subprocess.run(["cmake", "-S", copy / "nerfvol/kernels/csrc", "-B", build, *generator, *options], **quiet)  # pyright: ignore[reportCallIssue, reportArgumentType]
    subprocess.run(["cmake", "--build", build, "--parallel"], **quiet)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return build


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
