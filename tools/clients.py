"""Opens exports in the programs they are for and says what these see: Blender (the module bpy) and VTK.

    python tools/clients.py FOLDER [--render PICTURE.png]

FOLDER holds files that ``nerfvol export`` wrote (.vdb .glb .ply .obj .htg .vti); each is opened by whichever of the two can.
Neither is a dependency: bpy has 370 MB, vtk 140 MB; ``make clients EXPORTS=FOLDER`` installs them. ``--render`` draws the .vdb,
or else the .glb, in Blender's Cycles.
"""

from __future__ import annotations

import argparse
import importlib
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np


def module(name: str) -> Any:
    """The module, or None where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def describe_with_vtk(vtk: Any, path: Path) -> str:
    """What VTK reads: cells or points, bounds and the arrays' ranges."""
    readers = {".htg": "vtkXMLHyperTreeGridReader", ".vti": "vtkXMLImageDataReader", ".ply": "vtkPLYReader",
               ".obj": "vtkOBJReader", ".glb": "vtkGLTFReader"}  # fmt: skip
    reader = getattr(vtk, readers[path.suffix])()
    reader.SetFileName(str(path))
    reader.Update()
    data = reader.GetOutputDataObject(0)
    if path.suffix == ".glb":
        geometry = vtk.vtkCompositeDataGeometryFilter()
        geometry.SetInputDataObject(data)
        geometry.Update()
        data = geometry.GetOutput()
    arrays = data.GetCellData() if path.suffix == ".htg" else data.GetPointData()
    ranges = []
    for i in range(arrays.GetNumberOfArrays()):
        array = arrays.GetArray(i)
        if array is not None:
            low, high = array.GetRange(-1)
            ranges.append(f"{array.GetName()} {low:.3g} to {high:.3g}")
    bounds = [0.0] * 6
    data.GetBounds(bounds)
    box = ", ".join(f"{b:.3f}" for b in bounds)
    count = data.GetNumberOfLeaves() if path.suffix == ".htg" else data.GetNumberOfPoints()
    return f"{count} {'leaves' if path.suffix == '.htg' else 'points'}, bounds {box}; {'; '.join(ranges)}"


