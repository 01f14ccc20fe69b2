"""What moves in a recording as one animated glTF scene: metres, each at the times of its own poses.

A hand and a body are skeletons of constant bones (`rhot_tools.export.skeleton_motion`) with a skin of small bodies
around the joints and along the bones, so that every program shows them and Blender makes an armature of them. Objects,
feet and the headset are single nodes. Time 0 is the first pose of any of them.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.hull import hull_surface
from rhot.geometry.rotations import inverse, quaternion_from_rotation, rigid
from rhot.messages.tracked import BoxShape, CylinderShape, MeshShape, ObjectShape, SphereShape
from rhot_tools.export.poses import ExportedMotion
from rhot_tools.export.skeleton_motion import SkeletonMotion, skeleton_motion

# Triangles of what is drawn: bones, boxes, cylinders and balls, in metres.

_ROUND: Final = 24
"""Corners of a circle."""
_RINGS: Final = 12
_UNKNOWN_M: Final = 0.03
"""Edge of the cube that stands for a thing whose shape is not known."""


@dataclass(frozen=True, slots=True)
class Mesh:
    """A surface.

    Attributes:
        corners: (N, 3) metres.
        triangles: (M, 3) indices of corners, counter-clockwise from outside.
    """

    corners: FloatArray
    triangles: NDArray[np.int64]


def octahedron(middle: FloatArray, radius_m: float) -> Mesh:
    """Return an octahedron about a joint at `middle` (3,), metres."""
    corners = middle + radius_m * np.concatenate([np.eye(3), -np.eye(3)])
    faces = [(0, 1, 2), (1, 3, 2), (3, 4, 2), (4, 0, 2), (1, 0, 5), (3, 1, 5), (4, 3, 5), (0, 4, 5)]
    return Mesh(corners, np.array(faces))


def bone(start: FloatArray, end: FloatArray, radius_m: float) -> Mesh:
    """Return a pointed body from a joint (3,) to its child (3,), metres, widest near the start."""
    along = end - start
    length = float(np.linalg.norm(along))
    axis = along / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    first = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    ring = start + 0.2 * along + radius_m * np.stack([first, second, -first, -second])
    corners = np.concatenate([ring, start[None], end[None]])
    sides = [face for k in range(4) for face in ((4, (k + 1) % 4, k), (5, k, (k + 1) % 4))]
    return Mesh(corners, np.array(sides))


def joined(meshes: list[Mesh]) -> Mesh:
    """Return several surfaces as one."""
    starts = np.cumsum([0, *(len(mesh.corners) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.corners for mesh in meshes]), np.concatenate(triangles))


def mesh_of(shape: ObjectShape | None) -> Mesh:
    """Return the surface of an object around its middle; a small cube where the shape is not known."""
    match shape:
        case BoxShape():
            return box(np.array(shape.size))
        case CylinderShape():
            return _cylinder(shape.radius, shape.height)
        case SphereShape():
            return _sphere(shape.radius)
        case MeshShape():
            corners, triangles = hull_surface(np.array(shape.planes))
            # Planes of a stranger need not close.
            return Mesh(corners, triangles) if len(triangles) else box(np.array(shape.size))
        case _:
            return box(np.full(3, _UNKNOWN_M))


def box(size_m: FloatArray) -> Mesh:
    """Return a cuboid of edges (3,) around the origin."""
    signs = np.array([(x, y, z) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [face for a, b, c, d in quads for face in ((a, b, c), (a, c, d))]
    return Mesh(0.5 * signs * size_m, np.array(faces))


def _cylinder(radius_m: float, height_m: float) -> Mesh:
    angle = 2.0 * np.pi * np.arange(_ROUND) / _ROUND
    ring = radius_m * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(_ROUND)])
    up = np.array([0.0, 0.0, 0.5 * height_m])
    corners = np.concatenate([ring - up, ring + up, [-up, up]])
    low, high = 2 * _ROUND, 2 * _ROUND + 1
    faces = []
    for k in range(_ROUND):
        n = (k + 1) % _ROUND
        faces += [(k, n, _ROUND + n), (k, _ROUND + n, _ROUND + k), (low, n, k), (high, _ROUND + k, _ROUND + n)]
    return Mesh(corners, np.array(faces))


def _sphere(radius_m: float) -> Mesh:
    polar = np.pi * np.arange(1, _RINGS) / _RINGS
    angle = 2.0 * np.pi * np.arange(_ROUND) / _ROUND
    rings = [(np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)) for p in polar for a in angle]
    corners = radius_m * np.array([*rings, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)])
    top, bottom = len(rings), len(rings) + 1
    last = (_RINGS - 2) * _ROUND
    faces = []
    for k in range(_ROUND):
        n = (k + 1) % _ROUND
        faces += [(top, k, n), (bottom, last + n, last + k)]
        for start in range(0, last, _ROUND):
            a, b, c, d = start + k, start + n, start + _ROUND + n, start + _ROUND + k
            faces += [(a, d, c), (a, c, b)]
    return Mesh(corners, np.array(faces))


# A glTF 2.0 document in the making: one buffer, accessors into it, and the JSON around them.
#
# Format: Khronos, "glTF 2.0 Specification" (2021), sections 3.6 (buffers) and 4.4 (GLB).

_FLOAT: Final = 5126
_UNSIGNED_BYTE: Final = 5121
_UNSIGNED_SHORT: Final = 5123
_UNSIGNED_INT: Final = 5125
_COMPONENTS: Final = {"f4": _FLOAT, "u1": _UNSIGNED_BYTE, "u2": _UNSIGNED_SHORT, "u4": _UNSIGNED_INT}


class Document:
    """Collects nodes, meshes, skins and one animation.

    Attributes:
        content: the JSON, but for the buffer.
    """

    def __init__(self, generator: str) -> None:
        self.content: dict[str, Any] = {"asset": {"version": "2.0", "generator": generator}}
        self._buffer = bytearray()

    def add(self, kind: str, item: dict[str, Any]) -> int:
        """Append an item to a list of the document, such as `nodes`, and return its index."""
        items = self.content.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def accessor(self, values: NDArray[Any], shape: str, *, bounds: bool = False, target: int | None = None) -> int:
        """Append values (N,) or (N, C) to the buffer and return the index of their accessor.

        Args:
            values: float64 is stored as float32; other types must be float32 or unsigned of 8, 16 or 32 bits.
            shape: glTF's type, such as `VEC3`.
            bounds: state the least and the largest values.
            target: what a vertex buffer is for.
        """
        stored = np.ascontiguousarray(values, np.float32 if values.dtype.kind == "f" else None)
        stored = stored.astype(stored.dtype.newbyteorder("<"))
        self._buffer += bytes(-len(self._buffer) % 4)
        view = {"buffer": 0, "byteOffset": len(self._buffer), "byteLength": stored.nbytes}
        self._buffer += stored.tobytes()
        if target is not None:
            view["target"] = target
        accessor: dict[str, Any] = {
            "bufferView": self.add("bufferViews", view),
            "componentType": _COMPONENTS[stored.dtype.str[1:]],
            "count": len(stored),
            "type": shape,
        }
        if bounds:
            flat = stored.reshape(len(stored), -1).astype(np.float64)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        return self.add("accessors", accessor)

    def vertices(self, values: NDArray[Any], shape: str, *, bounds: bool = False) -> int:
        """Append what belongs to the vertices of a mesh; see `accessor`."""
        vertices = 34962
        return self.accessor(values, shape, bounds=bounds, target=vertices)

    def indices(self, values: NDArray[Any]) -> int:
        """Append the corners of triangles, (N,)."""
        indices = 34963
        return self.accessor(np.asarray(values, np.uint32).reshape(-1), "SCALAR", target=indices)

    def text(self) -> str:
        """Return the document as one JSON file, the buffer inside it."""
        data = base64.b64encode(bytes(self._buffer)).decode()
        return json.dumps(self._whole(f"data:application/octet-stream;base64,{data}"), allow_nan=False) + "\n"

    def binary(self) -> bytes:
        """Return the document as a GLB file."""
        head = json.dumps(self._whole(None), allow_nan=False).encode()
        head += b" " * (-len(head) % 4)
        body = bytes(self._buffer) + bytes(-len(self._buffer) % 4)
        json_chunk = 0x4E4F534A
        chunks = struct.pack("<II", len(head), json_chunk) + head
        if body:
            binary_chunk = 0x004E4942
            chunks += struct.pack("<II", len(body), binary_chunk) + body
        glb_magic = 0x46546C67
        return struct.pack("<III", glb_magic, 2, 12 + len(chunks)) + chunks

    def _whole(self, uri: str | None) -> dict[str, Any]:
        buffer: dict[str, Any] = {"byteLength": len(self._buffer)}
        if uri is not None:
            buffer["uri"] = uri
        return {**self.content, **({"buffers": [buffer]} if self._buffer else {})}


_COLORS: Final = {
    "hand_right": (0.85, 0.55, 0.45),
    "hand_left": (0.45, 0.55, 0.85),
    "body": (0.6, 0.6, 0.6),
}
_OTHER_COLOR: Final = (0.4, 0.7, 0.4)
_BONE_SHARE: Final = 0.6
"""A bone's radius over that of the flesh around its joint."""
_FOOT_M: Final = np.array([0.09, 0.06, 0.24])
_HEAD_M: Final = np.array([0.18, 0.1, 0.1])


