"""A world as a Blender scene, and a picture of it; needs `bpy` (run under a Python that has it)."""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path
from typing import Any, Final

import bpy  # type: ignore[import-not-found]
import numpy as np
from mathutils import Matrix  # type: ignore[import-not-found]

from rhot.arrays import FloatArray
from rhot_bench.rendering.blender import materials
from rhot_bench.rendering.blender.props import UNIT, box, chessboard, furnish, grasped, matrix, new_object, shade_smooth
from rhot_bench.rendering.cameras import Camera, Timing
from rhot_bench.rendering.contact import finger_points
from rhot_bench.rendering.hand import BONES, MARKERS, Hand, bone_poses
from rhot_bench.rendering.look import Colour, Look
from rhot_bench.rendering.motion import States, forearm_poses
from rhot_bench.rendering.sensor import Pinhole
from rhot_bench.rendering.skin import FOREARM, FOREARM_MM, Skin, make_skin
from rhot_bench.rendering.world import World

# The hand with arm, patch and sleeve as Blender objects, and their animation; needs `bpy`.

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


# A world as a Blender scene, and a picture of it; needs `bpy` (run under a Python that has it).

# Read an uncompressed scan-line OpenEXR file of several parts (openexr.com, "OpenEXR file layout").

_MAGIC: Final = 20000630
_MULTI_PART: Final = 0x1000
_TYPES: Final = {0: "<u4", 1: "<f2", 2: "<f4"}


def read_layers(path: Path) -> dict[str, np.ndarray]:
    """Return each layer of a file as (H, W, channels) float32; RGBA in this order.

    Raises:
        ValueError: the file is no OpenEXR file, or compressed.
    """
    data = path.read_bytes()
    magic, version = struct.unpack_from("<ii", data)
    if magic != _MAGIC:
        raise ValueError(f"{path}: not an OpenEXR file")
    many = bool(version & _MULTI_PART)
    at, parts = 8, []
    while True:
        header, at = _header(data, at)
        if not header:
            break
        parts.append(header)
        if not many:
            break
    boxes = [struct.unpack("<4i", header["dataWindow"]) for header in parts]
    if any(header["compression"][0] for header in parts):
        raise ValueError(f"{path}: is compressed; write it with codec NONE")
    at += 8 * sum(y1 - y0 + 1 for _, y0, _, y1 in boxes)
    layers: dict[str, np.ndarray] = {}
    # Blender writes part after part, and within a part row after row.
    for header, (x0, y0, x1, y1) in zip(parts, boxes, strict=True):
        width, height = x1 - x0 + 1, y1 - y0 + 1
        fields = _channels(header["channels"], width)
        row = np.dtype([*([("part", "<i4")] if many else []), ("y", "<i4"), ("size", "<i4"), *fields])
        rows = np.frombuffer(data, row, height, at)
        at += row.itemsize * height
        grouped: dict[str, dict[str, np.ndarray]] = {}
        part = header["name"].decode().rstrip("\0") if "name" in header else ""
        for name, *_ in fields:
            layer, _, channel = name.rpartition(".")
            grouped.setdefault(layer or part, {})[channel] = rows[name].astype(np.float32)
        for layer, planes in grouped.items():
            order = sorted(planes, key="RGBA".find)
            layers[layer.rpartition(".")[2]] = np.stack([planes[channel] for channel in order], axis=-1)
    return layers


