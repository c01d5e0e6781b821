"""The densities of the smoke and explosion scenes, shaped out of cloud noise."""

from data_synth.jit import kernel
from data_synth.noise import texture_at


@kernel
def fill_plume(t, out, first, last):
    """A column that widens and curls as it rises: noise of noise, cut out of a cone."""
    nx, ny, nz = out.shape
    for i in range(first, last):
        for j in range(ny):
            for k in range(nz):
                x, y, z = i / (nx - 1) - 0.5, j / (ny - 1) - 0.5, k / (nz - 1)
                bend = 0.16 * z
                wx = texture_at(t, 0.7 * x + 0.1, 0.7 * y, 0.55 * z - 0.1, 0) - 0.55
                wy = texture_at(t, 0.7 * x + 0.5, 0.7 * y + 0.3, 0.55 * z + 0.2, 0) - 0.55
                px, py = x + 1.3 * bend * wx, y + 1.3 * bend * wy
                radius = 0.07 + 0.30 * z**0.8
                r = (px * px + py * py) ** 0.5 / radius
                billow = texture_at(t, 1.1 * px, 1.1 * py, 0.9 * z, 1)
                billow += 0.5 * texture_at(t, 2.3 * px, 2.3 * py, 2.0 * z, 2)
                edge = 1.35 * billow + 0.42 - r
                fade = min(1.0, 12.0 * z) * min(1.0, 5.0 * (1.0 - z))
                out[i, j, k] = min(max(2.2 * edge, 0.0), 1.0) * fade * (1.0 - 0.65 * z)


@kernel
def fill_fireball(t, rho, hot, first, last):
    n = rho.shape[0]
    for i in range(first, last):
        for j in range(n):
            for k in range(n):
                x, y, z = 2.0 * i / (n - 1) - 1.0, 2.0 * j / (n - 1) - 1.0, 2.0 * k / (n - 1) - 1.0
                r = (x * x + y * y + z * z) ** 0.5
                big = texture_at(t, 0.40 * x, 0.40 * y, 0.40 * z, 1)
                small = texture_at(t, 0.9 * x, 0.9 * y, 0.9 * z, 1)
                surface = 0.30 + 0.72 * big + 0.20 * small
                d = surface - r
                rho[i, j, k] = min(max(7.0 * d, 0.0), 1.0) * min(1.0, 6.0 * (1.0 - r) if r < 1.0 else 0.0)
                crack = 1.2 - 1.7 * texture_at(t, 0.35 * x + 0.3, 0.35 * y, 0.35 * z, 1)
                crack += 0.35 - 0.9 * texture_at(t, 0.9 * x, 0.9 * y + 0.4, 0.9 * z, 2)
                hot[i, j, k] = min(max(0.62 * crack - 0.30 * r - 0.2 * z - 1.5 * max(0.08 - d, 0.0) + 0.22, 0.0), 1.0)