def gltf_document(motions: Sequence[ExportedMotion], frame: str) -> Document:
    """Return the scene of motions.

    Args:
        motions: at least one, all in one frame.
        frame: its name, kept in the scene's `extras`.
    """
    document = Document("rhot export")
    origin_ns = min(int(motion.t_ns[0]) for motion in motions)
    animation: dict[str, Any] = {"name": "recording", "channels": [], "samplers": []}
    roots: list[int] = []
    for motion in motions:
        color = _COLORS.get(motion.name, _OTHER_COLOR)
        pbr = {"baseColorFactor": [*color, 1.0], "metallicFactor": 0.0, "roughnessFactor": 0.9}
        material = document.add("materials", {"name": motion.name, "pbrMetallicRoughness": pbr, "doubleSided": True})
        times = document.accessor(((motion.t_ns - origin_ns) / 1e9)[:, None], "SCALAR", bounds=True)
        add = _add_rigid if motion.is_rigid else _add_skeleton
        roots += add(document, motion, material, times, animation)
    document.add("animations", animation)
    document.add("scenes", {"name": "recording", "nodes": roots, "extras": {"frame": frame, "unit": "metre"}})
    document.content["scene"] = 0
    return document


def _add_rigid(
    document: Document, motion: ExportedMotion, material: int, times: int, animation: dict[str, Any]
) -> list[int]:
    if motion.name.startswith("foot_"):
        surface = box(_FOOT_M)
    else:
        surface = box(_HEAD_M) if motion.name == "head" else mesh_of(motion.shape)
    mesh = document.add("meshes", {"name": motion.name, "primitives": [_primitive(document, surface, material)]})
    xyzw = _continuous(quaternion_from_rotation(motion.rotations[:, 0]))
    positions = motion.positions[:, 0]
    node = document.add("nodes", {"name": motion.name, "mesh": mesh, **_pose(positions[0], xyzw[0])})
    _animate(document, animation, times, node, "translation", positions, "VEC3")
    _animate(document, animation, times, node, "rotation", xyzw, "VEC4")
    return [node]


