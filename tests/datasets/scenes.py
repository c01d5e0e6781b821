"""Small posed scenes written to disk in each format, from cameras and images the tests know."""

from __future__ import annotations

import json
import math
import struct
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from nerfvol.cameras.camera import Camera, Intrinsics, orbit

LENS = Intrinsics(24, 16, 30.0, 30.0, 12.0, 8.0)


def ring(n=9, intrinsics=LENS, radius=4.0):
    """n cameras around the origin, on two heights so that nothing about them is flat."""
    low = orbit(n, center=(0, 0, 0), radius=radius, elevation_deg=15, intrinsics=intrinsics)
    high = orbit(n, center=(0, 0, 0), radius=radius, elevation_deg=50, intrinsics=intrinsics)
    return [low[i] if i % 2 else high[i] for i in range(n)]


def random_images(n=9, size=(24, 16), channels=3, seed=0):
    generator = np.random.default_rng(seed)
    return [generator.integers(0, 256, (size[1], size[0], channels), dtype=np.uint8) for _ in range(n)]


def save_images(folder: Path, images, suffix=".png") -> list[str]:
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"view_{i:03d}{suffix}" for i in range(len(images))]
    for name, image in zip(names, images, strict=True):
        Image.fromarray(image).save(folder / name)
    return names


def frame(name: str, camera: Camera, **more):
    return {"file_path": name, "transform_matrix": camera.c2w.tolist(), **more}


def write_json(path: Path, **data) -> Path:
    path.write_text(json.dumps(data))
    return path


def write_blender(folder: Path, cameras, images, splits=("train",)) -> Path:
    """NeRF-synthetic: camera_angle_x alone, file names without suffix, a json and a folder a split."""
    angle = 2 * math.atan(0.5 * cameras[0].intrinsics.width / cameras[0].intrinsics.fx)
    for split in splits:
        names = save_images(folder / split, images)
        frames = [frame(f"./{split}/{Path(n).stem}", c) for n, c in zip(names, cameras, strict=True)]
        write_json(folder / f"transforms_{split}.json", camera_angle_x=angle, frames=frames)
    return folder


def calibration(intrinsics: Intrinsics) -> dict:
    """The keys instant-ngp and nerfstudio use."""
    k = intrinsics
    return {
        "w": k.width, "h": k.height, "fl_x": k.fx, "fl_y": k.fy, "cx": k.cx, "cy": k.cy,
        "k1": k.k1, "k2": k.k2, "k3": k.k3, "k4": k.k4, "p1": k.p1, "p2": k.p2,
    }  # fmt: skip


def write_instant_ngp(folder: Path, cameras, images, **more) -> Path:
    """One transforms.json with the calibration at the top."""
    names = save_images(folder / "images", images)
    frames = [frame(f"images/{n}", c) for n, c in zip(names, cameras, strict=True)]
    write_json(folder / "transforms.json", **calibration(cameras[0].intrinsics), **more, frames=frames)
    return folder


def write_nerfstudio(folder: Path, cameras, images, **more) -> Path:
    """One transforms.json with a calibration in every frame."""
    names = save_images(folder / "images", images)
    frames = [frame(f"images/{n}", c, **calibration(c.intrinsics)) for n, c in zip(names, cameras, strict=True)]
    write_json(folder / "transforms.json", camera_model="OPENCV", **more, frames=frames)
    return folder


def png_bytes(values: np.ndarray, declared: tuple[int, int] | None = None) -> bytes:
    """A PNG (h, w, 1..4) of 8 or 16 bits a channel, written out by hand: Pillow cannot write 16-bit colour.

    ``declared`` (width, height) makes the header lie about the size.
    """
    height, width, channels = values.shape
    colour_type = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    bits = 8 * values.dtype.itemsize

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = values.astype(f">u{values.dtype.itemsize}").reshape(height, -1)
    raw = b"".join(b"\0" + row.tobytes() for row in rows)
    header = struct.pack(">IIBBBBB", *(declared or (width, height)), bits, colour_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")


def write_llff(folder: Path, cameras, images, *, factor=4, near_far=(2.0, 9.0)) -> Path:
    """poses_bounds.npy for originals ``factor`` times as large as the images, which lie in images_<factor>."""
    save_images(folder / f"images_{factor}", images)
    rows = []
    for camera in cameras:
        right, up, back, position = camera.c2w[:3].T
        k = camera.intrinsics
        size = [factor * k.height, factor * k.width, factor * k.fx]
        rows.append([*np.stack([-up, right, back, position, size], axis=1).ravel(), *near_far])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def write_nsvf(folder: Path, cameras, images, *, prefixes=("0_",), box=None) -> Path:
    """intrinsics.txt, pose and rgb; image i's name begins with prefixes[i % len(prefixes)]."""
    (folder / "pose").mkdir(parents=True)
    (folder / "rgb").mkdir()
    k = cameras[0].intrinsics
    matrix = [[k.fx, 0, k.cx, 0], [0, k.fy, k.cy, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    np.savetxt(folder / "intrinsics.txt", matrix, fmt="%.17g")
    for i, (camera, image) in enumerate(zip(cameras, images, strict=True)):
        name = f"{prefixes[i % len(prefixes)]}view_{i:03d}"
        Image.fromarray(image).save(folder / "rgb" / f"{name}.png")
        np.savetxt(folder / "pose" / f"{name}.txt", camera.c2w * (1, -1, -1, 1), fmt="%.17g")
    if box is not None:
        (folder / "bbox.txt").write_text(" ".join(map(str, [*box, 0.4])))
    return folder


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """(w, x, y, z) of a rotation: the eigenvector of the symmetric matrix that measures agreement (Bar-Itzhack)."""
    r = rotation
    k = np.array([
        [r[0, 0] + r[1, 1] + r[2, 2], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]],
        [r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1]],
        [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1]],
    ])  # fmt: skip
    return np.linalg.eigh(k)[1][:, -1]


