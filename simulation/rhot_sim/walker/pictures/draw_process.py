"""Drawing the simulated person's pictures in a process of its own, as a real camera exposes without our processor.

The child (see `rhot_sim.rendering.render_process`) reads numbers of frames and writes time, colour and depth of each.
"""

from __future__ import annotations

import contextlib
import struct
import subprocess
import sys
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.errors import DeviceError
from rhot.rig import Rig, load_rig
from rhot_feet.frames import ColorImage, DepthImage
from rhot_sim.rendering.render_process import become_drawing_child, end, keep_out_of_the_way
from rhot_sim.walker.pictures.camera import FrameTiming
from rhot_sim.walker.world import WalkerWorld

_REQUEST: Final = struct.Struct("q")
_TIME: Final = struct.Struct("d")


class DrawProcess:
    """The world of a rig whose pictures a child process draws; see `rhot_sim.sources.depth_camera.DepthWorld`."""

    def __init__(self, rig: Rig) -> None:
        """Start the child."""
        self._world = WalkerWorld.from_rig(rig)
        camera = self._world.feet_config.camera
        self._shape = (camera.height, camera.width)
        self._child = subprocess.Popen(
            [sys.executable, "-m", __name__, str(rig.path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """K (3, 3), pixels."""
        return self._world.intrinsics

    def timing(self, index: int) -> FrameTiming:
        """Return when a frame happens."""
        return self._world.timing(index)

    def frame(self, index: int) -> tuple[float, ColorImage, DepthImage]:
        """Return a frame's time, seconds, its colour and its aligned depth.

        Raises:
            DeviceError: the child has ended.
        """
        child = self._child
        color: ColorImage = np.empty((*self._shape, 3), np.uint8)
        depth_mm: DepthImage = np.empty(self._shape, np.uint16)
        head = bytearray(_TIME.size)
        try:
            if child.stdin is None or child.stdout is None:
                raise BrokenPipeError
            child.stdin.write(_REQUEST.pack(index))
            child.stdin.flush()
            whole = all(
                child.stdout.readinto(part) == len(part)  # type: ignore[attr-defined]
                for part in (memoryview(head), color.data.cast("B"), depth_mm.data.cast("B"))
            )
        except (OSError, ValueError) as error:
            raise self._ended() from error
        if not whole:
            raise self._ended()
        return _TIME.unpack(head)[0], color, depth_mm

    def close(self) -> None:
        """End the child."""
        end(self._child)

    def _ended(self) -> DeviceError:
        return DeviceError(f"the simulated depth camera's drawing ended by itself, exit code {self._child.poll()}")


def serve(rig_path: Path) -> None:
    """Draw whatever standard input asks for until it closes."""
    become_drawing_child()
    world = WalkerWorld.from_rig(load_rig(rig_path))
    keep_out_of_the_way()
    out = sys.stdout.buffer
    with contextlib.suppress(BrokenPipeError):
        while len(request := sys.stdin.buffer.read(_REQUEST.size)) == _REQUEST.size:
            t_s, color, depth_mm = world.frame(_REQUEST.unpack(request)[0])
            for part in (_TIME.pack(t_s), color.data.cast("B"), depth_mm.data.cast("B")):
                out.write(part)
            out.flush()


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
