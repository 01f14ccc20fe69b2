"""Rendering in a process of its own, as a real camera exposes without asking the Pi's processor.

In one process with detection, rendering would hold Python's interpreter lock while a frame waits to be looked at, and
latency would measure the simulator. The child has a lower priority for the same reason. It reads times (one float64
each) from its standard input, writes one picture for each to its standard output, and ends with its parent, whose death
closes that input.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import Final

import numpy as np

from rhot.camera import CameraModel
from rhot.errors import DeviceError
from rhot.rig import load_rig
from rhot_capture.color_table import ImageArray

_REQUEST: Final = struct.Struct("d")
_PIPE_BYTES: Final = 1 << 20
"""A whole 640x480 picture waits in the pipe, so that the next can be begun before this one is taken."""
_NICE: Final = 5
_STOP_S: Final = 0.5


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
        self._child.terminate()
        try:
            self._child.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    def _ended(self) -> DeviceError:
        return DeviceError(f"camera {self._camera}: its renderer ended by itself, exit code {self._child.poll()}")


def serve(rig_path: Path, camera: str) -> None:
    """Render whatever standard input asks for until it closes."""
    # Imported here: the parent needs none of it.
    import cv2  # noqa: PLC0415

    from rhot.sim.folder import true_cameras  # noqa: PLC0415
    from rhot.sim.renderer import Renderer  # noqa: PLC0415
    from rhot.sim.world import World  # noqa: PLC0415

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then closes our input
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    cv2.setNumThreads(1)
    rig = load_rig(rig_path)
    model: CameraModel = true_cameras(rig)[camera]
    place = list(rig.config.cameras).index(camera)
    renderer = Renderer(model, World.from_rig(rig), rig.config.sim, rig.config.cameras[camera], place)
    with contextlib.suppress(BrokenPipeError):
        while request := sys.stdin.buffer.read(_REQUEST.size):
            if len(request) < _REQUEST.size:
                return
            image = renderer.render(_REQUEST.unpack(request)[0])
            sys.stdout.buffer.write(image.data.cast("B"))
            sys.stdout.buffer.flush()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), sys.argv[2])
