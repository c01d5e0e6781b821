"""Boundaries in the path tracer: a path through glass, smooth or rough, and the light that rough glass shows.

A smooth boundary mirrors with the chance F or refracts, and only paths find the light behind it. A rough one scatters with a
density (``rough.py``), so that lights are sampled there as well.
"""

from data_synth import materials, rough
from data_synth.jit import jit
from data_synth.lights import sample_light
from data_synth.materials import DIELECTRIC
from data_synth.rng import uniform
from data_synth.vec import add, dot, largest, mul, neg, scale, unit
from data_synth.world import RANDOM, crossing, index_at, visible


@jit
def through_glass(w, material, n, wo, inside, rng):
    """(direction, ``inside``, weight, whether it was bent, pdf) behind a null or dielectric boundary, mirrored by chance. The
    density of the direction is 0 where it is a delta."""
    row, tint = w.materials.rows[material], materials.tint_of(w.materials.rows[material])
    behind = crossing(row, inside, dot(wo, n) > 0.0)
    if row[0] != DIELECTRIC:
        return neg(wo), behind, (1.0, 1.0, 1.0), False, 0.0
    here, there = index_at(w, inside), index_at(w, behind)
    if here == there:
        return neg(wo), behind, tint, False, 0.0
    if row[8] > 0.0:
        local, weight, pdf, through = rough.sample(row[8], here / there, materials.to_local(n, wo), rng)
        s, t = materials.spongecake_frame(n)
        wi = unit(add(add(scale(local[0], s), scale(local[1], t)), scale(local[2], n)))
        if through:
            return wi, behind, scale(weight, tint), True, pdf
        return wi, inside, (weight, weight, weight), True, pdf
    wi, reflectance = materials.refracted(n, wo, here / there)
    if uniform(rng) < reflectance:
        return materials.mirrored(n, wo), inside, (1.0, 1.0, 1.0), True, 0.0
    return wi, behind, tint, True, 0.0


@jit
def at_rough_glass(w, v, inside, beta, rng):
    """``next_event`` for a rough boundary: light from either side."""
    row = w.materials.rows[v.material]
    behind = crossing(row, inside, dot(v.wo, v.n) > 0.0)
    here, there = index_at(w, inside), index_at(w, behind)
    if here == there:
        return (0.0, 0.0, 0.0)
    count = w.lights.shape[0]
    k = min(int(uniform(rng) * count), count - 1)
    wi, distance, radiance, pdf = sample_light(w.lights, k, v.p, rng)
    local = materials.to_local(v.n, v.wo), materials.to_local(v.n, wi)
    value, pdf_other, through = rough.parts(row[8], here / there, local[0], local[1])
    weight = scale(value, beta)
    if through:
        weight = mul(weight, materials.tint_of(row))
    contribution = mul(weight, radiance)
    if largest(contribution) <= 0.0:
        return (0.0, 0.0, 0.0)
    mis = float(count)
    if pdf > 0.0:
        mis *= pdf / (pdf + count * pdf_other)
    side = behind if through else inside
    return scale(mis, mul(contribution, visible(w, (v.p, wi), distance * (1.0 - 1e-9), side, RANDOM, rng)))
