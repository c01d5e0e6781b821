"""04  Emission-absorption quadrature by hand, against a closed form: docs/mathematics.md, section 1.

    python examples/04_quadrature.py

An atmosphere that thins with distance, sigma(t) = s exp(-t/h), glowing with c(t) = exp(-t/h), before a white background.
With tau = s h (1 - exp(-t/h)) as variable the integral of T sigma c is elementary.
"""

import numpy as np

s, h, far = 3.0, 0.7, 4.0
tau = s * h * -np.expm1(-far / h)
exact = -np.expm1(-tau) - (1 - (1 + tau) * np.exp(-tau)) / (s * h) + np.exp(-tau)


def pixel(n: int, place: float) -> float:
    """The colour by n segments, sampled at their start (place 0) or middle (place 1/2)."""
    deltas = np.full(n, far / n)
    t = (np.arange(n) + place) * deltas
    taus, colours = s * np.exp(-t / h) * deltas, np.exp(-t / h)
    alphas = -np.expm1(-taus)  # opacity of a segment; expm1 keeps the digits of thin ones
    trans = np.exp(-np.concatenate([[0.0], np.cumsum(taus)]))  # in front of each segment, and behind the last
    weights = trans[:-1] * alphas
    assert abs(weights.sum() + trans[-1] - 1) < 1e-12
    return float(weights @ colours + trans[-1] * 1.0)


print(f"closed form {exact:.9f}\n\n{'segments':>8}  {'error, starts':>14}  {'error, middles':>14}")
for n in (8, 16, 32, 64, 128, 256):
    print(f"{n:8d}  {pixel(n, 0.0) - exact:14.2e}  {pixel(n, 0.5) - exact:14.2e}")
orders = [np.log2((pixel(128, place) - exact) / (pixel(256, place) - exact)) for place in (0.0, 0.5)]
print(f"\norder of convergence: {orders[0]:.2f} with starts, {orders[1]:.2f} with middles")
