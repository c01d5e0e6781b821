"""A scene that takes no time to make, a coloured sphere, as pictures and as an octree."""

import json
from pathlib import Path

import numpy as np

from nerfvol.cameras.camera import Intrinsics, orbit
from nerfvol.octree.tree import Octree

TINY_SIZE = 40
TINY_RADIUS = 0.8


def sphere_image(camera, colour, samples=4):
    """RGBA (H, W, 4), straight alpha, of the sphere of TINY_RADIUS at the origin, from samples^2 rays a pixel."""
    lens = camera.intrinsics
    offsets = (np.arange(samples) + 0.5) / samples
    total = np.zeros((lens.height * lens.width, 4))
    for dx in offsets:
        for dy in offsets:
            pixels = np.stack(np.meshgrid(np.arange(lens.width) + dx, np.arange(lens.height) + dy), -1).reshape(-1, 2)
            origin, directions = camera.rays_at(pixels)
            b = directions @ origin
            discriminant = b * b - (origin @ origin - TINY_RADIUS**2)
            hit = (discriminant > 0)[:, None]
            points = origin + (-b - np.sqrt(np.maximum(discriminant, 0)))[:, None] * directions
            total += np.concatenate([np.where(hit, colour(points), 0.0), hit], axis=1) / samples**2
    total[:, :3] /= np.maximum(total[:, 3:], 1e-9)
    return total.reshape(lens.height, lens.width, 4)


def sphere_colour(points):
    """A smooth colour in [0.1, 0.9]."""
    return 0.5 + 0.4 * np.sin(3.0 * points)


def write_scene(folder: Path, views: dict[str, int], size: int = TINY_SIZE) -> Path:
    """A coloured sphere with alpha, in the NeRF-synthetic layout."""
    from nerfvol.files.pictures import write_png

    lens = Intrinsics(size, size, 1.4 * size, 1.4 * size, size / 2, size / 2)
    for number, (split, count) in enumerate(views.items()):
        (folder / split).mkdir(parents=True)
        cameras = []
        for elevation in (-25.0, 20.0 + 10 * number):
            cameras += orbit(-(-count // 2), center=(0, 0, 0), radius=3.2, elevation_deg=elevation, intrinsics=lens)
        frames = []
        for i, camera in enumerate(cameras[:count]):
            write_png(folder / split / f"r_{i}.png", sphere_image(camera, sphere_colour))
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": camera.c2w.tolist()})
        document = {"camera_angle_x": 2 * float(np.arctan(0.5 / 1.4)), "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    return folder


def make_sphere_octree(level: int = 5) -> Octree:
    """The same sphere as an octree: opaque inside, empty outside, colour at the vertices."""
    n = 1 << level
    cells = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    centers = (cells + 0.5) * (2.0 / n) - 1.0
    near = np.abs(np.linalg.norm(centers, axis=1) - TINY_RADIUS) < 4.0 / n
    octree = Octree.from_leaves(np.full(near.sum(), level), cells[near], (-1, -1, -1), 2.0, 0, 150.0)
    position = octree.vertex_positions()
    radius = np.linalg.norm(position, axis=1)
    octree.density = np.clip((TINY_RADIUS - radius) * 40.0 * n / 16, -9.0, 4.0)
    on_surface = position * (TINY_RADIUS / np.maximum(radius, 1e-9))[:, None]
    octree.sh = ((sphere_colour(on_surface) - 0.5) / 0.28209479177387814)[:, :, None]
    return octree
