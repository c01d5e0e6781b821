"""A video as a phone takes it, with the truth of where it was: to measure `nerfvol capture` with.

    python tools/phone_video.py make walk.mp4 [--seconds 60] [--size 1920x1080] [--rate 30] [--rendered 10]
    nerfvol capture walk.mp4 --out run
    python tools/phone_video.py check walk.json run/scene

A room of coloured tiles with a table, drawn by this package's splats, along a walk around the table: steps, a trembling
hand, rows read one after the other (20 ms), exposed for 10 ms, noise, exposure that drifts by 10 %. ``--rendered`` frames a
second are drawn, the video repeats them up to ``--rate``. ``check`` aligns the cameras found with the walk by a similarity
and prints their errors in per cent of the length of the path.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from nerfvol.cameras.camera import Camera, Intrinsics, look_at
from nerfvol.datasets.load import load_dataset
from nerfvol.rotations import rotation_of, turning_z_to
from nerfvol.splats.splats import Splats
from nerfvol.views import SplatModel

HALF = np.array([2.0, 1.5, 1.2])
TABLE = np.array([[-0.4, -0.35, -1.2], [0.4, 0.35, -0.5]])
TILE, SPACING = 0.08, 0.03
READOUT, EXPOSURE, PARTS = 0.02, 0.01, 4
NOISE, DRIFT = 3.0, 0.1
Y0 = 0.28209479177387814


def faces(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) on the faces of a box and their axes (n, 3)."""
    places, normals = [], []
    for axis in range(3):
        a, b = (k for k in range(3) if k != axis)
        u, v = np.meshgrid(*(np.arange(low[k] + SPACING / 2, high[k], SPACING) for k in (a, b)), indexing="ij")
        for side in (low[axis], high[axis]):
            points = np.empty((u.size, 3))
            points[:, a], points[:, b], points[:, axis] = u.ravel(), v.ravel(), side
            places.append(points)
            normals.append(np.tile(np.eye(3)[axis], (u.size, 1)))
    return np.concatenate(places), np.concatenate(normals)


def room() -> SplatModel:
    """Walls and a table as discs, their colours those of tiles, no two tiles alike."""
    parts = [faces(-HALF, HALF), faces(*TABLE)]
    places, normals = (np.concatenate([part[k] for part in parts]) for k in (0, 1))
    cell = np.floor((places - 1e-3 * places) / TILE).astype(np.int64)
    _, which = np.unique(cell, axis=0, return_inverse=True)
    colours = np.random.default_rng(0).uniform(0.08, 0.8, (which.max() + 1, 3))[which.ravel()]
    scales = np.tile([0.55 * SPACING, 0.55 * SPACING, 1e-3], (len(places), 1))
    sh = ((colours - 0.5) / Y0)[:, :, None]
    logits, quats = np.full(len(places), 4.0), turning_z_to(normals)
    places, scales, quats, logits, sh = (part.astype(np.float32) for part in (places, scales, quats, logits, sh))
    splats = Splats(places, np.log(scales), quats, logits, sh, np.zeros(3), "mip")
    return SplatModel(splats, {"near": 0.05})


