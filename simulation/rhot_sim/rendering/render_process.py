"""Rendering in a process of its own, as a real camera exposes without asking the Pi's processor.

The child (see `rhot_sim.rendering.picture_child`) reads times (one float64 each) and writes one picture for each.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import subprocess
import sys
from pathlib import Path
from typing import Final

import numpy as np

from rhot.errors import DeviceError
from rhot.geometry.camera import CameraModel
from rhot.rig import load_rig
from rhot_capture.detection.color_table import ImageArray
from rhot_sim.rendering.picture_child import end, keep_out_of_the_way

_REQUEST: Final = struct.Struct("d")
_PIPE_BYTES: Final = 1 << 20
"""A whole 640x480 picture waits in the pipe, so that the next can be begun before this one is taken."""


class RenderProcess:
    """One simulated camera's renderer as a child process."""

    def __init__(self, rig_path: Path, camera: str, width: int, height: int) -> None:
        """Start the child.

        Args:
            rig_path: folder of the simulated rig.
            camera: name of the camera.
            width, height: of its pictures, pixels.
        """
        self._camera = camera
        self._shape = (height, width, 3)
        self._child = subprocess.Popen(
            [sys.executable, "-m", __name__, str(rig_path), camera], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        if self._child.stdout is not None:
            with contextlib.suppress(OSError):  # more than this user may have: the child then waits a little more often
                fcntl.fcntl(self._child.stdout, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)

    def begin(self, t_first_row_s: float) -> None:
        """Ask for the picture whose first row begins at a time, seconds since the world's start.

        Raises:
            DeviceError: the child has ended.
        """
        try:
            if self._child.stdin is None:
                raise BrokenPipeError
            self._child.stdin.write(_REQUEST.pack(t_first_row_s))
            self._child.stdin.flush()
        except (OSError, ValueError) as error:
            raise self._ended() from error

    def finish(self) -> ImageArray:
        """Wait for the picture asked for earliest and return it, (height, width, 3) uint8 BGR.

        Raises:
            DeviceError: the child has ended.
        """
        image: ImageArray = np.empty(self._shape, np.uint8)
        left = image.data.cast("B")
        try:
            while len(left) and self._child.stdout is not None:
                taken = os.readv(self._child.stdout.fileno(), [left])
                if not taken:
                    break
                left = left[taken:]
        except (OSError, ValueError) as error:
            raise self._ended() from error
        if len(left):
            raise self._ended()
        return image

    def close(self) -> None:
        """End the child."""
        end(self._child)

    def _ended(self) -> DeviceError:
        return DeviceError(f"camera {self._camera}: its renderer ended by itself, exit code {self._child.poll()}")


def serve(rig_path: Path, camera: str) -> None:
    """Render whatever standard input asks for until it closes."""
    # Imported here: the parent needs none of it.
    from rhot_sim.rendering.renderer import Renderer  # noqa: PLC0415
    from rhot_sim.rig.folder import true_cameras  # noqa: PLC0415
    from rhot_sim.world.world import World  # noqa: PLC0415

    keep_out_of_the_way()
    rig = load_rig(rig_path)
    model: CameraModel = true_cameras(rig)[camera]
    index = list(rig.config.cameras).index(camera)
    renderer = Renderer(model, World.from_rig(rig), rig.config.sim, rig.config.cameras[camera], index)
    with contextlib.suppress(BrokenPipeError):
        while request := sys.stdin.buffer.read(_REQUEST.size):
            if len(request) < _REQUEST.size:
                return
            image = renderer.render(_REQUEST.unpack(request)[0])
            sys.stdout.buffer.write(image.data.cast("B"))
            sys.stdout.buffer.flush()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), sys.argv[2])
