"""Drawing the simulated person's pictures in a process of its own, as a real camera exposes without our processor.

In one process with tracking, drawing would hold Python's interpreter lock while a picture waits to be looked at, and
latency would measure the simulator. The child has a lower priority for the same reason. It reads numbers of frames from
its standard input, writes time, colour and depth of each to its standard output, and ends with its parent, whose death
closes that input.
"""

from __future__ import annotations

import contextlib
import os
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.errors import DeviceError
from rhot.rig import Rig, load_rig
from rhot.sim.walker.camera import FrameTiming
from rhot.sim.walker.world import WalkerWorld
from rhot_feet.frames import ColorImage, DepthImage

_REQUEST: Final = struct.Struct("q")
_TIME: Final = struct.Struct("d")
_NICE: Final = 5
_STOP_S: Final = 0.5


class DrawProcess:
    """The world of a rig whose pictures a child process draws; see `rhot_feet.sources.simulated.DepthWorld`."""

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
        self._child.terminate()
        try:
            self._child.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()

    def _ended(self) -> DeviceError:
        return DeviceError(f"the simulated depth camera's drawing ended by itself, exit code {self._child.poll()}")


def serve(rig_path: Path) -> None:
    """Draw whatever standard input asks for until it closes."""
    import cv2  # noqa: PLC0415

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which then closes our input
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    cv2.setNumThreads(1)
    world = WalkerWorld.from_rig(load_rig(rig_path))
    out = sys.stdout.buffer
    with contextlib.suppress(BrokenPipeError):
        while len(request := sys.stdin.buffer.read(_REQUEST.size)) == _REQUEST.size:
            t_s, color, depth_mm = world.frame(_REQUEST.unpack(request)[0])
            for part in (_TIME.pack(t_s), color.data.cast("B"), depth_mm.data.cast("B")):
                out.write(part)
            out.flush()


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
