"""Geometry and materials of the showcase: signed distance functions (negative inside), scene units, z up.

The distance functions of the primitives are the textbook ones (Hart 1996, *Sphere tracing*). Every object stands on a
round checker base whose top is the plane z = FLOOR.
"""

import math

from data_synth.jit import jit

FLOOR = -0.55
BASE_RADIUS = 1.3
N_PEARLS = 18
SPHERE, TORUS, BOX, BLOB, COLUMN, PEARL, BASE = range(7)


@jit
def rounded_box(x, y, z, hx, hy, hz, r):
    """Box with half sizes hx, hy, hz whose edges are rounded with radius r."""
    qx, qy, qz = abs(x) - hx + r, abs(y) - hy + r, abs(z) - hz + r
    ax, ay, az = max(qx, 0.0), max(qy, 0.0), max(qz, 0.0)
    return math.sqrt(ax * ax + ay * ay + az * az) + min(max(qx, qy, qz), 0.0) - r


@jit
def disc(x, y, z, radius, half_height, r):
    """Upright cylinder around the z axis with rounded rims."""
    qx, qz = math.sqrt(x * x + y * y) - radius + r, abs(z) - half_height + r
    ax, az = max(qx, 0.0), max(qz, 0.0)
    return math.sqrt(ax * ax + az * az) + min(max(qx, qz), 0.0) - r


@jit
def sphere(x, y, z, r):
    return math.sqrt(x * x + y * y + z * z) - r


@jit
def torus(x, y, z, major, minor):
    """Ring around the y axis."""
    q = math.sqrt(x * x + z * z) - major
    return math.sqrt(q * q + y * y) - minor


@jit
def smooth_min(a, b, k):
    """Minimum with a quadratic fillet of width k."""
    h = max(k - abs(a - b), 0.0) / k
    return min(a, b) - 0.25 * h * h * k


@jit
def blob(x, y, z):
    """Four balls melted into one another."""
    d = sphere(x + 0.02, y - 0.02, z - 0.20, 0.21)
    d = smooth_min(d, sphere(x - 0.17, y - 0.12, z - 0.34, 0.13), 0.14)
    d = smooth_min(d, sphere(x + 0.18, y - 0.06, z - 0.42, 0.12), 0.14)
    return smooth_min(d, sphere(x - 0.02, y + 0.02, z - 0.57, 0.10), 0.16)


@jit
def column(x, y, z):
    """Square column, twisted about its axis and tapered. Twisting stretches space: 0.75 keeps the bound safe."""
    taper = 1.0 - 0.35 * z
    c, s = math.cos(2.6 * z), math.sin(2.6 * z)
    return 0.75 * rounded_box(c * x + s * y, c * y - s * x, z - 0.42, 0.19 * taper, 0.19 * taper, 0.42, 0.035)


@jit
def pearls(x, y, z):
    """N_PEARLS little balls on a circle near the rim of the base: one ball, repeated by rotation."""
    step = 2.0 * math.pi / N_PEARLS
    a = math.atan2(y, x)
    a -= step * math.floor(a / step + 0.5)
    r = math.sqrt(x * x + y * y)
    return sphere(r * math.cos(a) - 1.16, r * math.sin(a), z - 0.06, 0.06)


@jit
def nearest(x, y, z):
    """(distance, object) of the nearest object."""
    h = z - FLOOR
    d, which = disc(x, y, h + 0.05, BASE_RADIUS, 0.05, 0.03), BASE
    rho = math.sqrt(x * x + y * y)
    if 0.75 * (rho - 0.27) < d:  # only where the column's bounding cylinder is nearer: min() stays exact
        k = column(x, y, h)
        if k < d:
            d, which = k, COLUMN
    k = sphere(x + 0.62, y + 0.38, h - 0.32, 0.32)
    if k < d:
        d, which = k, SPHERE
    k = torus(x - 0.25, y + 0.72, h - 0.31, 0.22, 0.09)
    if k < d:
        d, which = k, TORUS
    u, v = 0.866 * (x - 0.72) + 0.5 * (y - 0.16), 0.866 * (y - 0.16) - 0.5 * (x - 0.72)
    k = rounded_box(u, v, h - 0.22, 0.22, 0.22, 0.22, 0.05)
    if k < d:
        d, which = k, BOX
    if sphere(x + 0.16, y - 0.72, h - 0.33, 0.40) < d:
        k = blob(x + 0.16, y - 0.72, h)
        if k < d:
            d, which = k, BLOB
    if math.sqrt((rho - 1.16) ** 2 + (h - 0.06) ** 2) - 0.06 < d:
        k = pearls(x, y, h)
        if k < d:
            d, which = k, PEARL
    return d, which


@jit
def distance(x, y, z):
    return nearest(x, y, z)[0]


@jit
def normal(x, y, z):
    """Unit outward normal: four samples at the corners of a tetrahedron."""
    e = 1e-5
    a = distance(x + e, y - e, z - e)
    b = distance(x - e, y - e, z + e)
    c = distance(x - e, y + e, z - e)
    d = distance(x + e, y + e, z + e)
    nx, ny, nz = a - b - c + d, -a - b + c + d, -a + b - c + d
    s = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * s, ny * s, nz * s


@jit
def hue(turns, low):
    """A colour of the wheel with channels between ``low`` and 1; turns = 0 is red, 1/3 green, 2/3 blue."""
    mid, swing, a = 0.5 * (1.0 + low), 0.5 * (1.0 - low), 2.0 * math.pi * turns
    third = 2.0 * math.pi / 3.0
    return mid + swing * math.cos(a), mid + swing * math.cos(a - third), mid + swing * math.cos(a + third)


@jit
def material(which, x, y, z):
    """Linear albedo r, g, b, strength and exponent of the gloss at a surface point."""
    h = z - FLOOR
    if which == SPHERE:
        return 0.72, 0.035, 0.045, 0.75, 40.0
    if which == TORUS:
        return 0.83, 0.50, 0.10, 0.85, 30.0
    if which == BOX:
        return 0.03, 0.22, 0.62, 0.5, 25.0
    if which == BLOB:
        t = min(max(h / 0.62, 0.0), 1.0)
        return 0.55 + 0.35 * t, 0.05 + 0.42 * t * t, 0.40 * (1.0 - t) + 0.03, 0.45, 25.0
    if which == COLUMN:
        t = 0.5 + 0.5 * math.sin(38.0 * h)
        t = t * t * (3.0 - 2.0 * t)
        return 0.78 * t + 0.05, 0.76 * t + 0.30 * (1.0 - t), 0.68 * t + 0.26 * (1.0 - t), 0.35, 25.0
    if which == PEARL:
        step = 2.0 * math.pi / N_PEARLS
        r, g, b = hue(math.floor(math.atan2(y, x) / step + 0.5) / N_PEARLS, 0.08)
        return 0.8 * r, 0.8 * g, 0.8 * b, 0.6, 30.0
    if h < -0.02 or x * x + y * y > (BASE_RADIUS - 0.045) ** 2:
        return 0.10, 0.09, 0.09, 0.3, 20.0
    if (math.floor(x / 0.26) + math.floor(y / 0.26)) % 2 == 0:
        return 0.66, 0.62, 0.55, 0.12, 20.0
    return 0.13, 0.15, 0.19, 0.12, 20.0
