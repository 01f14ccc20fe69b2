"""The hand with arm, patch and sleeve as Blender objects, and their animation; needs `bpy`."""

from __future__ import annotations

from typing import Any, Final

import bpy  # type: ignore[import-not-found]
import numpy as np
from mathutils import Matrix  # type: ignore[import-not-found]

from rhot.arrays import FloatArray
from worlds.blender import materials
from worlds.blender.props import UNIT, box, matrix, new_object, shade_smooth
from worlds.hand import BONES, MARKERS, Hand, bone_poses
from worlds.look import Colour, Look
from worlds.motion import States, forearm_poses
from worlds.skin import FOREARM, FOREARM_MM, Skin

_GROUPS: Final = (*BONES, "forearm")
_MOTION_STEPS: Final = 3
"""Cycles samples moving geometry at 2^3 + 1 instants of the shutter."""
_AROUND, _RINGS = 48, 30


class Puppet:
    """The hand in the scene; `parts` are its objects."""

    def __init__(self, hand: Hand, skin: Skin, look: Look) -> None:
        """Build it."""
        self._rest = np.linalg.inv(bone_poses(hand, np.zeros((1, 20)))[0])
        self._rig = _armature()
        self.parts = [self._skinned(_skin_object(skin, look), skin.weights)]
        patch = box("patch", np.array(hand.patch), materials.patch(look.paints["base"]))
        patch.data.transform(matrix(hand.T_hand_patch))
        self.parts.append(self._rigid(patch, 0))
        if look.sleeve is not None:
            self.parts.append(self._rigid(_sleeve(hand, *look.sleeve), FOREARM))

    def animate(self, frames: FloatArray, motion: States) -> None:
        """Key the bones at Blender frames (N,)."""
        curves = {
            f'pose.bones["{name}"].': motion.bones[:, place] @ self._rest[place] for place, name in enumerate(BONES)
        }
        curves['pose.bones["forearm"].'] = forearm_poses(motion.T_world_hand)
        key(self._rig, frames, curves)

    def _rigid(self, thing: Any, bone: int) -> Any:
        weights = np.zeros((len(thing.data.vertices), len(_GROUPS)))
        weights[:, bone] = 1.0
        return self._skinned(thing, weights)

    def _skinned(self, thing: Any, weights: FloatArray) -> Any:
        for place, name in enumerate(_GROUPS):
            group = thing.vertex_groups.new(name=name)
            share = np.round(weights[:, place], 3)
            for value in np.unique(share[share > 0]):
                group.add(np.nonzero(share == value)[0].tolist(), float(value), "REPLACE")
        thing.modifiers.new("rig", "ARMATURE").object = self._rig
        blur_motion(thing)
        return thing


def blur_motion(thing: Any) -> None:
    """Let Cycles follow a thing through the shutter."""
    thing.cycles.use_motion_blur = thing.cycles.use_deform_motion = True
    thing.cycles.motion_steps = _MOTION_STEPS


def key(thing: Any, frames: FloatArray, poses: dict[str, FloatArray]) -> None:
    """Give a thing linear keys: for each prefix of a data path the poses (N, 4, 4), mm, at frames (N,)."""
    if thing.animation_data is not None:
        thing.animation_data_clear()
    action = bpy.data.actions.new(thing.name)
    slot = action.slots.new(id_type="OBJECT", name=thing.name)
    bag = action.layers.new("motion").strips.new(type="KEYFRAME").channelbag(slot, ensure=True)
    for prefix, pose in poses.items():
        quaternions = np.array([Matrix(m.tolist()).to_quaternion() for m in pose[:, :3, :3]])
        flips = np.cumprod(np.sign(np.concatenate([[1.0], (quaternions[1:] * quaternions[:-1]).sum(axis=1)])))
        columns = {"rotation_quaternion": quaternions * flips[:, None], "location": pose[:, :3, 3] * UNIT}
        for path, values in columns.items():
            for place in range(values.shape[1]):
                curve = bag.fcurves.new(prefix + path, index=place)
                curve.keyframe_points.add(len(frames))
                points = np.stack([frames, values[:, place]], axis=1).ravel()
                curve.keyframe_points.foreach_set("co", points.astype(np.float32))
                curve.keyframe_points.foreach_set("interpolation", np.ones(len(frames), np.int32))
                curve.update()
    thing.animation_data_create()
    thing.animation_data.action = action
    thing.animation_data.action_slot = slot


def _armature() -> Any:
    """Return an armature whose bones all rest at the origin, so that a bone's pose is what it does to a vertex."""
    armature = bpy.data.armatures.new("rig")
    rig = new_object("rig", armature)
    bpy.context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    for name in _GROUPS:
        bone = armature.edit_bones.new(name)
        bone.head, bone.tail, bone.roll = (0, 0, 0), (0, 1, 0), 0.0
    bpy.ops.object.mode_set(mode="OBJECT")
    for bone in rig.pose.bones:
        bone.rotation_mode = "QUATERNION"
    return rig


def _skin_object(skin: Skin, look: Look) -> Any:
    mesh = bpy.data.meshes.new("hand")
    mesh.from_pydata((skin.vertices * UNIT).tolist(), [], skin.quads.tolist())
    for place, name in enumerate(MARKERS[:5]):
        mesh.materials.append(materials.skin(look.skin, look.paints[name], place))
    mesh.materials.append(materials.skin(look.skin))
    mesh.polygons.foreach_set("material_index", np.where(skin.finger < 0, 5, skin.finger).astype(np.int32))
    shade_smooth(mesh)
    mesh.attributes.new("beyond", "FLOAT", "POINT").data.foreach_set("value", skin.beyond.astype(np.float32))
    mesh.update()
    return new_object("hand", mesh)


def _sleeve(hand: Hand, cuff_mm: float, colour: Colour) -> Any:
    """Return a tube round the forearm from the cuff to the elbow, with some folds."""
    size = hand.length_mm / 172.0
    turns = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    rings = []
    for place, y in enumerate(np.linspace(cuff_mm, FOREARM_MM, _RINGS)):
        wave = 1.0 + 0.025 * np.sin(3 * turns + 0.9 * place) * np.sin(0.7 * place)
        width, depth = (31.0 + 0.055 * y) * size * wave, (25.0 + 0.055 * y) * size * wave
        rings.append(np.stack([width * np.cos(turns) - 2, np.full(_AROUND, -y), depth * np.sin(turns) + 2], 1))
    faces = [
        tuple(_AROUND * ring + step for ring, step in ((r, i), (r, after), (r + 1, after), (r + 1, i)))
        for r in range(_RINGS - 1)
        for i, after in ((i, (i + 1) % _AROUND) for i in range(_AROUND))
    ]
    mesh = bpy.data.meshes.new("sleeve")
    mesh.from_pydata((np.concatenate(rings) * UNIT).tolist(), [], faces)
    mesh.materials.append(materials.plain("sleeve", colour, 0.9, speckle=0.2))
    shade_smooth(mesh)
    return new_object("sleeve", mesh)
