"""Random numbers for kernels: SplitMix64 (Steele, Lea & Flood 2014), one stream per pixel.

A stream is a one-element uint64 array that ``uniform`` advances. Streams depend on (seed, stream) alone, so a picture
is the same whatever the number of threads.
"""

import numpy as np

from data_synth.errors import InputError
from data_synth.jit import jit, kernel


@jit
def mix(z):
    """Bijective scrambling of 64 bits."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@jit
def reseed(rng, seed, stream):
    """Start ``stream`` of ``seed`` over in ``rng``."""
    rng[0] = mix(mix(np.uint64(seed) + np.uint64(0x632BE59BD9B4E019)) + np.uint64(stream))


def new_rng(seed: int, stream: int) -> np.ndarray:
    """A stream to hand to a kernel. Neither seeds nor streams are shifts of one another: both are scrambled.

    InputError for a negative seed.
    """
    if seed < 0:
        raise InputError(f"seed: expected a whole number from 0 on, got {seed}")
    rng = np.zeros(1, np.uint64)
    _start(rng, np.uint64(seed % 2**64), np.uint64(stream % 2**64))
    return rng


@kernel
def _start(rng, seed, stream):
    reseed(rng, seed, stream)


@jit
def uniform(rng):
    """A float64 in [0, 1) on the lattice of 2^-53."""
    rng[0] += np.uint64(0x9E3779B97F4A7C15)
    return (mix(rng[0]) >> np.uint64(11)) * (1.0 / 9007199254740992.0)
