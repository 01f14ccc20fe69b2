"""A world as a Blender scene, and a picture of it; needs `bpy` (run under a Python that has it)."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Final

import bpy  # type: ignore[import-not-found]
import numpy as np

from rhot.arrays import FloatArray
from worlds.blender import materials
from worlds.blender.exr import read_layers
from worlds.blender.props import chessboard, furnish, grasped, matrix, new_object
from worlds.blender.puppet import Puppet, blur_motion, key
from worlds.cameras import Camera, Timing
from worlds.contact import finger_points
from worlds.motion import States, forearm_poses
from worlds.sensor import Pinhole
from worlds.skin import FOREARM_MM, make_skin
from worlds.world import World

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
