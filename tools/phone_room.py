# ruff: noqa: ANN001, ANN202  (compiled scalar code reads like its equation)
"""A furnished room, and its pictures by casting rays: each row of a picture from the places its camera had while it read it.

Boxes and balls with painted sides, lit by a lamp under the ceiling through a map of light on every side (shadows of 64
points of the lamp, and the open part of 64 directions for what the walls send back), a polished table and a window that is
far too bright. Everything a ray needs is compiled (numba, extra ``synth``): 0.15 microseconds a ray.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from data_synth.jit import in_bands, jit, kernel

HALF = np.array([2.2, 1.8, 1.2])
"""Half the edges of the room, whose middle is 0; z is up."""
LAMP, LAMP_SIDE = np.array([0.2, -0.1, 1.15]), 0.5
PICTURE, LIGHT, SIDES = 512, 24, 6
"""Texels along a painted side's picture, and along its map of light; sides of a box."""
WALLPAPER, WOOD, TILES, PLASTER, CLOTH, PAPER, WINDOW, BOOKS, POSTERS = 0, 1, 2, 3, 4, 5, 6, 7, 15
_FAR = 1e9


class Room(NamedTuple):
    """boxes: (n, 6) low and high corners, the room itself first, seen from inside. paints: (n, 6) number of the picture on each
    side (-x, +x, -y, +y, -z, +z). metres: (pictures,) that one repeats after. gloss: (n,) share of the lamp's mirror image.
    pictures: (m, 512, 512, 3) float32, albedo; light: (n, 6, 24, 24) float32 on the sides. groups: (g, 8) low and high
    corner of boxes first..last - 1."""

    boxes: np.ndarray
    paints: np.ndarray
    metres: np.ndarray
    gloss: np.ndarray
    pictures: np.ndarray
    light: np.ndarray
    groups: np.ndarray


def _noise(rng: np.random.Generator, octaves: tuple[int, ...]) -> np.ndarray:
    """(512, 512) of mean 0 and deviation 1 that repeats: noise of several fineness, each with half the weight of the last."""
    frequency = np.hypot(*np.meshgrid(*[np.fft.fftfreq(PICTURE) * PICTURE] * 2, indexing="ij"))
    total = np.zeros((PICTURE, PICTURE))
    for k, octave in enumerate(octaves):
        band = np.exp(-((np.log2(np.maximum(frequency, 0.5)) - octave) ** 2))
        part = np.fft.ifft2(np.fft.fft2(rng.normal(size=total.shape)) * band).real
        total += part / part.std() / 2**k
    return total / total.std()


