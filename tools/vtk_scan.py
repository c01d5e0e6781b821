"""``raycast`` beside VTK's ray caster for CPUs, in turns: the phantom's head, 256^3, a step of one cell, one ray a pixel.

    pip install vtk; python tools/vtk_scan.py [SIZE] [THREADS]

VTK classifies after interpolation at points a step apart, as ``raycast`` does at midpoints. CPU seconds are of all threads.
"""

from __future__ import annotations

import sys
import time
from typing import Any

import numpy as np

from data_synth import integrators, raycast
from data_synth.cameras import Camera
from data_synth.jit import use_threads
from data_synth.scenes.volumes import TISSUE, _head, phantom

N, SIGMA, TOP = 256, 40.0, 4095  # samples along each side, 1/u at opacity 1, the largest value that VTK is given


def vtk_window(values: np.ndarray, camera: Camera, step: float, threads: int) -> Any:
    """A window of VTK that shows ``values`` in the box -1..1 as ``camera`` sees them."""
    import vtk  # pyright: ignore[reportMissingImports]  # for this alone
    from vtk.util import numpy_support  # pyright: ignore[reportMissingImports]

    image = vtk.vtkImageData()
    image.SetDimensions(N, N, N)
    image.SetOrigin(-1, -1, -1)
    image.SetSpacing(*[2 / (N - 1)] * 3)
    scalars = np.rint(values * TOP).astype(np.uint16).transpose(2, 1, 0).ravel()
    image.GetPointData().SetScalars(numpy_support.numpy_to_vtk(scalars, deep=True, array_type=vtk.VTK_UNSIGNED_SHORT))
    opacity, colour, look = vtk.vtkPiecewiseFunction(), vtk.vtkColorTransferFunction(), vtk.vtkVolumeProperty()
    for v in np.linspace(0, 1, raycast.FINE):
        opacity.AddPoint(v * TOP, 1 - np.exp(-SIGMA * step * np.interp(v, TISSUE[:, 0], TISSUE[:, 1])))
    for point in TISSUE:
        colour.AddRGBPoint(point[0] * TOP, *point[2:])
    look.SetScalarOpacity(opacity)
    look.SetColor(colour)
    look.SetInterpolationTypeToLinear()
    look.SetScalarOpacityUnitDistance(step)
    look.ShadeOff()
    mapper = vtk.vtkFixedPointVolumeRayCastMapper()
    mapper.SetInputData(image)
    mapper.SetSampleDistance(step)
    mapper.SetAutoAdjustSampleDistances(0)
    mapper.SetNumberOfThreads(threads)
    volume, renderer, window = vtk.vtkVolume(), vtk.vtkRenderer(), vtk.vtkRenderWindow()
    volume.SetMapper(mapper)
    volume.SetProperty(look)
    renderer.AddVolume(volume)
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(camera.width, camera.height)
    window.AddRenderer(renderer)
    eye, pose = renderer.GetActiveCamera(), camera.c2w
    eye.SetPosition(*pose[:3, 3])
    eye.SetFocalPoint(*(pose[:3, 3] - pose[:3, 2]))
    eye.SetViewUp(*pose[:3, 1])
    eye.SetViewAngle(np.degrees(2 * np.arctan(0.5 * camera.height / camera.focal)))
    eye.SetClippingRange(0.1, 20)
    return window


def shown(window: Any) -> np.ndarray:
    """(H, W, 3) in [0, 1] of what a window shows."""
    import vtk  # pyright: ignore[reportMissingImports]  # for this alone
    from vtk.util import numpy_support  # pyright: ignore[reportMissingImports]

    grab = vtk.vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.ReadFrontBufferOff()
    grab.Update()
    width, height = window.GetSize()
    return (
        numpy_support.vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars()).reshape(height, width, 3)[::-1] / 255
    )


def main(size: int = 800, threads: int = 2) -> None:
    """Print medians of three, and how alike the pictures are."""
    use_threads(threads)
    values, scene = np.ascontiguousarray(_head(N), np.float32), phantom(resolution=16)
    scene.classified = raycast.classified(values, (-1,) * 3, (1,) * 3, TISSUE, SIGMA)
    camera = scene.viewpoints.camera(-50.0, 20.0, size, size)
    window = vtk_window(values, camera, scene.classified.values.step, threads)
    ours = {"midpoints": integrators.RayCast(integrated=False), "pre-integrated": integrators.RayCast()}
    ways = {"VTK": window.Render} | {name: lambda i=i: i.render(scene, camera) for name, i in ours.items()}
    for way in ways.values():
        way()
    taken = {name: [] for name in ways}
    for _ in range(3):
        for name, way in ways.items():
            window.GetRenderers().GetFirstRenderer().GetActiveCamera().Azimuth(1e-7)
            began = time.process_time()
            way()
            taken[name].append(time.process_time() - began)
    theirs = shown(window)
    for name, seconds in taken.items():
        error = np.clip(ours[name].render(scene, camera).rgb, 0, 1) - theirs if name in ours else np.zeros(1)
        alike = f"{-10 * np.log10(np.mean(error**2)):.1f} dB from VTK" if name in ours else ""
        print(f"{name:15s} {np.median(seconds):6.3f} CPU s  {alike}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
