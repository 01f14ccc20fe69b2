"""What stands about in a world, as Blender objects: desk, lamps, clutter, the grasped object, the chessboard."""

from __future__ import annotations

from typing import Any, Final

import bpy  # type: ignore[import-not-found]
import numpy as np
from mathutils import Matrix, Vector  # type: ignore[import-not-found]

from rhot.arrays import FloatArray
from worlds.blender import materials
from worlds.contact import EDGE_MM, Solid
from worlds.look import Colour, Look
from worlds.world import BOARD

UNIT: Final = 0.01
"""Blender units a millimetre."""
_LAMP_POWER: Final = 3000.0
_DESK_MM: Final = (3000.0, 3000.0, 20.0)
_BOARD_MARGIN: Final = 0.45
"""White margin of the chessboard in squares."""


def matrix(pose: FloatArray) -> Matrix:
    """Return a pose (4, 4) in mm in Blender's units."""
    scaled = np.array(pose, float)
    scaled[:3, 3] *= UNIT
    return Matrix(scaled.tolist())


def new_object(name: str, data: Any) -> Any:
    """Return a new object of the scene."""
    thing = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(thing)
    return thing


def shade_smooth(mesh: Any) -> None:
    """Interpolate a mesh's normals across its faces."""
    mesh.polygons.foreach_set("use_smooth", np.ones(len(mesh.polygons), bool))


def box(name: str, size: FloatArray, material: Any, edge_mm: float = 0.0) -> Any:
    """Return a box about its centre; size (3,) and radius of its edges in mm."""
    signs = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)])
    faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata((signs * np.asarray(size) / 2 * UNIT).tolist(), [], faces)
    mesh.materials.append(material)
    thing = new_object(name, mesh)
    if edge_mm:
        _round_edges(thing, edge_mm)
    return thing


def furnish(look: Look) -> None:
    """Put desk, lamps, the room's light and clutter into the scene."""
    room = bpy.data.worlds.new("room")
    room.use_nodes = True
    background = room.node_tree.nodes["Background"]
    background.inputs["Color"].default_value = (*look.ambient[0], 1.0)
    background.inputs["Strength"].default_value = look.ambient[1]
    bpy.context.scene.world = room
    desk = box("desk", np.array(_DESK_MM), materials.desk(*look.desk))
    desk.location.z = -0.5 * _DESK_MM[2] * UNIT
    for place, lamp in enumerate(look.lamps):
        light = bpy.data.lights.new(f"lamp {place}", "AREA")
        light.shape, light.size = "DISK", lamp.size_mm * UNIT
        light.energy, light.color = _LAMP_POWER * lamp.power, lamp.colour
        thing = new_object(light.name, light)
        thing.location = lamp.position * UNIT
        thing.rotation_mode = "QUATERNION"
        thing.rotation_quaternion = Vector(lamp.aim - lamp.position).to_track_quat("-Z", "Y")
    for place, item in enumerate(look.things):
        finish = materials.plain(f"thing {place}", item.colour, 0.3 if item.metallic else 0.6, float(item.metallic))
        thing = box(f"thing {place}", np.array(item.size), finish, min(1.5, 0.4 * item.size[2]))
        thing.location = np.array([*item.centre, item.size[2] / 2]) * UNIT
        thing.rotation_euler.z = np.radians(item.turn_deg)


def grasped(solid: Solid, colour: Colour) -> Any:
    """Return the object of `G2` about its centre."""
    material = materials.plain("object", colour, 0.4)
    if solid.kind == "box":
        thing = box("object", 2 * solid.half, material, EDGE_MM)
    elif solid.barred:
        corners, quads = solid.surface()
        mesh = bpy.data.meshes.new("object")
        mesh.from_pydata((corners * UNIT).tolist(), [], quads.tolist())
        mesh.materials.append(material)
        shade_smooth(mesh)
        thing = new_object("object", mesh)
    else:
        radius, height = solid.half[0] * UNIT, 2 * solid.half[2] * UNIT
        if solid.kind == "ball":
            bpy.ops.mesh.primitive_uv_sphere_add(radius=radius, segments=64, ring_count=32)
        else:
            bpy.ops.mesh.primitive_cylinder_add(radius=radius, depth=height, vertices=96)
        thing = bpy.context.object
        thing.data.materials.append(material)
        if solid.kind == "cylinder":
            _round_edges(thing, EDGE_MM)
        else:
            shade_smooth(thing.data)
    thing.rotation_mode = "QUATERNION"
    return thing


def chessboard() -> Any:
    """Return the board of `C`: a flat sheet in its own x and y, origin the middle of the corner grid."""
    columns, rows, square = BOARD
    lines = []
    for count in (columns, rows):
        at = (np.arange(-1, count + 1) - (count - 1) / 2) * square
        margin = _BOARD_MARGIN * square
        lines.append(np.concatenate([[at[0] - margin], at, [at[-1] + margin]]))
    xs, ys = lines
    faces, black, wide = [], [], len(xs)
    for j in range(len(ys) - 1):
        for i in range(wide - 1):
            faces.append((j * wide + i, j * wide + i + 1, (j + 1) * wide + i + 1, (j + 1) * wide + i))
            black.append(0 < i < wide - 2 and 0 < j < len(ys) - 2 and (i + j) % 2 == 0)
    mesh = bpy.data.meshes.new("board")
    mesh.from_pydata([(x * UNIT, y * UNIT, 0.0) for y in ys for x in xs], [], faces)
    mesh.materials.append(materials.plain("white", (0.75, 0.75, 0.75), 0.7, speckle=0.01))
    mesh.materials.append(materials.plain("black", (0.03, 0.03, 0.03), 0.7, speckle=0.01))
    mesh.polygons.foreach_set("material_index", np.array(black, np.int32))
    mesh.update()
    return new_object("board", mesh)


def _round_edges(thing: Any, edge_mm: float) -> None:
    bevel = thing.modifiers.new("edge", "BEVEL")
    bevel.width, bevel.segments = edge_mm * UNIT, 3
