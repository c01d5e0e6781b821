"""What a smooth boundary mirrors: Fresnel's equations for unpolarised light, exact and by Schlick's approximation."""

import math

from data_synth.jit import jit


@jit
def reflectance(cosine, eta, k):
    """Of a boundary to a medium of index eta + i k, from one of index 1; k = 0 is a dielectric, total reflection included.

    cosine >= 0: of the angle to the normal. eta, k: relative to the side the light comes from (Born & Wolf, 14.2).
    """
    c2 = cosine * cosine
    s2 = 1.0 - c2
    t0 = eta * eta - k * k - s2
    both = math.sqrt(t0 * t0 + 4.0 * eta * eta * k * k)
    a = math.sqrt(max(0.5 * (both + t0), 0.0))
    across = (both + c2 - 2.0 * a * cosine) / (both + c2 + 2.0 * a * cosine)
    parallel = across * (c2 * both + s2 * s2 - 2.0 * a * cosine * s2) / (c2 * both + s2 * s2 + 2.0 * a * cosine * s2)
    return 0.5 * (across + parallel)


@jit
def schlick(cosine, straight):
    """[Schlick 1994] ``straight``, the reflectance at normal incidence, rising to 1 at grazing incidence."""
    return straight + (1.0 - straight) * (1.0 - cosine) ** 5
