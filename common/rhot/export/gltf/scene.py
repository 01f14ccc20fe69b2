"""What moves in a recording as one animated glTF scene: metres, each at the times of its own poses.

A hand and a body are skeletons of constant bones (`rhot.export.skeleton_motion`) with a skin of small bodies around the
joints and along the bones, so that every program shows them and Blender makes an armature of them. Objects, feet and
the headset are single nodes. Time 0 is the first pose of any of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.export.gltf.document import Document
from rhot.export.gltf.shapes import Mesh, bone, box, joined, mesh_of, octahedron
from rhot.export.poses import Motion
from rhot.export.skeleton_motion import SkeletonMotion, skeleton_motion
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.geometry.transforms import inverse, rigid

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


def gltf_document(motions: Sequence[Motion], frame: str) -> Document:
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


def _add_rigid(document: Document, motion: Motion, material: int, times: int, animation: dict[str, Any]) -> list[int]:
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
    document: Document, motion: Motion, material: int, times: int, animation: dict[str, Any]
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


def _skin_surface(motion: Motion, bind: Sequence[FloatArray]) -> tuple[Mesh, FloatArray]:
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
