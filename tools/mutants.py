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
PROGRAMS, PLAIN = "datasets/test_other_programs.py", "data_synth/test_plain.py"
ROUGH, CORE = "data_synth/test_rough.py", "data_synth/test_compiled.py"
SCANS, FLAKES, FIELDS, CLOUDS, TOGETHER, RECOVERED = (
    f"data_synth/test_plain.py::test_in_plain_python[plain_{name}.py]"
    for name in ("scans", "flakes", "fields", "clouds", "combined", "recovered")
)
STRATUS = "data_synth/test_noise_clouds.py::test_a_layer_of_stratus_has_tiles_by_scale_and_holes_by_erosion"
CARVED = "data_synth/test_noise_clouds.py::test_the_clouds_of_a_landscape_are_carved_and_end_before_the_box_does"
TRANSPORT, FITTING = "medium/test_transport.py", "training/test_medium_trainer.py"
SETS, EXPOSURES, POSE_MASKS = "datasets/test_dataset.py", "starts/test_exposures.py", "poses/test_masks.py"
MUTANTS = (
    # ---------------------------------------------------------------- cameras
    M("nerfvol/cameras/intrinsics.py", "np.arange(width) + 0.5\n        band", "np.arange(width)\n        band", "cameras", "rays through pixels' corners"),
    M("nerfvol/cameras/intrinsics.py", "fx=self.fx / k, fy=self.fy / k, cx=self.cx / k", "fx=self.fx / k, fy=self.fy / k, cx=self.cx", "cameras", "the principal point of smaller pictures"),
    M("nerfvol/cameras/pose.py", "return rigid_pose(whole), float(np.prod(lengths)) ** (1 / 3)", "return rigid_pose(matrix), 1.0", PEOPLE, "scaled axes are refused"),
    M("nerfvol/cameras/lens.py", "x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x), y", "x * radial + 2 * p1 * x * y - p2 * (s + 2 * x * x), y", "cameras", "a sign in the tangential distortion"),
    M("nerfvol/cameras/lens.py", "found = done & (theta <= fold)", "found = done", MASKS + "::test_the_second_branch_of_a_lens_is_no_picture", "a lens's second branch is taken for its picture"),
    M("nerfvol/cameras/focus.py", "kept = _agreeing(across, origins)", "kept = np.ones(len(origins), dtype=bool)", PEOPLE, "one axis moves the point that all look at"),
    M("nerfvol/cameras/calibration.py", "fx = self.fx * sx if", "fx = self.fx if", PEOPLE, "the focal length of resized pictures"),
    # ---------------------------------------------------------------- datasets
    M("nerfvol/datasets/colours.py", "name, known = f\"a gamma of {gamma:.3g}\", 1 / gamma", "name, known = f\"a gamma of {gamma:.3g}\", gamma", "datasets/test_colours.py", "a PNG's gamma the wrong way round"),
    M("nerfvol/datasets/colours.py", "np.array(self.matrix, np.float32).T", "np.array(self.matrix, np.float32)", "datasets/test_colours.py", "primaries transposed"),
    M("nerfvol/datasets/colours.py", "made.putalpha(whole.getchannel(\"A\"))", "pass", "datasets/test_colours.py", "grey with a profile loses its transparency"),
    M("nerfvol/datasets/images.py", "_pixels(image, path, as_stored=True)", "_pixels(image, path)", "datasets/test_colours.py", "masks are converted as colours are"),
    M("nerfvol/datasets/colours.py", "if _space(profile) in (\"RGB\", \"GRAY\") and _is_srgb(profile):", "if False:", "datasets/test_colours.py", "sRGB's own profile changes bits"),
    M("nerfvol/datasets/bounds.py", "0.5 * hint.aabb_scale / hint.unit", "0.5 * hint.aabb_scale / INSTANT_NGP_SCALE", "datasets/test_habits.py", "aabb_scale in units that the file does not state"),
    M("nerfvol/datasets/kinds.py", "opencv = inverse.ahead <= LOOKS_AWAY and not looks_away", "opencv = False", "datasets/test_habits.py", "world-to-camera matrices in OpenCV axes are not suspected"),
    M("nerfvol/cameras/calibration.py", "\"cx\": matrix[0, 2], \"cy\": matrix[1, 2]}", "\"cx\": matrix[1, 2], \"cy\": matrix[0, 2]}", "datasets/test_habits.py", "a matrix's principal point turned over"),
    M("nerfvol/poses/video.py", "colours = \":out_color_matrix=bt601\"", "colours = \"\"", "poses/test_video.py", "frames in JPEG with the video's matrix"),
    M("nerfvol/poses/video.py", "_AS_BT2020 if \"unknown\" in stated else", "\"\" if \"unknown\" in stated else", "poses/test_video.py", "HDR videos that state their curve alone are refused"),
    M("nerfvol/poses/sources.py", "upright if colours is None else colours.to_srgb(upright)", "upright", "poses/test_sources.py", "copies of photographs lose their profile"),
    M("nerfvol/datasets/listing.py", "if scale != 1:", "if False:", PEOPLE, "scaled axes are taken in silence"),
    M("nerfvol/datasets/listing.py", "self.lost.append(listed)\n", "", PEOPLE, "lost poses are passed over in silence"),
    M("nerfvol/datasets/listing.py", 'path.name.startswith(".") or is_mask', "is_mask", PEOPLE, "files of operating systems are photographs"),
    M("nerfvol/datasets/masks.py", "MaskFile(mask, black_is_out=False)", "MaskFile(mask)", MASKS, "the convention of dynamic masks"),
    M("nerfvol/datasets/frames.py", "parts.append(pixels if mask.black_is_out else 255 - pixels)", "parts.append(255 - pixels if mask.black_is_out else pixels)", MASKS, "masks the other way round"),
    M("nerfvol/datasets/odd_ones.py", "found |= {id(view) for view, far in", "found |= {None for view, far in", PEOPLE, "cameras astray stay in"),
    M("nerfvol/datasets/images.py", "Image.open(path, formats=FORMATS)", "Image.open(path)", "datasets/test_images.py", "every decoder is offered to a file"),
    M("nerfvol/datasets/images.py", "6: (1, -1), 7: (-1, -1), 8: (-1, 1)", "6: (-1, 1), 7: (-1, -1), 8: (1, -1)", PEOPLE, "EXIF 6 and 8 change places"),
    M("nerfvol/datasets/averages.py", "return ((total + by // np.uint32(2)) // by)", "return (total // by)", "datasets/test_images.py", "averages are cut, not rounded"),
    M("nerfvol/datasets/averages.py", "both = area_average(np.concatenate([image, mask[..., None]], axis=2), k)", "both = np.concatenate([area_average(image, k), mask_average(mask, k)[..., None]], axis=2)", MASKS, "what is masked colours averages"),
    M("nerfvol/datasets/kinds.py", "float(np.mean([share >= FAIR_SHARE for share in self.transparent])) >= NEARLY_ALL", "any(share > 0 for share in self.transparent)", PEOPLE, "one pixel of alpha makes an object"),
    M("nerfvol/datasets/kinds.py", "alike = np.abs(colours - common).max(axis=1) <= NOISE", "alike = plain", PEOPLE, "backdrops of two colours are one"),
    M("nerfvol/datasets/transforms.py", "return [f\"{path.name} states what is not used: {named(told, 8)}\"] if told else []", "return []", PEOPLE, "unused keys are passed over in silence"),
    M("nerfvol/datasets/split_lists.py", "held = everything - taken\n", "held = everything\n", PEOPLE, "views of training are held out"),
    M("nerfvol/datasets/colmap.py", "best = max(models, key=lambda model: counts[model])", "best = models[0]", PEOPLE, "the first COLMAP model is taken"),
    M("nerfvol/datasets/colmap_files.py", "if below and _is_features(line):", "if below:", PEOPLE, "every second line is no image"),
    M("nerfvol/datasets/tiles.py", "np.where(padding, 0, mask.reshape(-1)[np.maximum(flat, 0)])", "np.where(padding, 0, 255)", MASKS, "masked rays have weight"),
    M("nerfvol/datasets/tiles.py", "return len(self.foreground_tiles) + len(self.background_tiles)", "return len(self.image) + 1", "datasets/test_tiles.py", "the expected loss is not the mean"),
    M("nerfvol/datasets/tiles.py", "reshape(-1, 3)[rays]", "reshape(-1, 3)[np.maximum(flat, 0)]", "datasets/test_tiles.py", "padding points at the first pixel"),
    M("nerfvol/datasets/photographs.py", "np.minimum(mask, own)[..., None]", "np.full_like(mask, 255)[..., None]", MASKS, "splats learn what is masked"),
    M("nerfvol/datasets/frame.py", "octree.size * self.scale, octree.density_scale / self.scale", "octree.size * self.scale, octree.density_scale", FAULTS, "densities in another unit"),
    M("nerfvol/datasets/fingerprint.py", 'said.append(f"{len(gone)} are gone ({named(gone)})")', "pass", FAULTS, "missing pictures are not missed"),
    # ---------------------------------------------------------------- what other programs write
    M("nerfvol/datasets/listing.py", 'return unicodedata.normalize("NFC", name).lower()', "return name.lower()", PROGRAMS, "names of macOS are other names"),
    M("nerfvol/datasets/listing.py", 'address = unquote(re.sub("^file://", "", listed))', "address = listed", PROGRAMS, "addresses are names"),
    M("nerfvol/datasets/listing.py", "if absolute else range(len(parts) - 1, len(parts)):", "if absolute else ():", PROGRAMS, "pictures next to the json"),
    M("nerfvol/datasets/masks.py", 'for name in ("masks", "mask"))', 'for name in ("masks",))', PROGRAMS, "masks in a folder called mask"),
    M("nerfvol/datasets/masks.py", 'f"{path.name}.mask", f"{path.stem}.mask", f"{path.stem}_mask"', 'f"{path.name}.mask", f"{path.stem}.mask", f"{path.stem}.mask"', PROGRAMS, "Metashape's masks"),
    M("nerfvol/datasets/masks.py", "if folder not in self._in_use and not with_mask and frames]", "if False]", PROGRAMS, "masks that fit no image are passed over in silence"),
    M("nerfvol/datasets/split_lists.py", " or by_end.get(end) or by_end.get(_stem(end))", "", PROGRAMS, "lists of bare names"),
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
    M("nerfvol/datasets/listing.py", "wrong <= max(1, FEW * n) and n >= ENOUGH_TO_JUDGE", "wrong <= max(1, FEW * n)", "datasets/test_transforms.py", "of few pictures a damaged one is left out"),
    M("nerfvol/datasets/listing.py", "wrong <= max(1, FEW * n) and", "wrong <= n // 2 and", "datasets/test_transforms.py", "half of the pictures may be damaged"),
    M("nerfvol/datasets/frames.py", "        messages.append(unread_sentence(list(unread.values())))\n", "        pass\n", "datasets/test_transforms.py", "damaged pictures are left out in silence"),
    M("nerfvol/datasets/decoding.py", "        messages.append(unread_sentence(wrong))\n", "        pass\n", "datasets/test_transforms.py", "truncated pictures are left out in silence"),
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
    M("nerfvol/training/clock.py", '("SIGINT", "SIGTERM", "SIGHUP")', '("SIGINT",)', FAULTS, "kill loses a run"),
    # ---------------------------------------------------------------- mathematics
    M("nerfvol/measure/metrics.py", "mse = float(np.mean(error * error, dtype=np.float64))", "mse = float(np.mean(np.abs(error), dtype=np.float64))", "measure/test_metrics.py", "PSNR of the absolute error"),
    M("nerfvol/measure/scores.py", "psnr(of[seen], truth[seen])", "psnr(of, truth)", MASKS, "masked pixels are scored"),
    M("nerfvol/region.py", "np.ceil(np.log2(np.maximum(distance, 1)))", "np.floor(np.log2(np.maximum(distance, 1)))", "test_region.py", "levels of the background shells"),
    M("nerfvol/views.py", "pose[:3, 3] = (pose[:3, 3] - middle) / scale", "pose[:3, 3] = pose[:3, 3] / scale", FAULTS, "cameras far from the origin"),
    # ---------------------------------------------------------------- cameras and numbers, second values
    M("nerfvol/cameras/interpolate.py", "before * w_after[:, None] + after * w_before[:, None]", "before * w_before[:, None] + after * w_after[:, None]", "cameras/test_paths.py", "tangents between uneven keyframes"),
    M("nerfvol/cameras/interpolate.py", "fx=a.fx ** (1 - t) * b.fx**t", "fx=(1 - t) * a.fx + t * b.fx", "cameras/test_paths.py", "focal lengths between keyframes"),
    M("nerfvol/cameras/interpolate.py", "(quats[1:] * quats[:-1]).sum(axis=1) < 0", "(quats[1:] * quats[:-1]).sum(axis=1) < -2", "cameras/test_paths.py", "turns the longer way round"),
    M("nerfvol/rotations.py", "[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)]", "[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)]", "cameras/test_paths.py::test_quaternions", "a sign in a rotation"),
    M("nerfvol/sh.py", "values += [-_C1 * y, _C1 * z, -_C1 * x]", "values += [-_C1 * y, _C1 * z, _C1 * x]", "test_sh.py", "a sign of the first band"),
    M("nerfvol/measure/metrics.py", "_K1, _K2 = 0.01, 0.03", "_K1, _K2 = 0.01, 0.01", "measure/test_metrics.py", "the constant of SSIM's contrast"),
    M("nerfvol/measure/metrics.py", "_similarities(np.where(seen[..., None], a, b), b)", "_similarities(a, b)", "measure/test_metrics.py " + MASKS, "masked pixels in SSIM's windows"),
    M("nerfvol/measure/truth.py", "np.where(corner, place - low, 1 - (place - low))", "np.where(corner, 1 - (place - low), place - low)", "measure/test_truth.py", "trilinear weights the other way round"),
    M("nerfvol/measure/colour_fit.py", "w *= (t < SATURATED).all(1)", "w *= (t < 2).all(1)", "training/test_appearance.py", "saturated pixels in colour maps"),
    M("nerfvol/measure/colour_fit.py", "np.concatenate([np.diag(gain), np.zeros((3, 1))], axis=1)", "np.eye(3, 4)", "training/test_appearance.py", "maps that fall back to no gain"),
    # ---------------------------------------------------------------- octrees
    M("nerfvol/octree/codec.py", "np.cumsum(codes, out=codes, dtype=np.int32)", "codes[0] = codes[0]", "octree/test_io.py", "differences that are not summed"),
    M("nerfvol/octree/codec.py", "(TO_GREY[axis] / np.float32(parameters", "(TO_GREY[axis - 1] / np.float32(parameters", "octree/test_io.py", "axes of colour"),
    M("nerfvol/octree/merge.py", "error = np.abs(guess - truth).max(1)", "error = np.abs(guess - truth).mean(1)", "octree/test_merge.py", "mean instead of largest errors of merging"),
    M("nerfvol/octree/merge.py", "first = first[code[first + 7] == code[first] + 7]", "first = first[code[first + 6] == code[first] + 6]", "octree/test_merge.py", "families of seven"),
    M("nerfvol/octree/lod.py", "return total, np.minimum(opacity / nodes, OPAQUE)", "return total, np.minimum(opacity, OPAQUE)", "octree/test_lod.py", "corners that several nodes share"),
    M("nerfvol/training/octree_schedule.py", "for kept in (before, before[::2], before[:1]):", "for kept in (before,):", "training/test_octree_schedule.py", "a short run stays in its coarse stages"),
    M("nerfvol/training/octree_schedule.py", "    if is_unbounded:\n        return as_set\n", "", "training/test_octree_schedule.py", "haze between photographs is pruned once"),
    M("nerfvol/training/octree_schedule.py", "for prunes in (config.prunes, once):", "for prunes in (once,):", "training/test_octree_schedule.py", "a long run has another schedule than the one set"),
    M("nerfvol/training/octree_end.py", "* (1 + loss)", "* (1 - loss)", "training/test_octree_trainer.py", "a last pruning that must gain"),
    M("nerfvol/training/octree_step.py", "chosen.sparsity * min(1.0, progress / max(chosen.decay_from, 1e-9))", "chosen.sparsity", "training/test_octree_trainer.py", "haze forbidden from the first step"),
    M("nerfvol/training/tuning.py", "budget - after - begun", "budget - begun", "training/test_convert.py", "a conversion's budget without writing and scoring"),
    M("nerfvol/kernels/csrc/render.h", "towards[3] = {leaf.x + h - o[0],", "towards[3] = {leaf.x - o[0],", "kernels/test_view.py", "small cells are seen along the ray to one of their faces"),
    M("nerfvol/kernels/csrc/render.h", "small * small * dot3", "small * dot3", "kernels/test_view.py", "larger cells are shaded along one ray"),
    M("nerfvol/datasets/load.py", "cameras = [view.camera.scaled(downscale) for view in found.views]", "cameras = [view.camera for view in found.views]", "datasets/test_dataset.py", "cameras alone are those of whole pictures"),
    M("nerfvol/datasets/load.py", "    found.release()\n    cameras =", "    load_dataset(path, split, downscale)\n    cameras =", "datasets/test_dataset.py", "cameras alone decode all pictures"),
    M("nerfvol/training/convert.py", "looks = set(evenly(range(len(cameras)), LOOKS))", "looks = set(range(LOOKS))", "training/test_convert.py", "the first pictures tell surfaces"),
    M("nerfvol/training/convert.py", "solid = thickness(octree) >= EMPTY", "solid = thickness(octree) >= 100 * EMPTY", "training/test_convert.py", "what is thin is empty"),
    M("nerfvol/starts/leaves.py", "splats.means + splats.origin, np.asc", "splats.means, np.asc", "training/test_convert.py", "leaves know nothing of the splats' origin"),
    M("nerfvol/training/convert.py", "config.for_few_views(len(fitted), scene).octree", "config.octree", "training/test_convert.py", "fits to few pictures as to many"),
    M("nerfvol/cli/convert.py", "config = config.for_few_views(len(training), training.scene)", "pass", "cli/test_convert.py", "conversions trained on few pictures as on many"),
    M("nerfvol/splats/packed.py", "if chunks.count * CHUNK < file.count:", "if False:", "splats/test_other_writers.py", "packed Gaussians without their chunk"),
    M("nerfvol/splats/packed.py", "if number not in (9, 24, 45) or element.count", "if element.count", "splats/test_other_writers.py", "packed harmonics of any number"),
    M("nerfvol/splats/packed.py", 'newbyteorder("=") != np.dtype(kind):', 'newbyteorder("=") is None:', "splats/test_other_writers.py", "packed numbers of any type"),
    M("nerfvol/measure/sharpness.py", "if min(grey.shape) < 3:", "if False:", "measure/test_sharpness.py", "sharpness of a pixel"),
    M("data_synth/volumes.py", "                _checked(f\"{given}:{name}\", other.volume, other.voxel_size)", "                pass", "data_synth/test_vdb_volumes.py", "colours that are no numbers"),
    M("nerfvol/kernels/csrc/looks.cpp", "weight * basis[i] * missed", "basis[i] * missed", "starts/test_surfaces.py", "looks beside a surface count in full"),
    M("nerfvol/kernels/csrc/adjoint.h", "/ (kSparseKnee + w)", "/ kSparseKnee", "kernels/test_train.py", "sparsity that costs surfaces as much as haze"),
    M("nerfvol/training/octree_trainer.py", "            needed |= solid(self.octree)", "            pass", "training/test_octree_trainer.py", "few views judge what is solid"),
    M("nerfvol/training/octree_trainer.py", "if self.dataset.scene.is_unbounded:\n            return random_background", "if False:\n            return random_background", "training/test_octree_trainer.py", "one colour behind photographs"),
    # ---------------------------------------------------------------- splats and exports
    M("nerfvol/splats/ply.py", "columns(*names).reshape(len(sh), 3, len(names) // 3)", "columns(*names).reshape(len(sh), len(names) // 3, 3).transpose(0, 2, 1)", "splats/test_ply.py", "coefficients colour by colour"),
    M("nerfvol/splats/ply.py", '"default": "plain"}', '"default": "mip"}', "splats/test_ply.py", "footprints that a comment states"),
    M("nerfvol/splats/foreign.py", "np.maximum(values, np.float32(-LARGEST_LOG_SCALE)) if", "values if", "splats/test_ply.py", "scales of minus infinity"),
    M("nerfvol/training/splat_schedule.py", "x = math.log(min(max(seconds, _SECONDS[0]), _SECONDS[-1]))", "x = math.log(max(seconds, _SECONDS[0]))", "training/test_splat_schedule.py", "seconds beyond the table"),
    M("nerfvol/training/splat_schedule.py", "while longest / (2 * coarsest) >= COARSEST_SIDE", "while longest / coarsest >= COARSEST_SIDE", "training/test_splat_schedule.py", "the smallest photographs"),
    M("nerfvol/export/grid.py", 'put(268, "3f", *grid.first)', 'put(268, "3f", *grid.lo)', "export/test_volumes.py", "NIfTI half a voxel off"),
    M("nerfvol/export/grid.py", 'Origin="{triple(grid.first)}"', 'Origin="{triple(grid.lo)}"', "export/test_volumes.py", "VTK half a voxel off"),
    M("nerfvol/export/grid.py", 'else -np.expm1(-sigma * grid.voxel)', "else -np.expm1(-sigma)", "export/test_grid.py", "opacity of a voxel of side one"),
    M("nerfvol/export/colmap.py", "(camera.c2w[:3, :3] * (1, -1, -1)).T", "camera.c2w[:3, :3].T", "export/test_cameras.py", "COLMAP's axes"),
    M("nerfvol/export/colmap.py", '1 + lenses.index(camera.intrinsics)', "1", "export/test_cameras.py", "one lens for two cameras"),
    # ---------------------------------------------------------------- runs, files, settings, servers
    M("nerfvol/files/lock.py", "fcntl.LOCK_EX | fcntl.LOCK_NB", "fcntl.LOCK_SH | fcntl.LOCK_NB", FAULTS, "two writers in one folder"),
    M("nerfvol/files/atomic.py", 'made_by["machine"] == _machine() and not', "not", "files/test_atomic.py training cluster/test_frames.py", "leftovers of other machines go"),
    M("nerfvol/files/checkpoint.py", 'number if math.isfinite(number) else ["float", repr(number)]', "number", "files/test_checkpoint.py", "numbers that JSON lacks"),
    M("nerfvol/files/arrayfile.py", "key=lambda name: (-ordered[name].itemsize, -_row_bytes(ordered[name]), name)", "key=str", "files/test_checkpoint.py", "arrays off their alignment"),
    M("nerfvol/files/numpyfile.py", "if not isinstance(array, np.ndarray):", "if False:", "measure/test_truth.py", "members of archives that are no arrays"),
    M("nerfvol/config/parsers.py", '"m": 60.0', '"m": 1.0', "config/test_config.py", "minutes"),
    M("nerfvol/config/values.py", "or self.open and value == self.low", "", "config/test_config.py", "open intervals"),
    M("nerfvol/datasets/holdout.py", 'np.argsort(distance, kind="stable")[:', 'np.argsort(-distance, kind="stable")[:', "datasets/test_holdout.py", "the farthest views are the arc"),
    M("nerfvol/viewer/server.py", "if not hmac.compare_digest(given.encode(), server.token.encode()):", "if False:", "viewer/test_server.py", "no token needed"),
    M("nerfvol/viewer/server.py", '"" if self.command == "POST" else ', "", "viewer/test_server.py", "work started by an address alone"),
    M("nerfvol/poses/verdict.py", "(-len(group), group[0])", "(len(group), group[0])", "poses/test_verdict.py", "the smallest group first"),
    M("nerfvol/cluster/frames.py", "    for camera in film.cameras:\n        digest", "    for camera in ():\n        digest", "cluster/test_frames.py::test_pictures_of_another_film_are_not_taken_for_this_one", "pictures of another path are this one's"),
    # ---------------------------------------------------------------- data_synth, second values
    M("data_synth/path.py", "mis = float(count)\n    if v.material < 0:", "mis = 1.0\n    if v.material < 0:", PLAIN, "of two lights each counts half"),
    M("data_synth/path.py", "        mis /= q\n    if pdf > 0.0:\n        mis *= pdf / (pdf + count * pdf_other)", "        mis /= q\n    if pdf > 0.0:\n        mis *= pdf / (pdf + pdf_other)", PLAIN, "the heuristic of two lights"),
    M("data_synth/path.py", "mul(beta, mul(collide, sub((1.0, 1.0, 1.0), albedo)))", "mul(beta, collide)", PLAIN, "emission without absorption"),
    M("data_synth/path.py", "scale(count * pdf_last / (count * pdf_last + pdf) if pdf_last > 0.0 else 1.0, light)", "light", PLAIN, "the sky counts twice"),
    M("data_synth/lights.py", "1.0 - 2.0 * uniform(rng), 2.0 * math.pi * uniform(rng))\n        s =", "1.0 - uniform(rng), 2.0 * math.pi * uniform(rng))\n        s =", PLAIN, "no light from below the horizon"),
    M("data_synth/path.py", "SKY_PDF = 0.07957747154594767", "SKY_PDF = 0.15915494309189535", PLAIN, "paths take skies to be drawn twice as densely as they are"),
    M("data_synth/path.py", "                straight, pdf_last = False, pdf\n", "                straight = False\n            pdf_last = pdf\n", PLAIN, "the sky behind a null boundary counts twice"),
    M("data_synth/path.py", "alpha = 1.0 - mean(beta)", "alpha = 1.0 - largest(beta)", PLAIN, "alpha of coloured media"),
    M("data_synth/lights.py", "cosine = -dot(wi, normal) * pdf_area", "cosine = abs(dot(wi, normal)) * pdf_area", PLAIN, "a lamp lights its back"),
    M("data_synth/lights.py", "if facing < 0.0 or (facing > 0.0 and quads[k, 1] > 0.0):", "if facing != 0.0:", PLAIN, "a clear back is met"),
    M("data_synth/lights.py", "if dot(d, n) < 0.0 else (0.0, 0.0, 0.0)", "if dot(d, n) != 0.0 else (0.0, 0.0, 0.0)", PLAIN, "a lamp's back is bright"),
    M("data_synth/lights.py", "extent(ev)) < t < best:", "extent(ev)) < t < t_max:", PLAIN, "the last of two lamps is met"),
    M("data_synth/lights.py", "t = min(-8.0 * dz, 1.0)", "t = min(-4.0 * dz, 1.0)", PLAIN, "the edge of the ground"),
    M("data_synth/phase.py", "f + (1.0 - phase.mix) * hg(phase.g2, cosine)", "f + phase.mix * hg(phase.g2, cosine)", PLAIN, "the weight of the second lobe"),
    M("data_synth/phase.py", "phase.g1 if uniform(rng) < phase.mix else phase.g2", "phase.g1", PLAIN, "the second lobe is never drawn"),
    M("data_synth/materials.py", "return d, 0.5 * (parallel * parallel + across * across)", "return d, across * across", PLAIN, "light of one polarisation"),
    M("data_synth/materials.py", "if odd % 2.0 != 0.0:", "if odd % 2.0 == 1.0 and p[0] > 0.0:", PLAIN, "a checker's second colour"),
    M("data_synth/world.py", "number, best = int(rows[k, 13]), rows[k, 14]", "number = int(rows[k, 13])", PLAIN, "the later medium counts, whatever the priorities"),
    M("data_synth/dataset.py", "seed=3 * seed + k)", "seed=3 * seed)", "data_synth/test_dataset.py::test_held_out_cameras_are_not_on_the_training_spiral", "held-out cameras on the training spiral"),
    M("data_synth/views.py", "return (seed * 1_000_003 + view.number) & 0x7FFFFFFF", "return (seed * 1_000_003) & 0x7FFFFFFF", "data_synth/test_dataset.py::test_every_view_has_a_seed_of_its_own_whoever_renders_it", "one seed for all views"),
    M("data_synth/image.py", "np.where(x <= 0.0031308, 12.92 * x, 1.055", "np.where(x < 0, 12.92 * x, 1.055", "data_synth/test_dataset.py::test_dark_pixels_and_the_exposure_of_pictures", "dark pixels"),
    M("data_synth/image.py", "straight, 0.0) * exposure", "straight, 0.0)", "data_synth/test_dataset.py::test_dark_pixels_and_the_exposure_of_pictures", "the exposure of pictures"),
    M("data_synth/volumes.py", "reshape(shape[::-1]).transpose(2, 1, 0)", "reshape(shape)", "data_synth/test_vdb_volumes.py::test_numpy_and_raw", "the order of raw samples"),
    M("data_synth/medical.py", "values * slope + shift if", "values * slope if", "data_synth/test_medical.py", "the shift of scanners' values"),
    M("data_synth/portrait.py", "y = -(np.array([rows", "y = (np.array([rows", "data_synth/test_portrait.py", "framing upside down"),
    M("data_synth/blackbody.py", "/ xyz(white)[..., 1:2]", "/ xyz(white)[..., 0:1]", "data_synth/test_blackbody.py", "luminance of what glows"),
    M("data_synth/parts.py", "level[k] + level[k + 1] if k + 1 < len(level) else level[k]", "level[k] + level[k + 1] if k + 1 < len(level) else 0 * level[k]", "data_synth/test_parts.py::test_any_grouping_into_nodes_gives_the_sum_of_the_one_tree", "odd nodes of the tree of sums"),
    M("data_synth/scene_file.py", "if key.value in keys[:k]:", "if False:", "data_synth/test_scene_file.py", "keys a second time in scene files"),
    # ---------------------------------------------------------------- kernels, second values
    M("nerfvol/kernels/csrc/distil.cpp", "std::abs(between - own[p]) * share[p]", "std::abs(between - own[p])", "octree/test_merge.py", "colours of what is invisible keep leaves"),
    M("nerfvol/kernels/csrc/field_march.h", "high[axis] = float(most[axis] + 1) * 2", "high[axis] = float(most[axis] - 1) * 2", "kernels/test_field_march.py", "rays are cut to a box that ends inside of what is occupied"),
    M("nerfvol/kernels/csrc/distil.cpp", "for (int z = c[2] - 1; z <= c[2] + 1; ++z)", "for (int z = c[2] - 1; z <= c[2]; ++z)", "starts/test_field.py", "neighbours on one side"),
    M("nerfvol/kernels/csrc/neighbours.cpp", "if (across * across <= found.worst()) find", "if (across * across <= 0.5 * found.worst()) find", "splats/test_ply.py starts", "the nearest behind a split"),
    # ---------------------------------------------------------------- media under known suns
    M("nerfvol/medium/transport.py", "planes = planes.flip(0) if towards[axis] < 0 else planes", "planes = planes", TRANSPORT, "suns from below shine from above"),
    M("nerfvol/medium/transport.py", "per_plane = voxel[axis] / abs(towards[axis])", "per_plane = voxel[axis]", TRANSPORT, "slanted ways to the sun are as short as straight ones"),
    M("nerfvol/medium/transport.py", "segments = 0.5 * per_plane * (straight[:-1] + straight[1:])", "segments = per_plane * straight[1:]", TRANSPORT, "depths to the light of first order"),
    M("nerfvol/medium/transport.py", "through = torch.exp(thickness - torch.cumsum(thickness, 1))", "through = torch.exp(-torch.cumsum(thickness, 1))", TRANSPORT, "a step hides itself"),
    M("nerfvol/medium/transport.py", "arriving = torch.exp(-found[:, 4 + k])", "arriving = torch.exp(-found[:, 4 + k].detach())", TRANSPORT, "shadows teach nothing"),
    M("nerfvol/medium/transport.py", "arriving = torch.exp(-found[:, 4 + k])", "arriving = torch.exp(-found[:, 4])", TRANSPORT, "every sun has the first one's shadow"),
    M("nerfvol/medium/transport.py", "q = 1 + lobe.g**2 - 2 * lobe.g * cosine", "q = 1 + lobe.g**2 + 2 * lobe.g * cosine", TRANSPORT, "forward is backward"),
    M("nerfvol/medium/transport.py", "flip(-1), (0, 0, 0, len(points) % 2)", "flip(-1), (0, 0, 0, 0)", TRANSPORT, "odd numbers of points"),
    M("nerfvol/medium/model.py", "beams, lobes = self.lighting.of(camera.light)", "beams, lobes = self.lighting.of(None)", "medium/test_model.py", "every picture is lit by the first light"),
    M("nerfvol/medium/model.py", "self.sigma_t / np.float32(scale)", "self.sigma_t", "medium/test_model.py", "extinction in another unit"),
    M("nerfvol/medium/lighting.py", "beams.append(Beam((x / length, y / length, z / length), irradiance))", "beams.append(Beam((x, y, z), irradiance))", "medium/test_model.py", "directions of any length"),
    M("nerfvol/cameras/camera.py", '("light", self.light)):', '("light", None)):', "medium/test_model.py", "smaller pictures forget their light"),
    M("nerfvol/datasets/transforms.py", "light = light if isinstance(light, str) and light else None", "light = None", FITTING, "frames do not say their light"),
    M("nerfvol/training/medium_trainer.py", "cut = (truth[:, :3] >= SATURATED) & (colour > 1)", "cut = colour > 1", FITTING, "too bright is never wrong"),
    M("nerfvol/training/medium_trainer.py", "depth = softplus(self.density) * before / (max(shape) - 1)", "depth = softplus(self.density)", FITTING, "a finer grid is thicker"),
    M("nerfvol/training/medium_trainer.py", "manual_seed(self.seed * 0x9E3779B1 + self.steps_done)", "manual_seed(self.seed * 0x9E3779B1)", FITTING, "every step has the same rays"),
    M("nerfvol/training/medium_trainer.py", "manual_seed(self.seed * 0x9E3779B1 + self.steps_done)", "manual_seed(self.steps_done)", FITTING, "the seed is not looked at"),
    M("nerfvol/training/medium_trainer.py", 'if "exp_avg_0" in state:', "if False:", FITTING, "a resumed fit has no moments"),
    M("nerfvol/training/medium_trainer.py", "self.lighting.of(light), self.lighting.phase, step, jitter)", "self.lighting.of(None), self.lighting.phase, step, jitter)", FITTING, "all pictures train under one light"),
    M("nerfvol/measure/truth.py", "_agreement(\n        \"opacity\", -np.expm1(-found), -np.expm1(-true)\n    )", "_agreement(\n        \"opacity\", -np.expm1(-true), -np.expm1(-true)\n    )", "training/test_medium_trainer.py measure/test_truth.py", "the truth's opacity against itself"),
    # ---------------------------------------------------------------- kernels
    M("nerfvol/kernels/csrc/adjoint.h", "g[k] = 2 * weight * residual;", "g[k] = 2 * residual;", "kernels/test_train.py", "gradients without the rays' weights"),
    M("nerfvol/kernels/csrc/train.h", "w = std::max(w, leaf.max_weight);", "w = leaf.max_weight;", "kernels/test_train.py", "the last weight of a leaf is its largest"),
    # ---------------------------------------------------------------- photographs
    M("nerfvol/files/unchanged.py", "kept(path, state.st_mtime_ns, state.st_size)", "kept(path, 0, 0)", SETS, "changed pictures are judged as they were"),
    M("nerfvol/files/unchanged.py", "kept(path, state.st_mtime_ns, state.st_size)", "kept(path, state.st_mtime_ns, 0)", SETS, "pictures of another size are judged as they were"),
    M("nerfvol/files/unchanged.py", "lru_cache(maxsize=most)", "lru_cache(maxsize=0)", SETS, "each split decodes what it is judged by"),
    M("nerfvol/datasets/photographs.py", "fits = self._most is None or self._bytes + more <= self._most", "fits = True", "datasets/test_photographs.py", "photographs are kept without bound"),
    M("nerfvol/datasets/photographs.py", "self._bytes -= view.image.nbytes", "pass", "datasets/test_photographs.py", "what is dropped counts on"),
    M("nerfvol/training/memory/splats.py", "return dataset.nbytes + kept, kept / wanted", "return kept, kept / wanted", "training/test_memory.py", "the images themselves are not in the estimate"),
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
    M("nerfvol/training/begin.py", "left >= MEASURED_FROM * len(dataset)", "left >= 0", "training/test_appearance.py", "seconds that a run does not have measure exposures"),
    M("nerfvol/training/octree_start.py", "level=level_in_time(finest, run.seconds_left())", "level=finest", "training/test_budget.py::test_a_short_run_distils_coarser", "a run without the time distils at the finest level"),
    M("nerfvol/config/training.py", "if budget <= until else", "if budget < until else", "training/test_octree_start.py", "the budget at which octrees begin as splats no more"),
    M("nerfvol/config/training.py", "budget is not None and not is_simulated and", "budget is not None and", "training/test_octree_start.py", "media begin as surfaces"),
    M("nerfvol/training/convert.py", "finest_level(scene, cameras) + scene.is_unbounded, most", "finest_level(scene, cameras), most", "training/test_photographs_from_splats.py", "photographs' surfaces a level too coarse"),
    M("nerfvol/training/memory/octree.py", "wanted = leaves if leaves and not grows else max(wanted, leaves)", "pass", "training/test_photographs_from_splats.py", "leaves that splats become are not announced"),
    M("nerfvol/training/octree_start.py", "        asked.go_on_from(appearance)", "        pass", "training/test_photographs_from_splats.py", "colour maps of splats are lost"),
    M("nerfvol/training/octree_start.py", "        run.without_first()\n        run.say(f\"start: low density, for there", "        run.say(f\"start: low density, for there", "training/test_photographs_from_splats.py", "low density with the settings of surfaces"),
    M("nerfvol/training/finishing.py", "sure = writing + data.reading + table", "sure = table", "training/test_budget.py", "writing and reading are not kept of a budget"),
    M("nerfvol/training/finishing.py", "        table += data.loading", "        pass", "training/test_budget.py", "released photographs are read in no time"),
    M("nerfvol/training/session.py", "            begun -= {first for first, became in BECAME.items() if became not in self.results}", "            pass", "training/test_octree_start.py", "splats that became no octree settle a resumed run"),
    M("nerfvol/config/training.py", "        if begun:\n", "        if False:\n", "training/test_octree_start.py", "another budget changes a resumed run's start"),
    M("nerfvol/training/begin.py", '"splats" and run.phase in ("start", "splats") else', '"splats" else', "training/test_resume.py", "an octree's start is trained again on resuming"),
    M("nerfvol/training/begin.py", "run.phase != begun:", "True:", "training/test_appearance.py", "resumed runs measure exposures again"),
    M("nerfvol/cameras/motions.py", "w - np.cross(pivot, v)", "w + np.cross(pivot, v)", "cameras/test_motions.py", "the gradient of a turn about the pivot"),
    M("nerfvol/cameras/motions.py", "+ pivot - rotation_of(step[:3]) @ pivot", "", "cameras/test_motions.py", "steps about the camera's centre"),
    M("nerfvol/cameras/motions.py", "scale * self.poses[:, :3, 3] @ rotation.T + shift", "self.poses[:, :3, 3] @ rotation.T + shift", "cameras/test_motions.py", "cameras come back without the scale"),
    M("nerfvol/training/splat_trainer.py", "view_of(self._placed(index, view.camera), self.state.origin, near)", "view_of(view.camera, self.state.origin, near)", "training/test_refinement.py", "steps see the given poses"),
    M("nerfvol/training/splat_trainer.py", "self.motions.load_state_dict(state[\"motions\"])", "pass", "training/test_refinement.py", "resumed runs begin with the given poses"),
    M("nerfvol/training/splat_trainer.py", "splats = similar(splats, scale, rotation, shift)", "pass", "training/test_refinement.py", "the scene does not come back with its cameras"),
    M("nerfvol/kernels/csrc/path_trace.h", "beta *= 1.0f / q;", "(void)q;", CORE, "roulette without its weight"),
    M("nerfvol/kernels/csrc/path_trace.h", "return u * kept < rho - rho * lost;", "return u < rho - rho * lost;", CORE, "grey null collisions at the wrong rate"),
    M("nerfvol/kernels/csrc/path_trace.h", "(both / n) * fly;", "fly;", CORE, "coloured null collisions without their weight"),
    M("nerfvol/kernels/csrc/path_trace.h", "if (!kGrey) colour *= kShadowRoulette / T;", "", CORE, "shadow rays that go on by chance weigh too little"),
    M("nerfvol/kernels/csrc/path_trace.h", "weight *= kQuarter / (kQuarter + float(count) * f);", "weight *= kQuarter / (kQuarter + f);", CORE, "the balance heuristic forgets how many lights there are"),
    M("nerfvol/kernels/csrc/path_trace.h", "n / (n + kQuarter)", "n / (n + 2.0f * kQuarter)", CORE, "paths take skies to be drawn twice as densely as they are"),
    M("nerfvol/kernels/csrc/path_trace.h", "alpha = 1.0 - double(mean3(beta));", "alpha = 1.0 - double(beta[0]);", CORE, "alpha of red alone"),
    M("nerfvol/kernels/csrc/path_light.h", "cosine = root - 1.0f / root;", "cosine = 2.0f * u - 1.0f;", CORE, "Rayleigh scattering in all directions alike"),
    M("nerfvol/kernels/csrc/path_medium.h", "const float low = c[0] + fy", "const float low = c[0] + fx", CORE, "an axis of a cell's lower half"),
    M("nerfvol/kernels/csrc/path_random.h", "mix64(seed + 0xD1B54A32D192ED03u)", "mix64(0xD1B54A32D192ED03u)", CORE, "the seed of a picture"),
    # ---------------------------------------------------------------- data_synth
    M("data_synth/phase.py", "q = 1.0 + g * g - 2.0 * g * cosine", "q = 1.0 + g * g - g * cosine", "data_synth/test_phase.py", "Henyey-Greenstein's denominator"),
    M("data_synth/rough.py", "q = h[2] * h[2] * (a2 - 1.0) + 1.0", "q = h[2] * (a2 - 1.0) + 1.0", ROUGH, "GGX's denominator"),
    M("data_synth/rough.py", "value = (1.0 - reflectance) * seen * -ci / (q * q)", "value = (1.0 - reflectance) * seen * -ci * eta * eta / (q * q)", ROUGH, "the side whose index counts"),
    M("data_synth/rough.py", "return value / (1.0 + lo + li), value / (1.0 + lo), through", "return value / (1.0 + lo), value / (1.0 + lo), through", ROUGH, "nothing is hidden from the light"),
    M("data_synth/rough.py", "b = (1.0 - k) * math.sqrt(max(1.0 - a * a, 0.0)) + k * b", "b = k * b", ROUGH, "facets that face away are drawn"),
    M("data_synth/channels.py", "(3 * seed + c) % 2**63", "(3 * seed) % 2**63", "data_synth/test_rgb_grids.py", "one stream for all channels"),
    M("data_synth/channels.py", "return [replace(scene, medium=one(scene.medium, c), media", "return [replace(scene, medium=one(scene.medium, 2 - c), media", "data_synth/test_rgb_grids.py", "red and blue change places"),
    M("data_synth/channels.py", "out = sum(found[1:], found[0].copy()) / 3.0", "out = found[0].copy()", "data_synth/test_rgb_grids.py", "alpha is the red one's"),
    # ---------------------------------------------------------------- data_synth: flakes, layers, many media, scans, grids, clouds
    M("data_synth/spongecake.py", "return -math.expm1(-tau * x) / x", "return -math.expm1(-tau * x)", FLAKES, "the paper's G without its denominator"),
    M("data_synth/spongecake.py", "        return tau * math.exp(-0.5 * tau * (lo + li))", "        return math.exp(-0.5 * tau * (lo + li))", FLAKES, "G where the slants meet"),
    M("data_synth/spongecake.py", "            / (4.0 * cosines)\n", "            / (4.0 * abs(wo[2]))\n", FLAKES, "one of the two cosines"),
    M("data_synth/spongecake.py", "cosine = min(math.sqrt(dot(h, h)) * 0.5, 1.0)", "cosine = min(abs(wo[2]), 1.0)", FLAKES, "Fresnel by the layer's normal"),
    M("data_synth/spongecake.py", "fresnel.schlick(cosine, albedo[1])", "fresnel.schlick(cosine, albedo[0])", FLAKES, "Schlick's green is red"),
    M("data_synth/spongecake.py", "r[k, 13], r[k, 16])", "r[k, 13], r[k, 15])", FLAKES, "a metal's blue with green's k"),
    M("data_synth/spongecake.py", "attenuation(layers, k + 1, last, wi))", "attenuation(layers, k, last, wi))", FLAKES, "a layer counts on the way out of it too"),
    M("data_synth/spongecake.py", "        reach *= through\n", "", FLAKES, "layers do not hide those below in the pdf"),
    M("data_synth/spongecake.py", "total += reach * (1.0 - through) * f", "total += reach * f", FLAKES, "the pdf without the chance of a flake"),
    M("data_synth/spongecake.py", "rows[k, 17] = len(tables)", "rows[k, 17] = 1", FLAKES, "all layers have the first table"),
    M("data_synth/spongecake.py", "/ max(abs(w[2]), 1e-9)", "/ max(w[2], 1e-9)", FLAKES, "slants from below"),
    M("data_synth/spongecake.py", "total += layers.rows[k, 0] * slant(flakes(layers, k), w)", "total += slant(flakes(layers, k), w)", FLAKES, "sheets of any thickness are as opaque"),
    M("data_synth/flake_tables.py", "* (2 * np.pi / columns) / 4\n", "* (2 * np.pi / columns) / 2\n", FLAKES, "twice the projected area"),
    M("data_synth/flake_tables.py", "+ np.asarray(D(-m.reshape(-1, 3)), float))", "+ np.asarray(D(m.reshape(-1, 3)), float))", FLAKES, "D of one side alone"),
    M("data_synth/flake_tables.py", "table_at(table, k, m) * abs(seen):", "table_at(table, k, m):", FLAKES, "normals that nobody sees"),
    M("data_synth/flake_tables.py", "return m if seen > 0.0 else neg(m)", "return m", FLAKES, "normals that face away"),
    M("data_synth/microflakes.py", "return 2.0 * F / (1.0 + F)", "return F", FLAKES, "a pane of one face"),
    M("data_synth/microflakes.py", "    ways += 1.0 if 2.0 - ui - uo < a else 0.0\n", "", FLAKES, "the blur is not folded at grazing"),
    M("data_synth/microflakes.py", "ui = 2.0 - ui if ui > 1.0 else ui", "ui = min(ui, 1.0)", FLAKES, "samples are not folded at grazing"),
    M("data_synth/microflakes.py", "(1.0 - c) / (1.0 + c) * math.tan", "(1.0 + c) / (1.0 - c) * math.tan", FLAKES, "the wrapped Cauchy the other way round"),
    M("data_synth/microflakes.py", "p = abs(ci) * blur(", "p = blur(", FLAKES, "the Jacobian of the projected disc"),
    M("data_synth/microflakes.py", "-dot(xo, xi) / product", "dot(xo, xi) / product", FLAKES, "glossy flakes throw light back"),
    M("data_synth/flake_tables.py", "(np.pi * a2 * c2 * c2)", "(np.pi * a2 * c2)", FLAKES, "Beckmann's cosine"),
    M("data_synth/microflakes.py", "p *= R if ci > 0.0 else 1.0 - R", "p *= 1.0 - R if ci > 0.0 else R", FLAKES, "panes mirror what they let through"),
    M("data_synth/flake_tables.py", "values[-1] = 0.5 * (values[-1] + np.roll(values[-1], shape[1] // 2))", "pass", FLAKES, "opposite normals on the equator differ"),
    M("data_synth/microflakes.py", "table_at(n.table, n.table.kinds + n.row, w)", "table_at(n.table, n.table.kinds, w)", FLAKES, "all kinds have the first one's area"),
    M("data_synth/flake_tables.py", "first = 2 * table.kinds * (rows + 1) * columns + k * cells", "first = 2 * table.kinds * (rows + 1) * columns", FLAKES, "normals of the first kind"),
    M("data_synth/flake_tables.py", "v = math.acos(min(s * w[2], 1.0))", "v = (1.0 - min(s * w[2], 1.0)) * (0.5 * math.pi)", FLAKES, "tables read by the cosine"),
    M("data_synth/fresnel.py", "t0 = eta * eta - k * k - s2", "t0 = eta * eta + k * k - s2", FLAKES, "a metal's sign"),
    M("data_synth/fresnel.py", "c2 * both + s2 * s2 - 2.0 * a * cosine * s2)", "c2 * both + s2 * s2 + 2.0 * a * cosine * s2)", FLAKES, "both polarisations alike"),
    M("data_synth/fresnel.py", "(1.0 - cosine) ** 5", "(1.0 - cosine) ** 4", FLAKES, "Schlick's power"),
    M("data_synth/pool.py", "m.base, m.falloff, m.step]", "m.base, m.step, m.falloff]", TOGETHER, "step and fall-off change places"),
    M("data_synth/pool.py", "media.Le[a[6] : b[6]]", "media.albedo[a[5] : b[5]]", TOGETHER, "further media glow with their albedo"),
    M("data_synth/pool.py", "media.brick_max[a[3] : b[3]]", "media.brick_min[a[4] : b[4]]", TOGETHER, "further media's majorants are their least"),
    M("data_synth/pool.py", "m.phase.g1, m.phase.g2, m.phase.mix", "m.phase.g2, m.phase.g1, m.phase.mix", TOGETHER, "lobes of further media change places"),
    M("data_synth/pool.py", "Detail(media.detail[a[10] : b[10]], int(n[41]), int(n[42])", "Detail(media.detail[a[10] : b[10]], int(n[42]), int(n[41])", TOGETHER, "sizes of noise and curl change places"),
    M("data_synth/pool.py", "m.phase.roughness, m.phase.ior", "m.phase.ior, m.phase.roughness", TOGETHER, "roughness and index of further media"),
    M("data_synth/pool.py", "m.max_density, *m.sigma_t", "m.max_density, *m.sigma_t[::-1]", TOGETHER, "colours of further media"),
    M("data_synth/raycast.py", "area = whole[i] + rest * (points[i, 0] + 0.5 * slope * rest)", "area = whole[i] + rest * (points[i, 0] + slope * rest)", SCANS, "the integral of a slope"),
    M("data_synth/raycast.py", "colour = np.where(seen, colour / np.where(seen, total[..., None], 1.0), plain)", "colour = np.where(seen, colour, plain)", SCANS, "colours of a step are weighted twice"),
    M("data_synth/raycast.py", "state.far + weight * 0.5 * (start + end)", "state.far + 0.5 * (start + end)", SCANS, "distance without weights"),
    M("data_synth/raycast.py", "bilinear(pre[i, j, c], pre[i, j + 1, c], pre[i + 1, j, c],", "bilinear(pre[i, j, c], pre[i + 1, j, c], pre[i, j + 1, c],", SCANS, "front and back of the table"),
    M("data_synth/raycast.py", "front = state.v if abs(state.t - start) < 1e-9 * (1.0 + start) else value(m, along(cells, start))", "front = state.v", SCANS, "the value before a gap is that after it"),
    M("data_synth/raycast.py", "table[a : b + 1, 0].max()", "table[a:b, 0].max(initial=0)", SCANS, "bounds of bricks miss their largest value"),
    M("data_synth/raycast.py", "gradient / min(c.values.cell)", "gradient", SCANS, "gradients per u, not per voxel"),
    M("data_synth/raycast.py", "value(m, (x, y - 1.0, z))) / (2.0 * m.cell[1])", "value(m, (x, y - 1.0, z))) / (2.0 * m.cell[0])", SCANS, "gradients of cells that are no cubes"),
    M("data_synth/raycast.py", "    if part < 1.0 - 1e-9:", "    if False:", SCANS, "parts of a step count as whole ones"),
    M("data_synth/raycast.py", "start, end = max(t - 0.5 * width, t0), min(t + 0.5 * width, t1)", "start, end = t - 0.5 * width, t + 0.5 * width", SCANS, "steps stick out of the box"),
    M("data_synth/raycast.py", "np.concatenate([tau, -np.expm1(-tau), own[..., 1:]]", "np.concatenate([tau, tau, own[..., 1:]]", SCANS, "opacity to first order"),
    M("data_synth/raycast.py", "of_step(table, front, back, 3), of_step(table, front, back, 4))", "of_step(table, front, back, 3), of_step(table, front, back, 3))", SCANS, "blue is green"),
    M("data_synth/raycast.py", "-T * np.expm1(-here[0] * thickness / inside)", "-T * np.expm1(-here[0] * thickness)", SCANS, "each part of a step is as thick as the step"),
    M("data_synth/raycast.py", "light = AMBIENT + DIFFUSE * cosine", "light = AMBIENT + DIFFUSE * cosine * cosine", SCANS, "the square of Lambert's cosine"),
    M("data_synth/cameras.py", "j + (s // side + 0.5) / side)", "j + (s % side + 0.5) / side)", SCANS, "rays of a pixel on its diagonal"),
    M("data_synth/cameras.py", "alpha * share, far * share", "alpha * share, far", SCANS, "distances of several rays a pixel"),
    M("data_synth/traverse.py", "k = max(carry, math.floor(a / m.step))", "k = math.floor(a / m.step)", SCANS, "steps across two bricks count twice"),
    M("data_synth/traverse.py", "k = max(carry, math.floor(a / m.step))", "k = max(carry, math.ceil(a / m.step))", SCANS, "the part of a step before a brick is lost"),
    M("data_synth/transfer.py", "rest = samples[samples >= edges[fullest + 1]]", "rest = samples", SCANS, "air counts among the values"),
    M("data_synth/transfer.py", '[point["value"], point["opacity"], *colour]', '[point["opacity"], point["value"], *colour]', SCANS, "value and opacity change places"),
    M("data_synth/transfer.py", "(np.diff(points[:, 0]) <= 0).any()", "(np.diff(points[:, 0]) < 0).any()", SCANS, "one value twice"),
    M("data_synth/transfer.py", 'line.split("#")[0]', "line", SCANS, "comments"),
    M("data_synth/transfer.py", "if points[:, 1:].min() < 0 or points[:, 1:].max() > 1:", "if points[:, 1:].min() < 0:", SCANS, "opacities above 1"),
    M("data_synth/transfer.py", "if path.stat().st_size > LARGEST:", "if False:", SCANS, "transfer functions without end"),
    M("data_synth/gather.py", "return samples and grey and distant", "return samples and distant", TOGETHER, "coloured media are gathered by their red"),
    M("data_synth/gather.py", "return samples and grey and distant", "return samples and grey", TOGETHER, "lamps are gathered as if they were far away"),
    M("data_synth/gather.py", "m.phase.kind < phases.SGGX_SPECULAR and m.columns.g < 0", "m.columns.g < 0", TOGETHER, "microflakes are gathered"),
    M("data_synth/gather.py", "m.phase.kind < phases.SGGX_SPECULAR and m.columns.g < 0", "m.phase.kind < phases.SGGX_SPECULAR", TOGETHER, "a grid of g is gathered without it"),
    M("data_synth/gather.py", "m.kind == GRID and m.detail.octaves == 0 and", "m.kind == GRID and", TOGETHER, "detail is gathered without it"),
    M("data_synth/gather.py", "and one_phase and not has_boundaries(w)", "and one_phase", TOGETHER, "media in boundaries are gathered as if they filled their box"),
    M("data_synth/gather.py", "m.detail.octaves == 0 and not is_large(m)", "m.detail.octaves == 0", TOGETHER, "large media are gathered densely"),
    M("data_synth/gather.py", "return bool(np.any(eye < np.array(m.lo) - near) or", "return bool(np.all(eye < np.array(m.lo) - near) or", "data_synth/test_gather.py", "eyes beside the medium count as in it"),
    M("data_synth/compiled.py", "    if m.detail.octaves > 0:\n", "    if False:\n", TOGETHER, "the core draws clouds without their detail"),
    M("data_synth/compiled.py", "    if m.columns.width:\n", "    if False:\n", TOGETHER, "the core draws grids of colour without them"),
    M("data_synth/compiled.py", "    if m.kind == FUNCTION:\n", "    if False:\n", TOGETHER, "the core draws density functions"),
    M("data_synth/compiled.py", "camera.fx, camera.fy, camera.cx, camera.cy", "camera.fx, camera.fy, camera.cy, camera.cx", CORE, "centres of pictures that are no squares"),
    M("data_synth/fields.py", "(r, mixed(x, n, column + 1, where), mixed(x, n, column + 2, where))", "(r, mixed(x, n, column + 2, where), mixed(x, n, column + 1, where))", FIELDS, "green and blue change places"),
    M("data_synth/fields.py", "eigvalsh(matrices(part.astype(float)))[..., -1]", "eigvalsh(matrices(part.astype(float)))[..., 0]", FIELDS, "the majorant of flakes is their least area"),
    M("data_synth/fields.py", "mixed(x, n, c + 3, where), mixed(x, n, c + 4, where)", "mixed(x, n, c + 4, where), mixed(x, n, c + 3, where)", FIELDS, "xy and xz of S change places"),
    M("data_synth/fields.py", "        s[..., :3] += ROUNDING * s[..., :3].sum(axis=-1, keepdims=True)  # rounding takes away half of that at most\n", "", FIELDS, "rounded matrices of very flat flakes"),
    M("data_synth/fields.py", "return (m.fields[a], m.fields[a + step], m.fields[a + 2 * step])", "return (m.fields[a], m.fields[a + step], m.fields[a + step])", FIELDS, "gathered blue is green"),
    M("data_synth/fields.py", "area = float(np.sqrt(max(_largest_area(part) for part in parts)))", "area = float(max(_largest_area(part) for part in parts))", FIELDS, "the square of the flakes' area"),
    M("data_synth/lookups.py", "x / m.cells[0], y / m.cells[1], z / m.cells[2])", "x / m.cells[0], y / m.cells[0], z / m.cells[0])", CLOUDS, "detail of boxes that are no cubes"),
    M("data_synth/lookups.py", "rho *= phases.projected_area(phase_at(m, p), attribute(m, p), d)", "rho *= phases.projected_area(phase_at(m, p), 0.0, d)", FLAKES, "flakes of the first kind everywhere"),
    M("data_synth/lookups.py", "return phases.with_S(m.phase, matrix(m, cell_at(m, p)))", "return m.phase", FIELDS, "grids of S are not read"),
    M("data_synth/weather.py", "return bilinear(*corners, u - i, v - j)", "return bilinear(*corners, v - j, u - i)", CLOUDS, "x and y of a weather map"),
    M("data_synth/weather.py", "pixels[::-1].transpose(1, 0, 2)", "pixels.transpose(1, 0, 2)", CLOUDS, "north of a weather map is down"),
    M("data_synth/weather.py", "(2.0 - 2.0 * kind) * height_gradient(CUMULUS, h)", "2.0 * kind * height_gradient(CUMULUS, h)", CLOUDS, "types between heaps and towers"),
    M("data_synth/weather.py", "rain[i, j, k] = wet * remap(z, 0.15, 0.75, 1.0, 0.0)", "rain[i, j, k] = wet", CLOUDS, "it rains above the clouds"),
    M("data_synth/weather.py", "int((1 - coverage) * fields.size)", "int(coverage * fields.size)", CLOUDS, "a map covers what was to be clear"),
    M("data_synth/detail.py", "return n * (1.0 - upward) + (1.0 - n) * upward", "return n", CLOUDS, "billows upside down"),
    M("data_synth/detail.py", "finer, weight = FINER * finer, WEAKER * weight", "finer, weight = FINER * finer, weight", CLOUDS, "octaves of one weight"),
    M("data_synth/detail.py", "sy = y + push * pushed(curl, CURL_TILES * x, CURL_TILES * y, 1)", "sy = y + push * pushed(curl, CURL_TILES * x, CURL_TILES * y, 0)", CLOUDS, "curl noise along the diagonal"),
    M("data_synth/detail.py", "push = d.n * d.n * d.n, CURL_SHIFT * (1.0 - z)", "push = d.n * d.n * d.n, CURL_SHIFT", CLOUDS, "curl noise at the top"),
    M("data_synth/detail.py", "return most(d, np.maximum(shape - d.erosion, 0.0) / (1.0 - d.erosion))", "return most(d, shape)", CLOUDS, "the lower bound is not eroded"),
    M("data_synth/detail.py", "n, upward = total / weights,", "n, upward = total,", CLOUDS, "weights of octaves add to more than 1"),
    M("data_synth/detail.py", "return min(d.contrast * remap(shape, d.erosion * noise_at(d, x, y, z), 1.0, 0.0, 1.0), 1.0)", "return min(remap(d.contrast * shape, d.erosion * noise_at(d, x, y, z), 1.0, 0.0, 1.0), 1.0)", CLOUDS, "the threshold comes before the noise"),
    M("data_synth/detail.py", "return np.minimum(d.contrast * shape, 1.0)", "return shape", CLOUDS, "majorants know nothing of contrast"),
    M("data_synth/scenes/landscape.py", "RIM = 1.2 ", "RIM = 0.05 ", CARVED, "clouds too steep for their detail"),
    M("data_synth/transfer.py", "    except InputError:\n        raise\n", "", SCANS, "one sentence inside another"),
    M("data_synth/scenes/volumes.py", "coverage, scale, erosion, seed)", "coverage, 1.6, erosion, seed)", STRATUS, "every layer has the same tiles"),
    M("data_synth/scenes/volumes.py", "coverage, scale, erosion, seed)", "coverage, scale, 0.35, seed)", STRATUS, "every layer is as worn"),
    M("data_synth/linking.py", "return list(reversed(left))", "return list(left)", "data_synth/test_jit.py", "code is linked before what asks for it"),
    M("data_synth/linking.py", "_link_in_all(whole, self)", "pass", "data_synth/test_jit.py", "inner functions bring nothing they call to other code"),
    M("data_synth/nanovdb.py", "if self.left < 0:", "if False:", "data_synth/test_nanovdb.py", "places share nodes"),
    M("tools/recovered.py", "(weight * np.abs(found - truth)).sum() / total", "np.abs(found - truth).sum() / total", RECOVERED, "errors without their weights"),
    M("tools/recovered.py", "{(weight * found).sum() / total", "{found.sum() / total", RECOVERED, "sums without their weights"),
    M("tools/recovered.py", "compare(density, truth, seen(octree, points, eyes))", "compare(density, truth)", RECOVERED, "what no camera sees counts as seen"),
    M("tools/recovered.py", "o = np.repeat(points, len(eyes), axis=0)", "o = np.tile(points, (len(eyes), 1))", RECOVERED, "points and cameras in another order"),
    M("tools/recovered.py", "lookups.density(m, (x, y, z))", "lookups.density(m, (z, y, x))", RECOVERED, "x and z of the truth change places"),
    M("tools/recovered.py", "m.sigma_t[1] * lookups.density", "lookups.density", RECOVERED, "density is taken for extinction"),
    M("tools/recovered.py", "np.mean([sigma(*p) for p in along]) * length", "np.mean([sigma(*p) for p in along])", RECOVERED, "chords of one length"),
    M("tools/recovered.py", "distance(x, y, z) > MARGIN", "distance(x, y, z) > 0.0", RECOVERED, "walls of the showcase count"),
    M("tools/recovered.py", "for sign in (1, -1))]", "for sign in (1,))]", RECOVERED, "solids keep their distance on one side"),
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
    if shutil.which("ccache"):  # what a bug does not touch is not compiled again
        generator.append("-DCMAKE_CXX_COMPILER_LAUNCHER=ccache")
        os.environ["CCACHE_BASEDIR"] = str(copy)
    options = ["-DSKBUILD_PROJECT_VERSION=mutant", f"-DPython_EXECUTABLE={sys.executable}"]
    quiet = {"check": True, "stdout": subprocess.DEVNULL}
    subprocess.run(["cmake", "-S", copy / "nerfvol/kernels/csrc", "-B", build, *generator, *options], **quiet)  # pyright: ignore[reportCallIssue, reportArgumentType]
    subprocess.run(["cmake", "--build", build, "--parallel"], **quiet)  # pyright: ignore[reportCallIssue, reportArgumentType]
    return build


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