def hand(seconds: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) and viewing directions (n, 3) of the walk at these times."""
    t = np.asarray(seconds, np.float64)
    angle = 2 * np.pi * 0.85 * t / duration
    eyes = np.stack([1.5 * np.cos(angle), 1.05 * np.sin(angle), 0.2 + 0.15 * np.sin(3 * angle)], 1)
    eyes[:, 2] += 0.012 * np.sin(2 * np.pi * 1.8 * t)  # steps
    eyes[:, :2] += 0.008 * np.stack([np.sin(2 * np.pi * 0.9 * t), np.cos(2 * np.pi * 0.7 * t)], 1)
    at = np.stack([0.1 * np.sin(5 * angle), 0.1 * np.cos(4 * angle), np.full(len(t), -0.6)], 1)
    forward = at - eyes
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    tremor = 0.004 * np.stack([np.sin(2 * np.pi * f * t + f) for f in (3.1, 4.3, 5.7)], 1)
    return eyes, np.stack([rotation_of(w) @ d for w, d in zip(tremor, forward, strict=True)])


def camera_at(t: float, duration: float, lens: Intrinsics) -> Camera:
    """The camera at one moment."""
    eye, forward = (a[0] for a in hand(np.array([t]), duration))
    return Camera(lens, look_at(eye, eye + forward))


def frame(model: SplatModel, t: float, duration: float, lens: Intrinsics, rng: np.random.Generator) -> np.ndarray:
    """(h, w, 3) uint8: row r is exposed from t + r / h READOUT for EXPOSURE; pictures between the moments drawn are mixed."""
    moments = np.linspace(0, READOUT + EXPOSURE, PARTS)
    start = READOUT * (np.arange(lens.height) + 0.5) / lens.height
    step = moments[1]
    out = np.zeros((lens.height, lens.width, 3), np.float32)
    for moment in moments:
        # Of a hat function around the moment, what the row's exposure sees, by midpoints.
        seen = (
            np.stack([1 - np.abs(start + EXPOSURE * (k + 0.5) / 8 - moment) / step for k in range(8)]).clip(0).mean(0)
        )
        if seen.any():
            rgb = model.render(camera_at(t + moment, duration, lens), (0, 0, 0))["rgb"]
            out += seen[:, None, None].astype(np.float32) * rgb
    gain = 1 + DRIFT * np.sin(2 * np.pi * t / 23)
    noise = rng.normal(0, NOISE, out.shape[:2] + (3,)).astype(np.float32)
    return np.clip(255 * gain * out + noise + 0.5, 0, 255).astype(np.uint8)


def make(args: argparse.Namespace) -> None:
    """Writes the video and, beside it, ``.json`` with the camera in the middle of each frame drawn."""
    import imageio_ffmpeg

    width, height = map(int, args.size.split("x"))
    lens = Intrinsics(width, height, 0.78 * width, 0.78 * width, width / 2, height / 2)
    model, rng, poses = room(), np.random.default_rng(1), []
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
        "-s", f"{width}x{height}", "-r", str(args.rendered), "-i", "-", "-r", str(args.rate), "-c:v", "libx264",
        "-preset", "ultrafast", "-crf", "20", "-pix_fmt", "yuv420p", args.video,
    ]  # fmt: skip
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        for k in range(round(args.seconds * args.rendered)):
            t = k / args.rendered
            process.stdin.write(frame(model, t, args.seconds, lens, rng).tobytes())
            poses.append(camera_at(t + (READOUT + EXPOSURE) / 2, args.seconds, lens).c2w.tolist())
    truth = {"rate": args.rate, "rendered": args.rendered, "poses": poses, "focal": lens.fx / width}
    Path(args.video).with_suffix(".json").write_text(json.dumps(truth))


def check(args: argparse.Namespace) -> int:
    """Prints how far the cameras of a folder are from the walk; 1 where one is farther than 0.5 % of the path."""
    truth = json.loads(Path(args.truth).read_text())
    poses = np.array(truth["poses"])
    path = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    views = [v for split in ("train", "val") for v in _named(load_dataset(args.scene, split, 8))]
    numbers = [int(int(re.findall(r"\d+", name)[-1]) * truth["rendered"] / truth["rate"]) for name, _ in views]
    wanted, found = poses[numbers], np.stack([camera.c2w for _, camera in views])
    a, b = wanted[:, :3, 3], found[:, :3, 3]
    u, s, vt = np.linalg.svd((a - a.mean(0)).T @ (b - b.mean(0)))
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation, scale = u @ np.diag(signs) @ vt, float((s * signs).sum() / ((b - b.mean(0)) ** 2).sum())
    off = np.linalg.norm(scale * (b - b.mean(0)) @ rotation.T + a.mean(0) - a, axis=1) / path
    turned = np.einsum("nji,njk->nik", wanted[:, :3, :3], rotation @ found[:, :3, :3])
    angles = np.degrees(np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1)))
    print(
        f"{len(off)} cameras on a path of {path:.2f}: centres off by {100 * np.median(off):.3f} % of it (median), "
        f"{100 * off.max():.3f} % at most; turned by {np.median(angles):.3f} degrees, {angles.max():.3f} at most"
    )
    return int(off.max() > 0.005)


def _named(dataset) -> list[tuple[str, Camera]]:  # noqa: ANN001
    return list(zip(dataset.names, dataset.cameras, strict=True))


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("make")
    one.add_argument("video")
    one.add_argument("--seconds", type=float, default=60)
    one.add_argument("--size", default="1920x1080")
    one.add_argument("--rate", type=int, default=30)
    one.add_argument("--rendered", type=int, default=10)
    one.set_defaults(run=make)
    two = commands.add_parser("check")
    two.add_argument("truth")
    two.add_argument("scene")
    two.set_defaults(run=check)
    args = parser.parse_args()
    return args.run(args) or 0


if __name__ == "__main__":
    sys.exit(main())
