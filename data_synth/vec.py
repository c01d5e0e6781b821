"""Three-vectors in kernels are tuples of three floats. Rays are pairs (o, d) with |d| = 1."""

import math

from data_synth.jit import jit

RELATIVE = 1e-9  # hits nearer than this times the size of what takes part are the surface a ray starts on


@jit
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def add(a, b):
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@jit
def sub(a, b):
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@jit
def mul(a, b):
    """Component-wise product, for colours."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@jit
def scale(s, a):
    return (s * a[0], s * a[1], s * a[2])


@jit
def neg(a):
    return (-a[0], -a[1], -a[2])


@jit
def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@jit
def unit(a):
    return scale(1.0 / math.sqrt(dot(a, a)), a)


@jit
def along(ray, t):
    """The point o + t d."""
    o, d = ray
    return (o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2])


@jit
def largest(a):
    return max(a[0], a[1], a[2])


@jit
def frame(n):
    """Two unit vectors that make a right-handed orthonormal frame with unit n (Duff et al. 2017)."""
    s = 1.0 if n[2] >= 0.0 else -1.0
    a = -1.0 / (s + n[2])
    b = n[0] * n[1] * a
    return (1.0 + s * n[0] * n[0] * a, s * b, -s * n[0]), (b, s + n[1] * n[1] * a, -n[1])


@jit
def from_frame(n, x, y, z):
    """x s + y t + z n, where (s, t, n) is the frame of n."""
    s, t = frame(n)
    return (
        x * s[0] + y * t[0] + z * n[0],
        x * s[1] + y * t[1] + z * n[1],
        x * s[2] + y * t[2] + z * n[2],
    )


@jit
def sphere_direction(n, cosine, azimuth):
    """The unit vector at an angle of given cosine from n, turned about n by the azimuth."""
    sine = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    return from_frame(n, sine * math.cos(azimuth), sine * math.sin(azimuth), cosine)


@jit
def slab(ray, lo, hi, t0, t1):
    """The part (t0, t1) of [t0, t1] in which a ray is inside an axis-aligned box, t0 > t1 if it misses."""
    o, d = ray
    for axis in range(3):
        if d[axis] == 0.0:
            if o[axis] < lo[axis] or o[axis] > hi[axis]:
                return math.inf, -math.inf
        else:
            a, b = (lo[axis] - o[axis]) / d[axis], (hi[axis] - o[axis]) / d[axis]
            t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
    return t0, t1


@jit
def bilinear(a, b, c, d, u, v):
    """Four corners, the second axis faster, at fractions u, v of the first and second axis."""
    return (a * (1.0 - v) + b * v) * (1.0 - u) + (c * (1.0 - v) + d * v) * u


@jit
def trilinear(c, u, v, w):
    """Eight corners c, the last axis fastest, at fractions u, v, w of the first, second and last axis."""
    low = (c[0] * (1.0 - w) + c[1] * w) * (1.0 - v) + (c[2] * (1.0 - w) + c[3] * w) * v
    high = (c[4] * (1.0 - w) + c[5] * w) * (1.0 - v) + (c[6] * (1.0 - w) + c[7] * w) * v
    return low * (1.0 - u) + high * u


@jit
def extent(a):
    """The largest absolute coordinate: what rounding errors of a point are relative to."""
    return max(abs(a[0]), abs(a[1]), abs(a[2]))


@jit
def mean(a):
    return (a[0] + a[1] + a[2]) / 3.0


@jit
def exp_neg(tau):
    """exp(-tau) per colour channel."""
    return (math.exp(-tau[0]), math.exp(-tau[1]), math.exp(-tau[2]))