def paints() -> tuple[np.ndarray, np.ndarray]:
    """The pictures (m, 512, 512, 3), albedo, and the metres that each repeats after."""
    rng, made, metres = np.random.default_rng(7), [], []
    v, u = np.meshgrid(*[(np.arange(PICTURE) + 0.5) / PICTURE] * 2, indexing="ij")

    def add(colour: tuple[float, float, float] | np.ndarray, grain: np.ndarray, share: float, repeat: float) -> None:
        made.append(np.clip(np.asarray(colour) * (1 + share * grain[..., None]), 0.02, 0.92))
        metres.append(repeat)

    leaf = np.sin(8 * np.pi * u + 2 * np.sin(4 * np.pi * v)) * np.sin(12 * np.pi * v)
    add((0.62, 0.60, 0.50), 0.6 * (leaf > 0.45) + 0.5 * _noise(rng, (4, 6, 7)), 0.13, 1.3)  # wallpaper
    rings = np.sin(2 * np.pi * (9 * v + 0.35 * _noise(rng, (1, 2)))) + 0.6 * _noise(rng, (5, 7))
    add((0.45, 0.27, 0.14), rings, 0.16, 0.8)  # wood
    tile = rng.uniform(0.25, 0.6, (8, 8, 3)).repeat(PICTURE // 8, 0).repeat(PICTURE // 8, 1)
    joint = ((u * 8 % 1 < 0.04) | (v * 8 % 1 < 0.04)).astype(float)
    add(tile * (1 - 0.6 * joint[..., None]), _noise(rng, (4, 6, 8)), 0.10, 1.6)  # the floor
    add((0.78, 0.77, 0.74), _noise(rng, (2, 5, 7)), 0.02, 2.0)  # plaster: almost bare
    cloth = np.sin(2 * np.pi * 24 * u) * np.sin(2 * np.pi * 24 * v) + _noise(rng, (3, 6, 8))
    add((0.20, 0.30, 0.42), cloth, 0.18, 0.6)
    add((0.7, 0.2, 0.15), np.sign(np.sin(2 * np.pi * 6 * u)) + 0.4 * _noise(rng, (5, 7)), 0.25, 0.5)  # paper
    add((30.0, 30.0, 30.0), np.zeros_like(u), 0.0, 1.0)  # the window
    made[-1][...] = 1.0
    for _ in range(POSTERS - BOOKS):  # backs of books, with lines of writing
        line = (rng.uniform(size=(64, 1)) < 0.3).repeat(PICTURE // 64, 0) & (np.abs(u - 0.5) < rng.uniform(0.1, 0.4))
        add(rng.uniform(0.08, 0.6, 3), 2.0 * line + 0.5 * _noise(rng, (5, 7)), 0.22, 0.31)
    for _ in range(4):  # posters: coloured shapes
        picture = np.tile(rng.uniform(0.3, 0.8, 3), (PICTURE, PICTURE, 1))
        for _ in range(60):
            x, y, size, turn = rng.uniform(0, 1, 2).tolist() + [rng.uniform(0.02, 0.14), rng.uniform(0, 3)]
            a, b = (
                (u - x) * math.cos(turn) + (v - y) * math.sin(turn),
                (v - y) * math.cos(turn) - (u - x) * math.sin(turn),
            )
            shape = np.maximum(np.abs(a), np.abs(b)) < size if rng.uniform() < 0.6 else a * a + b * b < size * size
            picture[shape] = rng.uniform(0.05, 0.85, 3)
        add(picture, _noise(rng, (6, 8)), 0.05, 1.0)
    return np.stack(made).astype(np.float32), np.array(metres, np.float32)


def furnish() -> Room:
    """The room with everything in it, lit."""
    rng = np.random.default_rng(3)
    boxes: list[list[float]] = [[*-HALF, *HALF]]
    sides: list[list[int]] = [[WALLPAPER, PLASTER, WALLPAPER, WALLPAPER, TILES, PLASTER]]
    gloss, ends = [0.0], [1]

    def add(low: tuple[float, ...], high: tuple[float, ...], paint: int | list[int], polish: float = 0.0) -> None:
        boxes.append([*low, *high])
        sides.append([paint] * SIDES if isinstance(paint, int) else paint)
        gloss.append(polish)

    add((-0.55, -0.40, -0.50), (0.55, 0.40, -0.45), WOOD, 0.5)  # table
    for x in (-0.5, 0.44):
        for y in (-0.35, 0.29):
            add((x, y, -1.2), (x + 0.06, y + 0.06, -0.5), WOOD)
    add((-0.30, -0.15, -0.45), (-0.05, 0.05, -0.27), POSTERS)  # on it: boxes, a pile of books, a cup
    add((0.12, -0.22, -0.45), (0.36, -0.04, -0.40), BOOKS)
    add((0.14, -0.20, -0.40), (0.35, -0.05, -0.36), BOOKS + 1)
    add((0.16, -0.21, -0.36), (0.33, -0.06, -0.33), BOOKS + 2)
    add((0.05, 0.12, -0.45), (0.15, 0.22, -0.31), PAPER, 0.2)
    add((0.30, 0.10, -0.45), (0.38, 0.30, -0.43), BOOKS + 3)
    ends.append(len(boxes))
    for k in range(3):  # shelf: boards and books
        add((-0.9, 1.45, -0.75 + 0.5 * k), (0.9, 1.8, -0.72 + 0.5 * k), WOOD)
    ends.append(len(boxes))
    for k in range(3):
        x = -0.86
        while x < 0.8:
            thick, tall = rng.uniform(0.04, 0.11), rng.uniform(0.22, 0.38)
            if rng.uniform() < 0.85:
                add((x, 1.5, -0.72 + 0.5 * k), (x + thick, 1.72, -0.72 + 0.5 * k + tall), BOOKS + int(rng.integers(8)))
            x += thick + 0.005
        ends.append(len(boxes))
    add((-2.2, -1.0, -1.2), (-1.75, 0.6, -0.75), CLOTH)  # sofa
    add((-2.2, -1.0, -0.75), (-2.0, 0.6, -0.35), CLOTH)
    add((1.7, -0.9, -1.2), (2.2, -0.2, -0.3), WOOD)  # chest, a lamp's foot on it
    add((1.85, -0.65, -0.3), (2.0, -0.5, 0.05), PAPER)
    add((1.6, 0.8, -1.2), (2.0, 1.2, -0.75), POSTERS + 1)
    ends.append(len(boxes))
    for k, (x, z) in enumerate(((-1.3, 0.2), (-0.2, 0.25), (0.9, 0.15))):  # pictures on a wall, a window
        add((x - 0.35, -1.8, z - 0.3), (x + 0.35, -1.78, z + 0.3), POSTERS + k)
    add((2.18, 0.2, -0.1), (2.2, 0.75, 0.7), WINDOW)
    add((-2.2, -0.8, 0.1), (-2.18, 0.1, 0.75), POSTERS + 3)
    ends.append(len(boxes))
    found = np.array(boxes)
    spans = list(zip(ends[:-1], ends[1:], strict=True))
    groups = np.array([[*found[a:b, :3].min(0), *found[a:b, 3:].max(0), a, b] for a, b in spans])
    pictures, metres = paints()
    light = np.zeros((len(found), SIDES, LIGHT, LIGHT), np.float32)
    room = Room(found, np.array(sides, np.int64), metres, np.array(gloss), pictures, light, groups)
    in_bands(lambda a, b: _bake(room, np.zeros((3, 3)), a, b), len(found), 1)
    return room


@jit
def _hit(room, ox, oy, oz, dx, dy, dz):
    """(distance, box, side) of the first surface of a ray; the room's own walls are seen from inside."""
    ix, iy, iz = 1 / dx, 1 / dy, 1 / dz
    best, which, face = _FAR, 0, 0
    b = room.boxes[0]
    tx, ty, tz = (b[3] if dx > 0 else b[0]) - ox, (b[4] if dy > 0 else b[1]) - oy, (b[5] if dz > 0 else b[2]) - oz
    tx, ty, tz = tx * ix, ty * iy, tz * iz
    if tx <= ty and tx <= tz:
        best, face = tx, 1 if dx > 0 else 0
    elif ty <= tz:
        best, face = ty, 3 if dy > 0 else 2
    else:
        best, face = tz, 5 if dz > 0 else 4
    for g in range(room.groups.shape[0]):
        near, _, far = _slab(room.groups[g], ox, oy, oz, ix, iy, iz)
        if near > far or far < 0 or near > best:
            continue
        for k in range(int(room.groups[g, 6]), int(room.groups[g, 7])):
            near, side, far = _slab(room.boxes[k], ox, oy, oz, ix, iy, iz)
            if 1e-6 < near < best and near <= far:
                best, which, face = near, k, side
    return best, which, face


@jit
def _slab(b, ox, oy, oz, ix, iy, iz):
    """(near, side that is entered, far) of a ray and a box."""
    x0, x1, y0, y1 = (b[0] - ox) * ix, (b[3] - ox) * ix, (b[1] - oy) * iy, (b[4] - oy) * iy
    z0, z1 = (b[2] - oz) * iz, (b[5] - oz) * iz
    nx, ny, nz = min(x0, x1), min(y0, y1), min(z0, z1)
    far = min(max(x0, x1), max(y0, y1), max(z0, z1))
    if nx >= ny and nx >= nz:
        return nx, 0 if x0 <= x1 else 1, far
    if ny >= nz:
        return ny, 2 if y0 <= y1 else 3, far
    return nz, 4 if z0 <= z1 else 5, far


@kernel
def _bake(room, vectors, first, last):
    """The maps of light of boxes first..last - 1: 64 points of the lamp, 64 directions for the rest. vectors: (3, 3) to use."""
    p, n, w = vectors[0], vectors[1], vectors[2]
    for k in range(first, last):
        b = room.boxes[k]
        for side in range(6):
            axis = side // 2
            outwards = (1.0 if side % 2 else -1.0) * (-1.0 if k == 0 else 1.0)
            u, v = (axis + 1) % 3, (axis + 2) % 3
            n[:] = 0.0
            n[axis] = outwards
            for i in range(LIGHT):
                for j in range(LIGHT):
                    p[axis] = b[axis + 3 * (side % 2)] + 1e-4 * outwards
                    p[u] = b[u] + (b[u + 3] - b[u]) * min(max(i / (LIGHT - 1.0), 0.01), 0.99)
                    p[v] = b[v] + (b[v + 3] - b[v]) * min(max(j / (LIGHT - 1.0), 0.01), 0.99)
                    total = 0.0
                    for s in range(64):
                        x = 0.2 + LAMP_SIDE * ((s % 8 + 0.5) / 8 - 0.5) - p[0]
                        y = -0.1 + LAMP_SIDE * ((s // 8 + 0.5) / 8 - 0.5) - p[1]
                        z = 1.15 - p[2]
                        r = math.sqrt(x * x + y * y + z * z) + 1e-9
                        x, y, z = x / r, y / r, z / r
                        cosine = n[0] * x + n[1] * y + n[2] * z
                        if cosine > 0 and _hit(room, p[0], p[1], p[2], x + 1e-12, y + 1e-12, z)[0] > r - 0.06:
                            total += 1.9 * cosine * max(z, 0.15) / (0.6 + r * r) / 64
                        # Cosine-distributed directions of a spiral: what is open within 1.5 m.
                        radius, angle = math.sqrt((s + 0.5) / 64), 2.399963 * s
                        w[axis] = outwards * math.sqrt(1 - radius * radius)
                        w[u], w[v] = radius * math.cos(angle) + 1e-12, radius * math.sin(angle) + 1e-12
                        open_ = _hit(room, p[0], p[1], p[2], w[0] + 1e-12, w[1] + 1e-12, w[2] + 1e-12)[0]
                        total += 0.42 * min(1.0, open_ / 1.5) / 64
                    room.light[k, side, i, j] = total


@jit
def _bilinear(table, x, y, wrap):
    """Corners and weights at (x, y) in texels of a square table side: (x0, x1, y0, y1, fx, fy)."""
    n = table
    if wrap:
        fx, fy = math.floor(x), math.floor(y)
        return int(fx) % n, (int(fx) + 1) % n, int(fy) % n, (int(fy) + 1) % n, x - fx, y - fy
    x, y = min(max(x, 0.0), n - 1.001), min(max(y, 0.0), n - 1.001)
    return int(x), int(x) + 1, int(y), int(y) + 1, x - int(x), y - int(y)


@jit
def _mixed(picture, x0, x1, y0, y1, fx, fy, c):
    """Channel c of a picture between four texels."""
    above = (1 - fx) * picture[y0, x0, c] + fx * picture[y0, x1, c]
    below = (1 - fx) * picture[y1, x0, c] + fx * picture[y1, x1, c]
    return (1 - fy) * above + fy * below


@kernel
def _rows(room, eyes, turns, lens, out, first, last):
    """Rows first..last - 1 of a picture: see :func:`draw`."""
    samples = eyes.shape[1]
    width, height = out.shape[1], out.shape[0]
    for row in range(first, last):
        for column in range(width):
            red, green, blue = 0.0, 0.0, 0.0
            for s in range(samples):
                # The samples of a pixel stand in it as well as in time.
                x = (column + (s + 0.5) / samples - 0.5 * width) / lens[0]
                y = (row + ((s * 0.618034 + 0.31) % 1.0) - 0.5 * height) / lens[0]
                bend = 1 + lens[1] * (x * x + y * y)
                x, y = x * bend, -y * bend
                m = turns[row, s]
                dx = m[0, 0] * x + m[0, 1] * y - m[0, 2]
                dy = m[1, 0] * x + m[1, 1] * y - m[1, 2]
                dz = m[2, 0] * x + m[2, 1] * y - m[2, 2]
                e = eyes[row, s]
                t, k, side = _hit(room, e[0], e[1], e[2], dx, dy, dz)
                px, py, pz = e[0] + t * dx, e[1] + t * dy, e[2] + t * dz
                b, axis, paint = room.boxes[k], side // 2, room.paints[k, side]
                if axis == 0:
                    u, v, lu, lv = py, pz, (py - b[1]) / (b[4] - b[1]), (pz - b[2]) / (b[5] - b[2])
                elif axis == 1:
                    u, v, lv, lu = px, pz, (px - b[0]) / (b[3] - b[0]), (pz - b[2]) / (b[5] - b[2])
                else:
                    u, v, lu, lv = px, py, (px - b[0]) / (b[3] - b[0]), (py - b[1]) / (b[4] - b[1])
                if k > 0:
                    u, v = u + 0.37 * k, v + 0.61 * k
                a0, a1, b0, b1, fa, fb = _bilinear(LIGHT, lu * (LIGHT - 1), lv * (LIGHT - 1), False)
                table = room.light[k, side]
                lit = (table[a0, b0] * (1 - fa) + table[a1, b0] * fa) * (1 - fb)
                lit += (table[a0, b1] * (1 - fa) + table[a1, b1] * fa) * fb
                if paint == WINDOW:
                    lit = 2.5
                scale = PICTURE / room.metres[paint]
                a0, a1, b0, b1, fa, fb = _bilinear(PICTURE, u * scale, v * scale, True)
                picture = room.pictures[paint]
                shine = 0.0
                if room.gloss[k] > 0 and side == 5:  # the lamp's mirror image in the table top
                    reach = (LAMP[2] - pz) / max(-dz, 1e-6)
                    qx, qy = px + reach * dx - LAMP[0], py + reach * dy - LAMP[1]
                    shine = room.gloss[k] * math.exp(-4 * (qx * qx + qy * qy) / (LAMP_SIDE * LAMP_SIDE))
                red += shine + lit * _mixed(picture, a0, a1, b0, b1, fa, fb, 0)
                green += shine + lit * _mixed(picture, a0, a1, b0, b1, fa, fb, 1)
                blue += shine + lit * _mixed(picture, a0, a1, b0, b1, fa, fb, 2)
            out[row, column, 0], out[row, column, 1], out[row, column, 2] = (
                red / samples,
                green / samples,
                blue / samples,
            )


def draw(
    room: Room, eyes: np.ndarray, turns: np.ndarray, size: tuple[int, int], focal: float, bend: float
) -> np.ndarray:
    """The picture (h, w, 3) float32, light: row r is the mean of samples s from ``eyes`` (h, s, 3), turned by ``turns``
    (h, s, 3, 3: camera to world, x right, y up, looking along -z). ``focal``: in pixels; ``bend``: the ray of a pixel at radius
    r (in focal lengths) goes through r (1 + bend r^2)."""
    out = np.zeros((size[1], size[0], 3), np.float32)
    lens = np.array([focal, bend])
    in_bands(lambda a, b: _rows(room, eyes, turns, lens, out, a, b), size[1], 30)
    return out
