"""What compiled code reads of a medium (``media.py``) at a point."""

from __future__ import annotations

import math

from data_synth import detail as details
from data_synth import phase as phases
from data_synth.fields import cell_at, colour, matrix, mixed
from data_synth.functions import bounded
from data_synth.jit import inlined, jit
from data_synth.media import EXPONENTIAL, FUNCTION, GRID
from data_synth.vec import slab


@inlined
def interpolated(m, values, p):
    """Interpolate brick samples ``values`` at p, 0 outside the stored bricks."""
    return mixed(values, 1, 0, cell_at(m, p))


@jit
def vertex(m, i, j, k, finer):
    """Vertex (i, j, k) of the grid with ``finer`` cells along each side of one of the medium's."""
    return (m.lo[0] + i * m.cell[0] / finer, m.lo[1] + j * m.cell[1] / finer, m.lo[2] + k * m.cell[2] / finer)


@inlined
def density(m, p):
    """rho at a point inside the box."""
    if m.kind == GRID:
        rho = interpolated(m, m.samples, p)
        if m.detail.octaves > 0:
            x, y, z = (p[0] - m.lo[0]) / m.cell[0], (p[1] - m.lo[1]) / m.cell[1], (p[2] - m.lo[2]) / m.cell[2]
            return details.eroded(m.detail, rho, x / m.cells[0], y / m.cells[1], z / m.cells[2])
        return rho
    if m.kind == EXPONENTIAL:
        return math.exp(-(p[2] - m.base) * m.falloff)
    if m.kind == FUNCTION:
        return bounded(m, p)
    return 1.0


@inlined
def attribute(m, p):
    """The attribute at a point, 0 for media that have none."""
    return interpolated(m, m.attributes, p) if m.attributes.size > 1 else 0.0


@jit
def phase_at(m, p):
    """The phase function at a point: the medium's own, or with the g or S that a grid has there."""
    c = m.columns
    if c.g >= 0:
        return phases.with_g(m.phase, mixed(m.fields, c.width, c.g, cell_at(m, p)))
    if c.S >= 0:
        return phases.with_S(m.phase, matrix(m, cell_at(m, p)))
    return m.phase


@inlined
def albedo_at(m, p, a):
    """RGB albedo at a point with attribute a."""
    c = m.columns
    return colour(m, c.albedo, c.albedo_step, cell_at(m, p)) if c.albedo >= 0 else lookup(m.albedo, a)


@inlined
def Le_at(m, p, a):
    """RGB emitted radiance at a point with attribute a."""
    c = m.columns
    return colour(m, c.Le, c.Le_step, cell_at(m, p)) if c.Le >= 0 else lookup(m.Le, a)


@inlined
def extinction(m, p, d):
    """rho at p, times the projected area of microflakes towards d: sigma_t(x, d) / sigma_t."""
    rho = density(m, p)
    if m.phase.kind >= phases.SGGX_SPECULAR and rho > 0.0:
        rho *= phases.projected_area(phase_at(m, p), attribute(m, p), d)
    return rho


@inlined
def at_value(table, a, c):
    """Column c of a table over [0, 1] at a, linear in between."""
    n = table.shape[0]
    if n == 1:
        return table[0, c]
    x = min(max(a, 0.0), 1.0) * (n - 1)
    i = min(int(x), n - 2)
    return table[i, c] + (x - i) * (table[i + 1, c] - table[i, c])


@inlined
def lookup(table, a):
    """Row of a (K, 3) table over [0, 1] at a."""
    return (at_value(table, a, 0), at_value(table, a, 1), at_value(table, a, 2))


@jit
def box_interval(ray, lo, hi):
    """(t0, t1) of a ray inside a box with t0 >= 0; t0 > t1 if it misses."""
    return slab(ray, lo, hi, 0.0, math.inf)
