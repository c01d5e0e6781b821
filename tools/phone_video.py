"""A video as a phone takes it, with the truth of where it was: to measure `nerfvol capture` with.

    python tools/phone_video.py make walk.mp4 [--seconds 60] [--size 1920x1080] [--rate 24]
    nerfvol capture walk.mp4 --out run
    python tools/phone_video.py check walk.json run/scene

A furnished room (tools/phone_room.py) along a walk around its table: steps, a trembling hand, rows read one after the other
(20 ms), each exposed for 10 ms, a lens that bends, exposure that drifts by 10 %, noise, x264. Every row of every frame is cast
from where the camera was when it was read. What is drawn has half the size and is enlarged: as soft as a phone's video, whose
full size is not its resolution. A minute costs ten minutes of one core. ``check`` aligns the cameras found with the walk by a
similarity and prints their errors in per cent of the length of the path.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from nerfvol.cameras.camera import Camera
from nerfvol.datasets.load import load_dataset

READOUT, EXPOSURE, SAMPLES = 0.02, 0.01, 4
FOCAL, BEND = 0.78, 0.03
"""Focal length in widths; the ray of a pixel at radius r goes through r (1 + BEND r^2), in focal lengths."""
NOISE, DRIFT = 4.0, 0.1
"""Standard deviation in levels of what is drawn; share of the exposure."""


def hand(seconds: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Places (n, 3) and rotations (n, 3, 3: right, up, back as columns) of the walk at these times."""
    t = np.asarray(seconds, np.float64)
    angle = 2 * np.pi * 0.85 * t / duration
    eyes = np.stack([1.5 * np.cos(angle), 1.05 * np.sin(angle), 0.2 + 0.15 * np.sin(3 * angle)], 1)
    eyes[:, 2] += 0.012 * np.sin(2 * np.pi * 1.8 * t)  # steps
    eyes[:, :2] += 0.008 * np.stack([np.sin(2 * np.pi * 0.9 * t), np.cos(2 * np.pi * 0.7 * t)], 1)
    at = np.stack([0.1 * np.sin(5 * angle), 0.1 * np.cos(4 * angle), np.full(len(t), -0.45)], 1)
    back = eyes - at
    tremor = 0.004 * np.stack([np.sin(2 * np.pi * f * t + f) for f in (3.1, 4.3, 5.7)], 1)
    back = back / np.linalg.norm(back, axis=1, keepdims=True)
    back = back + np.cross(tremor, back)
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    up = np.cross(back, right)
    roll = 0.01 * np.sin(2 * np.pi * 0.45 * t)[:, None]
    right, up = np.cos(roll) * right + np.sin(roll) * up, np.cos(roll) * up - np.sin(roll) * right
    return eyes, np.stack([right, up, back], 2)


def make(args: argparse.Namespace) -> None:
    """Writes the video and, beside it, ``.json`` with the camera in the middle of each frame."""
    import imageio_ffmpeg
    from phone_room import draw, furnish

    width, height = map(int, args.size.split("x"))
    drawn = (width // 2, height // 2)
    room, rng = furnish(), np.random.default_rng(1)
    grain = rng.normal(0, NOISE, (2 * drawn[1], 2 * drawn[0], 3)).astype(np.float32)  # a part of it for each frame
    rows = READOUT * (np.arange(drawn[1]) + 0.5) / drawn[1]
    moments = (rows[:, None] + EXPOSURE * (np.arange(SAMPLES) + 0.5) / SAMPLES).ravel()
    times = np.arange(round(args.seconds * args.rate)) / args.rate
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(), "-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgb24",
        "-s", f"{drawn[0]}x{drawn[1]}", "-r", str(args.rate), "-i", "-", "-vf", f"scale={width}:{height}:flags=bicubic",
        "-c:v", "libx264", "-preset", "ultrafast", "-crf", "20", "-threads", "1", "-pix_fmt", "yuv420p", args.video,
    ]  # fmt: skip
    with subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        assert process.stdin is not None
        for t in times:
            eyes, turns = hand(t + moments, args.seconds)
            shape = (drawn[1], SAMPLES)
            light = draw(
                room, eyes.reshape(*shape, 3), turns.reshape(*shape, 3, 3), drawn, FOCAL * drawn[0], BEND
            ).clip(0)
            light *= 1.6 * (1 + DRIFT * np.sin(2 * np.pi * t / 23))
            x, y = rng.integers(drawn[0]), rng.integers(drawn[1])
            levels = 255 * light ** np.float32(1 / 2.2) + grain[y : y + drawn[1], x : x + drawn[0]] + 0.5
            process.stdin.write(np.clip(levels, 0, 255).astype(np.uint8).tobytes())
    eyes, turns = hand(times + (READOUT + EXPOSURE) / 2, args.seconds)
    poses = np.tile(np.eye(4), (len(times), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, eyes
    Path(args.video).with_suffix(".json").write_text(json.dumps({"rate": args.rate, "poses": poses.tolist()}))


def check(args: argparse.Namespace) -> int:
    """Prints how far the cameras of a folder are from the walk; 1 where one is farther than 0.5 % of the path."""
    truth = json.loads(Path(args.truth).read_text())
    poses = np.array(truth["poses"])
    path = float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())
    views = [v for split in ("train", "val") for v in _named(load_dataset(args.scene, split, 8))]
    numbers = [int(re.findall(r"\d+", name)[-1]) for name, _ in views]
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
    one.add_argument("--rate", type=int, default=24)
    one.set_defaults(run=make)
    two = commands.add_parser("check")
    two.add_argument("truth")
    two.add_argument("scene")
    two.set_defaults(run=check)
    args = parser.parse_args()
    return args.run(args) or 0


if __name__ == "__main__":
    sys.exit(main())