def _add_skeleton(
    document: Document, motion: ExportedMotion, material: int, times: int, animation: dict[str, Any]
) -> list[int]:
    skeleton = skeleton_motion(motion)
    root = motion.root
    first = len(document.content.get("nodes", []))
    xyzw = [_continuous(quaternion_from_rotation(skeleton.local[:, joint])) for joint in range(len(motion.joints))]
    for joint, name in enumerate(motion.joints):
        offset = skeleton.root[0] if joint == root else skeleton.offsets[joint]
        children = [first + child for child, parent in enumerate(motion.parents) if parent == joint]
        node = {"name": f"{motion.name}_{name}", **_pose(offset, xyzw[joint][0])}
        document.add("nodes", node | ({"children": children} if children else {}))
        _animate(document, animation, times, first + joint, "rotation", xyzw[joint], "VEC4")
    _animate(document, animation, times, first + root, "translation", skeleton.root, "VEC3")
    bind = _first_pose(skeleton)
    matrices = np.stack([inverse(T).T.reshape(16) for T in bind])
    skin = {
        "name": motion.name,
        "joints": list(range(first, first + len(motion.joints))),
        "skeleton": first + root,
        "inverseBindMatrices": document.accessor(matrices, "MAT4"),
    }
    surface, owners = _skin_surface(motion, bind)
    primitive = _primitive(document, surface, material)
    weights = np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (len(owners), 1))
    joints = np.zeros((len(owners), 4), np.uint8)
    joints[:, 0] = owners
    primitive["attributes"] |= {
        "JOINTS_0": document.vertices(joints, "VEC4"),
        "WEIGHTS_0": document.vertices(weights, "VEC4"),
    }
    mesh = document.add("meshes", {"name": motion.name, "primitives": [primitive]})
    shown = document.add("nodes", {"name": motion.name, "mesh": mesh, "skin": document.add("skins", skin)})
    return [first + root, shown]