def _header(data: bytes, at: int) -> tuple[dict[str, bytes], int]:
    header = {}
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)
        size = struct.unpack_from("<i", data, at)[0]
        header[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    return header, at + 1


def _channels(body: bytes, width: int) -> list[Any]:
    fields: list[Any] = []
    place = 0
    while body[place]:
        name, place = _text(body, place)
        fields.append((name, _TYPES[struct.unpack_from("<i", body, place)[0]], (width,)))
        place += 16
    return fields


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(0, at)
    return data[at:end].decode(), end + 1


# A world as a Blender scene, and a picture of it; needs `bpy` (run under a Python that has it).

_FRAME0: Final = 100
"""Blender's frame at a sequence's first t_ns; a frame is a millisecond."""
_KEY_MS: Final = 2
_AROUND_MS: Final = 40.0
"""Motion is keyed from so long before the first picture to so long after the last one."""
_ROOM_PX: Final = 34.0
"""Margin of the border round what moves, for its shadow."""
_SENSOR_MM: Final = 36.0
_MOVING: Final = ("G1", "G2", "K")


class Scene:
    """The Blender scene of one world; `skin` is the mesh of its hand."""

    def __init__(self, world: World) -> None:
        """Build it."""
        self.world = world
        self.skin = make_skin(world.hand)
        self._motion: States | None = None
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self._scene = bpy.context.scene
        self._settings()
        furnish(world.look)
        self._puppet = Puppet(world.hand, self.skin, world.look)
        self._object = grasped(world.grasp.solid, world.look.object_colour)
        blur_motion(self._object)
        self._board = chessboard()
        self._camera = new_object("camera", bpy.data.cameras.new("camera"))
        self._scene.camera = self._camera
        self._folder = tempfile.TemporaryDirectory(prefix="rhot-render-")
        self._out = Path(self._folder.name) / "picture.exr"

    def stage(self, sequence: str, board: FloatArray | None = None) -> None:
        """Show what a sequence shows, and animate it.

        Args:
            sequence: `G1`, `G2`, `K`, `C`, or `empty` for the desk alone.
            board: (4, 4) world from board, mm; of `C`.
        """
        for part in self._puppet.parts:
            part.hide_render = sequence not in _MOVING
        self._object.hide_render = sequence != "G2"
        self._board.hide_render = sequence != "C"
        if board is not None:
            self._board.matrix_world = matrix(board)
        if sequence not in _MOVING:
            return
        timing = self.world.timings[sequence]
        last_ms = (timing.end_ns - timing.first_ns) * 1e-6
        ms = np.arange(-_AROUND_MS, last_ms + _AROUND_MS, _KEY_MS)
        self._motion = self.world.states(sequence, timing.first_ns + ms * 1e6)
        self._puppet.animate(_FRAME0 + ms, self._motion)
        if self._motion.T_world_object is not None:
            key(self._object, _FRAME0 + ms, {"": self._motion.T_world_object})

    def border(
        self, camera: Camera, pinhole: Pinhole, timing: Timing, after_first_s: float
    ) -> tuple[int, int, int, int]:
        """Return x0, y0, x1, y1 round hand, arm and object while the shutter is open, with room for their shadow.

        Raises:
            RuntimeError: no moving sequence is staged.
        """
        if self._motion is None:
            raise RuntimeError("stage G1, G2 or K before asking for the border of what moves")
        motion, arms = self._motion, forearm_poses(self._motion.T_world_hand)
        opens_s, length_s = pinhole.shutter_s(timing)
        open_s = after_first_s + opens_s + length_s * np.array([0.0, 0.5, 1.0])
        at = np.clip(np.searchsorted(motion.t_s, open_s), 0, len(motion.t_s) - 1)
        points, _ = finger_points(self.world.hand, motion.bones[at])
        arm = np.linspace(0.0, FOREARM_MM, 12)[:, None, None] * np.array([0.0, -1.0, 0.0])
        wide = np.array([[45.0, 0, 0], [-45.0, 0, 0], [0, 0, 30.0], [0, 0, -40.0]])
        around = (arm + wide).reshape(-1, 3)
        shown = [points.reshape(-1, 3), *(around @ pose[:3, :3].T + pose[:3, 3] for pose in arms[at])]
        if motion.T_world_object is not None:
            reach = float(np.linalg.norm(self.world.grasp.solid.half)) / np.sqrt(3.0)
            corners = reach * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            shown += [corners + pose[:3, 3] for pose in motion.T_world_object[at]]
        return pinhole.border(camera, np.concatenate(shown), _ROOM_PX)

    def render(
        self,
        camera: Camera,
        pinhole: Pinhole,
        timing: Timing | None,
        after_first_s: float = 0.0,
        border: tuple[int, int, int, int] | None = None,
        samples: int = 10,
    ) -> dict[str, np.ndarray]:
        """Return the layers of a picture of the pinhole: `Combined`, `maskA`, `maskB`.

        Args:
            camera: where it stands.
            pinhole: its ideal form.
            timing: for motion blur and rolling shutter; None = an instant.
            after_first_s: t_ns of the picture after that of the sequence's first one.
            border: x0, y0, x1, y1 of the part to render; None = all.
            samples: a pixel.
        """
        self._aim(camera, pinhole, border or (0, 0, *pinhole.size))
        render, cycles = self._scene.render, self._scene.cycles
        frame = _FRAME0 + 1e3 * after_first_s
        render.use_motion_blur = timing is not None
        if timing is not None:
            opens_s, length_s = pinhole.shutter_s(timing)
            render.motion_blur_position, render.motion_blur_shutter = "START", 1e3 * length_s
            cycles.rolling_shutter_type = "TOP"
            cycles.rolling_shutter_duration = timing.exposure_s / length_s
            frame += 1e3 * opens_s
        self._scene.frame_set(int(np.floor(frame)), subframe=float(frame - np.floor(frame)))
        cycles.seed = int(1e3 * frame) % 2**20
        cycles.samples = samples
        render.filepath = str(self._out)
        bpy.ops.render.render(write_still=True)
        return read_layers(self._out)

    def _aim(self, camera: Camera, pinhole: Pinhole, border: tuple[int, int, int, int]) -> None:
        render, (width, height), (x0, y0, x1, y1) = self._scene.render, pinhole.size, border
        # Blender's camera looks along -z, y up.
        self._camera.matrix_world = matrix(
            np.array(np.linalg.inv(camera.T_camera_world) @ np.diag([1.0, -1.0, -1.0, 1.0]))
        )
        lens = self._camera.data
        lens.sensor_fit, lens.sensor_width = "HORIZONTAL", _SENSOR_MM
        lens.lens = pinhole.focal * _SENSOR_MM / width
        lens.clip_start, lens.clip_end = 0.1, 200.0
        lens.shift_x = -(pinhole.centre[0] - (width - 1) / 2) / width
        lens.shift_y = (pinhole.centre[1] - (height - 1) / 2) / width
        render.resolution_x, render.resolution_y = width, height
        render.use_border = render.use_crop_to_border = True
        # Blender cuts to whole pixels; a hundredth keeps it from falling one short.
        render.border_min_x, render.border_max_x = (x0 + 0.01) / width, (x1 + 0.01) / width
        render.border_min_y, render.border_max_y = (height - y1 + 0.01) / height, (height - y0 + 0.01) / height

    def _settings(self) -> None:
        scene, cycles, render = self._scene, self._scene.cycles, self._scene.render
        render.engine = "CYCLES"
        cycles.device = "CPU"
        cycles.use_adaptive_sampling = False
        cycles.use_denoising = True
        cycles.denoiser = "OPENIMAGEDENOISE"
        cycles.denoising_input_passes = "RGB_ALBEDO_NORMAL"
        cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 3, 2, 1
        cycles.caustics_reflective = cycles.caustics_refractive = False
        cycles.sample_clamp_indirect = 4.0
        cycles.filter_width = 1.0
        render.threads_mode, render.threads = "FIXED", 1
        render.use_persistent_data = True
        render.fps, render.fps_base = 1000, 1.0
        render.resolution_percentage = 100
        scene.view_settings.view_transform = "Raw"
        image = render.image_settings
        image.media_type = "MULTI_LAYER_IMAGE"
        image.file_format = "OPEN_EXR_MULTILAYER"
        image.color_depth, image.exr_codec = "32", "NONE"
        for name in materials.MASKS:
            aov = scene.view_layers[0].aovs.add()
            aov.name, aov.type = name, "COLOR"