def colmap_pose(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera quaternion and translation in OpenCV axes."""
    rotation = (camera.c2w[:3, :3] * (1, -1, -1)).T
    return quaternion(rotation), -rotation @ camera.c2w[:3, 3]


def write_colmap(folder: Path, cameras, images, *, model="OPENCV", text=False, stretch=1.0) -> Path:
    """sparse/0 with one camera an image; ``stretch`` scales the quaternions, which mean the same rotation."""
    names = save_images(folder / "images", images)
    target = folder / "sparse" / "0"
    target.mkdir(parents=True, exist_ok=True)
    number = {"PINHOLE": 1, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6}[model]
    parameters = [colmap_parameters(camera.intrinsics, model) for camera in cameras]
    poses = [colmap_pose(camera) for camera in cameras]
    if text:
        rows = [f"{i + 1} {model} {c.intrinsics.width} {c.intrinsics.height} " + " ".join(map(repr, map(float, p)))
                for i, (c, p) in enumerate(zip(cameras, parameters, strict=True))]  # fmt: skip
        (target / "cameras.txt").write_text("# Camera list\n" + "\n".join(rows) + "\n")
        views = []
        for i, ((q, t), name) in enumerate(zip(poses, names, strict=True)):
            numbers = " ".join(repr(float(v)) for v in (*stretch * q, *t))
            views.append(f"{i + 1} {numbers} {i + 1} {name}\n" + "1.0 2.0 -1 " * i + "\n")
        (target / "images.txt").write_text("# Image list\n" + "".join(views))
        return folder
    data = struct.pack("<Q", len(cameras))
    for i, (camera, p) in enumerate(zip(cameras, parameters, strict=True)):
        data += struct.pack("<iiQQ", i + 1, number, camera.intrinsics.width, camera.intrinsics.height)
        data += struct.pack(f"<{len(p)}d", *p)
    (target / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(cameras))
    for i, ((q, t), name) in enumerate(zip(poses, names, strict=True)):
        features = struct.pack("<ddq", 1.0, 2.0, -1) * i
        data += struct.pack("<i7di", i + 1, *(stretch * q), *t, i + 1) + name.encode() + b"\0"
        data += struct.pack("<Q", i) + features
    (target / "images.bin").write_bytes(data)
    return folder


def write_points(folder: Path, cameras, places, *, text=False) -> None:
    """points3D beside the model: each camera (numbered from 1) shows all ``places`` (n, 3), of colour (1, 2, 250)."""
    target = folder / "sparse" / "0"
    track = [n for i in range(len(cameras)) for n in (i + 1, 0)]
    if text:
        rows = [f"{i} {x} {y} {z} 1 2 250 0.5 " + " ".join(map(str, track)) for i, (x, y, z) in enumerate(places)]
        (target / "points3D.txt").write_text("# Points\n" + "\n".join(rows) + "\n")
        return
    data = struct.pack("<Q", len(places))
    for i, place in enumerate(places):
        data += struct.pack("<Q3d3BdQ", i, *place, 1, 2, 250, 0.5, len(cameras)) + struct.pack(
            f"<{len(track)}i", *track
        )
    (target / "points3D.bin").write_bytes(data)


def colmap_parameters(k: Intrinsics, model: str) -> list[float]:
    shared = [k.fx, k.fy, k.cx, k.cy]
    return {
        "PINHOLE": shared,
        "OPENCV": [*shared, k.k1, k.k2, k.p1, k.p2],
        "OPENCV_FISHEYE": [*shared, k.k1, k.k2, k.k3, k.k4],
        "FULL_OPENCV": [*shared, k.k1, k.k2, k.p1, k.p2, k.k3, 0.0, 0.0, 0.0],
    }[model]