def _first_pose(skeleton: SkeletonMotion) -> list[FloatArray]:
    """Return the pose (4, 4) of every joint in the first frame, in the scene."""
    poses: list[FloatArray] = [np.eye(4)] * len(skeleton.joints)

    def place(joint: int, T_scene_parent: FloatArray) -> None:
        offset = skeleton.root[0] if skeleton.parents[joint] < 0 else skeleton.offsets[joint]
        poses[joint] = T_scene_parent @ rigid(skeleton.local[0, joint], offset)
        for child, parent in enumerate(skeleton.parents):
            if parent == joint:
                place(child, poses[joint])

    place(skeleton.parents.index(-1), np.eye(4))
    return poses


def _skin_surface(motion: ExportedMotion, bind: Sequence[FloatArray]) -> tuple[Mesh, FloatArray]:
    """Return what is drawn of a skeleton in its bind pose, and the joint that moves each corner."""
    parts: list[Mesh] = []
    owners: list[int] = []
    for joint, parent in enumerate(motion.parents):
        radius_m = max(float(motion.radii_m[joint]), 1e-3)
        parts.append(octahedron(bind[joint][:3, 3], 0.5 * radius_m))
        owners += [joint] * len(parts[-1].corners)
        if parent >= 0:
            parts.append(bone(bind[parent][:3, 3], bind[joint][:3, 3], _BONE_SHARE * radius_m))
            owners += [parent] * len(parts[-1].corners)
    return joined(parts), np.array(owners)


def _primitive(document: Document, surface: Mesh, material: int) -> dict[str, Any]:
    # No normals: programs then draw flat faces, as the specification asks of them.
    return {
        "attributes": {"POSITION": document.vertices(surface.corners, "VEC3", bounds=True)},
        "indices": document.indices(surface.triangles),
        "material": material,
    }


def _animate(
    document: Document, animation: dict[str, Any], times: int, node: int, path: str, values: FloatArray, shape: str
) -> None:
    output = document.accessor(values, shape)
    animation["samplers"].append({"input": times, "output": output, "interpolation": "LINEAR"})
    target = {"node": node, "path": path}
    animation["channels"].append({"sampler": len(animation["samplers"]) - 1, "target": target})


def _pose(position: FloatArray, xyzw: FloatArray) -> dict[str, Any]:
    return {"translation": position.tolist(), "rotation": xyzw.tolist()}


def _continuous(xyzw: FloatArray) -> FloatArray:
    """Return quaternions (N, 4) with signs such that neighbours lie near each other."""
    flips = np.where((xyzw[1:] * xyzw[:-1]).sum(axis=-1) < 0.0, -1.0, 1.0)
    signed: FloatArray = xyzw * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    signed /= np.linalg.norm(signed, axis=-1, keepdims=True)
    return signed
