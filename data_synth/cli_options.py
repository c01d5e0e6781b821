"""The options of ``nerfvol synth``."""

from __future__ import annotations

import argparse
from typing import NoReturn

from data_synth import scenes
from data_synth.errors import InputError


class _Parser(argparse.ArgumentParser):
    """argparse whose complaints are one sentence."""

    def error(self, message: str) -> NoReturn:
        raise InputError(message)


def parser(details: str = "") -> argparse.ArgumentParser:
    """The options of ``synth``."""
    p = _Parser(
        prog="nerfvol synth",
        description="Render a scene with a known truth to posed images in the NeRF-synthetic layout.",
        epilog=details or "nerfvol synth SCENE --help tells the parameters of a scene.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    what = "a scene by name, a scene file (.yaml), 'list' for all scenes, or 'bench' [one|sky|...]"
    p.add_argument("scene", metavar="SCENE", help=what)
    p.add_argument("--out", metavar="DIR", help="folder to write (made if it is not there)")
    p.add_argument(
        "--picture", metavar="FILE", help="instead: one portrait of the scene, .jpg or .png, framed and exposed"
    )
    p.add_argument("--from", dest="place", metavar="AZIMUTH,ELEVATION", help="with --picture: degrees from where it is seen, "
                   "by default from 305 and the middle of the scene's own viewpoints")  # fmt: skip
    p.add_argument(
        "--views", type=int, default=60, metavar="N", help="training views; val and test are added (default 60)"
    )
    p.add_argument("--size", default="400x400", metavar="WxH", help="pixels of every view (default 400x400)")
    p.add_argument("--fov", type=float, metavar="DEGREES", help="horizontal field of view instead of the scene's own")
    p.add_argument("--exposure", type=float, metavar="X", help="factor of colours on their way to 8 bits")
    p.add_argument("--seed", type=int, default=0, metavar="N", help="of camera places and of Monte Carlo (default 0)")
    p.add_argument("--integrator", metavar="NAME", help="how to render; by default the scene's own choice")
    p.add_argument("--spp", type=int, metavar="N", help="path: samples per pixel")
    p.add_argument("--max-depth", type=int, metavar="N", help="path: most scattering events (default: no limit)")
    p.add_argument("--step", type=float, metavar="U", help="march, deep: length of a step in scene units")
    p.add_argument("--side", type=int, metavar="N", help="march, deep: N x N rays per pixel (default 1)")
    p.add_argument("--beams", type=int, metavar="N", help="march, deep: beams that stand for a sky or lamp")
    p.add_argument("--resolution", type=int, metavar="N", help="deep: samples along the longest side of a shadow map")
    p.add_argument("--fill", metavar="HOW", help="deep: sweep, eager or lazy")
    p.add_argument(
        "--rain", type=float, metavar="R", help="preview: optical depths of a raining cloud count R-fold (default 2)"
    )
    p.add_argument(
        "--shading", metavar="HOW", help="raycast: none, lambert or phong, by the gradient, with a lamp at the eye"
    )
    p.add_argument("--gradient", type=float, metavar="X", help="raycast: opacity grows with the gradient, and is full where a "
                   "value changes by X of its range from voxel to voxel")  # fmt: skip
    lights = ", ".join(scenes.LIGHTS)
    p.add_argument("--light", metavar="NAME,...", help=f"lights instead of the scene's own: {lights}")
    p.add_argument("--suns", type=int, default=0, metavar="N", help="for relighting: each view under one of N suns, test views "
                   "under others; lights.json tells them all")  # fmt: skip
    p.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a parameter of the scene")
    p.add_argument(
        "--volume",
        metavar="FILE",
        help="a density volume (.vdb, .nvdb, .vdb:GRID, .npz, .raw, .nrrd, .nii, .mhd) for scenes that take one",
    )
    p.add_argument(
        "--denoise", action="store_true", help="with --picture: without noise, by Open Image Denoise (an extra)"
    )
    p.add_argument("--exr", action="store_true", help="also write linear float EXR files")
    p.add_argument("--frames", metavar="A-B[/S]", help="only these of all views (training, validation, test, from 0), and of "
                   "these those that are not there yet: many processes can share a folder")  # fmt: skip
    return p
