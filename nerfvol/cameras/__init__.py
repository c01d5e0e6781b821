"""Cameras, lenses, how files state them, and camera paths."""

from nerfvol.cameras.camera import Camera, Intrinsics, look_at, orbit

__all__ = ["Camera", "Intrinsics", "look_at", "orbit"]