def describe_with_blender(bpy: Any, path: Path) -> str:
    """What Blender imports: vertices and dimensions, or a volume's grids."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if path.suffix == ".vdb":
        volume = load_volume(bpy, path)
        grids = ", ".join(f"{grid.name} ({grid.data_type})" for grid in volume.data.grids)
        corners = corners_of(bpy, volume)
        return f"volume, {corners.min(axis=0).round(3)} to {corners.max(axis=0).round(3)}; grids {grids}"
    {".glb": lambda p: bpy.ops.import_scene.gltf(filepath=p), ".ply": lambda p: bpy.ops.wm.ply_import(filepath=p),
     ".obj": lambda p: bpy.ops.wm.obj_import(filepath=p)}[path.suffix](str(path))  # fmt: skip
    item = next(o for o in bpy.context.scene.objects if o.type == "MESH")
    corners = np.array([item.matrix_world @ v.co for v in item.data.vertices])
    low, high = corners.min(axis=0), corners.max(axis=0)
    colours = item.data.color_attributes
    mean = "no colours"
    if len(colours):
        values = np.empty(4 * len(colours[0].data), np.float32)
        colours[0].data.foreach_get("color", values)
        mean = f"linear colours {values.reshape(-1, 4)[:, :3].mean(axis=0).round(3).tolist()} on average"
    return f"{len(item.data.vertices)} vertices, {len(item.data.polygons)} faces, {low.round(3)} to {high.round(3)}; {mean}"


def load_volume(bpy: Any, path: Path) -> Any:
    """The volume object of a .vdb, loaded."""
    data = bpy.data.volumes.new("scene")
    data.filepath = str(path.resolve())
    item = bpy.data.objects.new("scene", data)
    bpy.context.scene.collection.objects.link(item)
    data.grids.load()
    bpy.context.view_layer.update()
    return item


def corners_of(bpy: Any, item: Any) -> np.ndarray:
    """(8, 3) of the box around an object as Blender evaluates it."""
    whole = item.evaluated_get(bpy.context.evaluated_depsgraph_get())
    matrix = np.array(item.matrix_world)
    return np.array([tuple(c) for c in whole.bound_box]) @ matrix[:3, :3].T + matrix[:3, 3]


def volume_material(bpy: Any) -> Any:
    """Six nodes of our emission-absorption integral: black absorption of ``density``, emission of ``color`` x ``density``."""
    material = bpy.data.materials.new("nerfvol")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    make = lambda kind: tree.nodes.new(kind)  # noqa: E731
    density, color = make("ShaderNodeAttribute"), make("ShaderNodeAttribute")
    density.attribute_name, color.attribute_name = "density", "color"
    absorption, emission, both, output = (
        make(f"ShaderNode{kind}") for kind in ("VolumeAbsorption", "Emission", "AddShader", "OutputMaterial")
    )
    absorption.inputs["Color"].default_value = (0, 0, 0, 1)
    links = (
        (density.outputs["Fac"], absorption.inputs["Density"]), (density.outputs["Fac"], emission.inputs["Strength"]),
        (color.outputs["Color"], emission.inputs["Color"]), (absorption.outputs[0], both.inputs[0]),
        (emission.outputs[0], both.inputs[1]), (both.outputs[0], output.inputs["Volume"]),
    )  # fmt: skip
    for a, b in links:
        tree.links.new(a, b)
    return material


def render(bpy: Any, path: Path, picture: Path, side: int, samples: int) -> None:
    """Draws a .vdb or .glb from above one corner, on white, through Cycles with the view transform Standard."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    if path.suffix == ".vdb":
        item = load_volume(bpy, path)
        item.data.materials.append(volume_material(bpy))
    else:
        bpy.ops.import_scene.gltf(filepath=str(path))
        item = next(o for o in scene.objects if o.type == "MESH")
    mathutils = importlib.import_module("mathutils")  # Blender's own

    corners = corners_of(bpy, item)
    middle, reach = corners.mean(axis=0), float(np.linalg.norm(np.ptp(corners, axis=0))) / 2
    lens = bpy.data.cameras.new("camera")
    lens.angle = math.radians(40)
    lens.clip_end = 100 * reach
    camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(camera)
    away = np.array([-0.62, -0.62, 0.48]) * reach / math.sin(math.radians(20)) * 0.85
    camera.location = middle + away
    camera.rotation_euler = mathutils.Vector(-away).to_track_quat("-Z", "Y").to_euler()
    scene.camera = camera
    scene.world = bpy.data.worlds.new("white")
    scene.world.use_nodes = True
    background = next(n for n in scene.world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Color"].default_value = (1, 1, 1, 1)
    scene.render.engine, scene.cycles.samples, scene.cycles.device = "CYCLES", samples, "CPU"
    scene.cycles.volume_step_rate = 0.5
    scene.render.resolution_x = scene.render.resolution_y = side
    scene.view_settings.view_transform = "Standard"
    scene.render.filepath = str(picture.resolve())
    bpy.ops.render.render(write_still=True)


def main() -> int:
    """Prints a line for each file and client; 1 where a client could not open one."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--render", type=Path)
    parser.add_argument("--side", type=int, default=200)
    parser.add_argument("--samples", type=int, default=32)
    given = parser.parse_args()
    vtk, bpy = module("vtk"), module("bpy")
    for name, found in (("vtk", vtk), ("bpy", bpy)):
        if found is None:
            print(f"{name} is not installed: what it opens is not looked at")
    clients = ((vtk, describe_with_vtk, (".htg", ".vti", ".ply", ".obj", ".glb")),
               (bpy, describe_with_blender, (".vdb", ".glb", ".ply", ".obj")))  # fmt: skip
    failed = False
    for path in sorted(given.folder.iterdir()):
        for client, describe, endings in clients:
            if client is None or path.suffix not in endings:
                continue
            version = (
                f"Blender {client.app.version_string}"
                if describe is describe_with_blender
                else f"VTK {client.VTK_VERSION}"
            )
            try:
                print(f"{path.name}: {version}: {describe(client, path)}")
            except Exception as error:  # whatever the client throws is the finding
                failed = True
                print(f"{path.name}: {version}: FAILED: {error}")
    if given.render and bpy is not None:
        chosen = sorted(given.folder.glob("*.vdb")) or sorted(given.folder.glob("*.glb"))
        render(bpy, chosen[0], given.render, given.side, given.samples)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
