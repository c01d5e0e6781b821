"""Gaussian splats: what a scene of them is, and how the kernels keep it."""

from nerfvol.splats.splats import MODES, Splats, concatenate

__all__ = ["MODES", "Splats", "concatenate"]
