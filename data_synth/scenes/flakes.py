"""Scenes of microflakes: a cloth of fibres in a volume, and leaves of thin layers."""

from __future__ import annotations

import numpy as np

from data_synth import lights, materials, media, spongecake, surfaces
from data_synth import sggx as flakes
from data_synth.cameras import Viewpoints
from data_synth.scene import Scene

IVORY, INDIGO, MADDER = (0.95, 0.90, 0.78), (0.16, 0.27, 0.60), (0.82, 0.20, 0.14)
SETT = (IVORY,) * 5 + (INDIGO,) * 4 + (MADDER,) + (INDIGO,) * 2
"""Albedo of one thread after the other, of warp and weft alike."""
SELVEDGE = 1.06  # u from the middle to where threads across end, and those along are a fringe
TWIST = 0.4  # tangent of the angle between a thread and the fibres on its outside
VEINS, ALONG, ACROSS = (
    9,
    4,
    7,
)  # of a leaf: veins a side; rows of triangles between two of them; columns from the midrib to the rim
SWEEP = 0.3  # of a leaf's length: how far a vein runs towards the tip on its way to the rim


def cloth(roughness: float = 0.25, density: float = 60.0, resolution: int = 192, threads: int = 24) -> Scene:
    """a twill of dyed SGGX fibres that hangs in folds: S follows every thread and its twist

    threads: warp threads, and as many weft threads.
    """
    lo, hi, n = np.array([-1.2, -1.2, -0.35]), np.array([1.2, 1.2, 0.35]), resolution
    sides = (n, n, max(int(n * 0.7 / 2.4) + 1, 16))
    axes = [np.linspace(a, b, k, dtype=np.float32) for a, b, k in zip(lo, hi, sides, strict=True)]
    x, y, z = np.meshgrid(*axes, indexing="ij", sparse=True)
    fold = 0.15 * np.sin(2.6 * x + 0.9 * y + 0.4) + 0.06 * np.sin(1.1 * x - 3.1 * y + 1.0)
    steep_x = 0.39 * np.cos(2.6 * x + 0.9 * y + 0.4) + 0.066 * np.cos(1.1 * x - 3.1 * y + 1.0)
    steep_y = 0.135 * np.cos(2.6 * x + 0.9 * y + 0.4) - 0.186 * np.cos(1.1 * x - 3.1 * y + 1.0)
    pitch = 2.4 / threads
    warp, warp_colour, (ax, ay, az) = _threads(x, y, z - fold, steep_x, pitch, 0)
    weft, weft_colour, (by, bx, bz) = _threads(y, x, z - fold, steep_y, pitch, 1)
    first = warp < weft
    rho = density * np.clip(1.6 * (1.0 - np.minimum(warp, weft)), 0, 1)
    a = np.stack([np.where(first, p, q) for p, q in ((ax, bx), (ay, by), (az, bz))], axis=-1)
    a /= np.sqrt((a * a).sum(axis=-1, keepdims=True))
    flat = 1.0 - roughness**2  # S = 1 - flat a a', of fibres along a
    S = -flat * np.stack([a[..., i] * a[..., j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], axis=-1)
    S[..., :3] += 1.0
    colour = np.where(first[..., None], warp_colour, weft_colour)
    return Scene(
        medium=media.grid(rho, lo, hi, 1.0, colour, S=S),
        lights=[lights.directional((0.9, -0.35, 0.75), (6.0, 5.4, 4.6)), lights.sky((0.5, 0.6, 0.9), 0.7, 0.25)],
        viewpoints=Viewpoints(radius=4.2, elevation=(25, 75)),
        integrators=("path", "deep", "march"),
        aabb=np.array([lo, hi]),
    )


def _threads(
    along: np.ndarray, across: np.ndarray, up: np.ndarray, steep: np.ndarray, pitch: float, shift: int
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Threads that run one way, over two and under two of the others: (squared distance from the middle of the nearest thread,
    1 at its rim; its colour; direction of the fibres along, across and up). steep: of the fold, along the thread."""
    k = np.floor(across / pitch)
    turn = 0.5 * np.pi * (along / pitch - k - shift)
    sideways = (across - (k + 0.5) * pitch) / (0.46 * pitch)
    above = (up - 0.2 * pitch * np.sin(turn)) / (pitch / 3)
    apart = np.where(np.abs((k + 0.5) * pitch) < SELVEDGE, 0.0, np.inf).astype(np.float32)
    colour = np.array(SETT, np.float32)[np.mod(k, len(SETT)).astype(int)]
    distance = sideways**2 + above**2 + apart
    climb = steep + 0.1 * np.pi * np.cos(turn)
    return distance, colour, (np.ones_like(distance), -TWIST * above, climb + TWIST * sideways)


def leaf(thickness: float = 1.4, leaves: int = 7) -> Scene:
    """a sprig of leaves of SpongeCake layers, lit from behind: a waxy skin, veins of fibres, green flesh

    thickness: of the flesh, density times depth.
    """
    skin = spongecake.layer(0.12, flakes.surface((0, 0, 1), 0.2), (0.9, 0.95, 0.85))
    flesh = spongecake.layer(thickness, flakes.surface((0, 0, 1), 0.75), (0.30, 0.78, 0.08))
    layers, kinds = [skin, flesh], [materials.lambert((0.20, 0.13, 0.06)), materials.layered(0, 2)]
    stem = np.array([-1.25, 0.0, -0.25]) + np.linspace(0, 1, 25)[:, None] * np.array([2.0, 0.0, 0.0])
    stem[:, 1] = 0.12 * np.sin(2.4 * (stem[:, 0] + 1.2))
    stem[:, 2] += 0.28 * np.sin(0.8 * (stem[:, 0] + 1.25))
    meshes = [_tube(0, stem, np.linspace(0.022, 0.009, len(stem)))]
    for k in range(leaves):
        place = 1.0 if leaves == 1 else 0.12 + 0.88 * k / (leaves - 1)  # of the stem
        base = stem[int(round(place * (len(stem) - 1)))]
        side = 0.0 if k == leaves - 1 else 1.0 if k % 2 else -1.0  # the last one ends the stem
        turn, size = side * (1.05 - 0.35 * place) + 0.1 * np.sin(5.0 * k), 0.78 * (1.0 - 0.25 * abs(place - 0.45))
        first = len(layers)
        for sign in (-1, 0, 1):  # the fibres of a vein run along it: on the right, in the middle, on the left
            a = turn + sign * 0.9
            fibres = spongecake.layer(0.55, flakes.fibre((np.cos(a), np.sin(a), 0), 0.3), (0.75, 0.88, 0.42))
            layers += [skin, fibres, flesh]
            kinds.append(materials.layered(first + 3 * (sign + 1), first + 3 * (sign + 1) + 3))
        meshes.append(_blade(len(kinds) - 2, base, turn, 0.28 - 0.3 * side * side * np.cos(3.0 * k), size))
    return Scene(
        triangles=np.concatenate(meshes),
        materials=kinds,
        layers=layers,
        lights=[lights.directional((-0.55, 0.75, 0.62), (6.5, 6.0, 5.0)), lights.sky((0.5, 0.65, 1.0), 0.8, 0.3)],
        viewpoints=Viewpoints(radius=3.8, elevation=(15, 70)),
        integrators=("path", "march"),
        aabb=np.array([[-1.4, -1.0, -0.8], [1.6, 1.0, 0.7]]),
    )


def _blade(midrib: int, base: np.ndarray, turn: float, rise: float, size: float) -> np.ndarray:
    """Triangles of a leaf of length ``size`` and its stalk from ``base`` on, turned about z and tilted by ``rise`` (radians).

    midrib: the number of its material; those of the veins on its right and left are one less and one more, the blade's is 1.
    """
    at = -SWEEP + (1 + SWEEP) * (np.arange(VEINS) + 0.6) / VEINS  # where veins would leave the midrib
    gap = (1 + SWEEP) / VEINS
    u = np.concatenate([np.r_[v, v + 0.05 * gap, v + np.linspace(0.05, 1, ALONG + 1)[1:-1] * gap] for v in at])
    u = np.r_[at[0] - gap, at[0] - gap / 2, u, 1.0]
    side = np.r_[0.0, 0.035, np.linspace(0.035, 1, ACROSS)[1:]]
    t = np.r_[-side[:0:-1], side]
    U, T = np.meshgrid(u, t, indexing="ij")
    s = np.clip(U + SWEEP * np.abs(T) ** 0.85, 0, 1)
    half = 0.27 * np.sin(np.pi * s**0.8) ** 0.9 * (1 - 0.25 * s)
    between = np.mod((U - at[0]) / gap, 1.0)
    z = 0.30 * np.abs(T) * half - 0.30 * s * s + 0.02 * np.sin(9 * s) * T * T
    z += 0.035 * half / 0.27 * np.sin(np.pi * between) ** 2 * np.abs(T) * (1.2 - np.abs(T))
    p = np.stack([s, half * T, z], axis=-1).reshape(-1, 3) * size + np.array([0.05, 0, 0])
    c, d = np.cos(rise), np.sin(rise)
    p = p @ np.array([[c, 0, d], [0, 1, 0], [-d, 0, c]])
    c, d = np.cos(turn), np.sin(turn)
    p = p @ np.array([[c, d, 0], [-d, c, 0], [0, 0, 1]]) + base
    stalk = _tube(0, np.linspace(base, p[len(t) // 2], 3), np.array([0.009, 0.008, 0.006]))
    n, m = len(u), len(t)
    corner = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    faces = np.stack([[corner, corner + m, corner + 1], [corner + 1, corner + m, corner + m + 1]]).transpose(2, 0, 1)
    left, vein = 0.5 * (t[1:] + t[:-1]), np.isin(u[:-1], at)
    kind = np.where(vein[:, None], midrib + np.sign(left)[None, :].astype(int), 1)
    kind = np.where(np.abs(left) < 0.035, midrib, kind).ravel()
    rows = surfaces.mesh(0, p, faces.reshape(-1, 3))
    rows[:, 0] = np.repeat(kind, 2)
    return np.concatenate([stalk, rows])


def _tube(material: int, points: np.ndarray, radius: np.ndarray, sides: int = 8) -> np.ndarray:
    """Triangles of a tube around a line of points that runs mostly along x."""
    a = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.zeros(sides), np.cos(a), np.sin(a)], axis=-1)
    p = (points[:, None] + radius[:, None, None] * ring).reshape(-1, 3)
    k, j = np.meshgrid(np.arange(len(points) - 1), np.arange(sides), indexing="ij")
    near, far = (k * sides + j).ravel(), (k * sides + (j + 1) % sides).ravel()
    faces = np.concatenate([np.stack([near, near + sides, far], 1), np.stack([far, near + sides, far + sides], 1)])
    return surfaces.mesh(material, p, faces)
