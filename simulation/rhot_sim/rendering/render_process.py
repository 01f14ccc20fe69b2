"""Rendering in a process of its own, as a real camera exposes without asking the Pi's processor.

The child (see `rhot_sim.rendering.render_process`) says that it is ready by one byte on its standard output. Then it
reads times (one float64 each) from its standard input, draws each picture into the next slot of a ring in shared
memory, and says so by another byte.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import signal
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from rhot.arrays import ImageArray
from rhot.errors import DeviceError
from rhot.geometry.camera import CameraModel
from rhot.operation.priority import lower_priority
from rhot.rig import load_rig

# What the child processes that draw simulated pictures have in common.
#
# In one process with tracking, drawing would hold Python's interpreter lock while a picture waits to be looked at, and
# latency would measure the simulator. A child reads requests from its standard input, writes pictures to its standard
# output, and ends with its parent, whose death closes that input.

_NICE: Final = 5
_STOP_S: Final = 0.5


def become_drawing_child() -> None:
    """Make this process a drawing child: one thread, deaf to Ctrl-C, which is for the parent."""
    import cv2  # noqa: PLC0415  # the parent may do without

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)


def first_request(size: int) -> Callable[[], bytes]:
    """Wait for the first request, of at most `size` bytes, while the rest of this process loads; returns what gives it.

    Loading takes half a second. A parent that is gone meanwhile ends this process at once.
    """
    came: list[bytes] = []

    def wait() -> None:
        came.append(os.read(sys.stdin.fileno(), size))
        if not came[0]:
            os._exit(0)

    waiting = threading.Thread(target=wait, name="first request", daemon=True)
    waiting.start()

    def first() -> bytes:
        waiting.join()
        return came[0]

    return first


def keep_out_of_the_way() -> None:
    """Lower this process's priority, once it has loaded: until then a camera is waited for."""
    lower_priority(_NICE)


def end(child: subprocess.Popen[bytes]) -> None:
    """End a drawing child, whatever it is doing."""
    child.terminate()
    try:
        child.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()


AHEAD: Final = 16
"""Pictures that may be begun and not yet taken. A quarter of a second at 60 Hz: longer than a machine with two cores is
busy with something else at a time (6 pictures lost 119 and 143 frames of 3,600 where 16 lost 71 and 92, of which 72 are
lost on purpose), and short enough to be filled within the start-up."""
BATCH: Final = 4
"""Pictures that are best begun at once: where everything is in them is then worked out together. Larger batches save
little more (2.6 ms a picture alone, 2.2 of four, 2.1 of eight) and keep the processor from others for longer."""
_REQUEST: Final = struct.Struct("d")
_DONE: Final = b"."


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
        self._file, self._path = _shared_file(camera)
        self._ring = _ring(self._file, width, height)
        self._child = subprocess.Popen(
            [sys.executable, "-m", __name__, str(rig_path), camera, self._path],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self._taken = 0

    def wait_until_ready(self) -> None:
        """Wait until the child has loaded its modules and the world, which takes most of a second on a busy machine.

        Raises:
            DeviceError: the child has ended.
        """
        self._wait_for_byte()

    def begin(self, *t_first_rows_s: float) -> None:
        """Ask for the pictures whose first rows begin at these times, seconds since the world's start.

        At most `AHEAD` pictures may be begun and not yet taken: the next would be drawn over the first.

        Raises:
            DeviceError: the child has ended.
        """
        try:
            if self._child.stdin is None:
                raise BrokenPipeError
            self._child.stdin.write(b"".join(map(_REQUEST.pack, t_first_rows_s)))
            self._child.stdin.flush()
        except (OSError, ValueError) as error:
            raise self._ended() from error

    def finish(self) -> ImageArray:
        """Wait for the picture asked for earliest and return it, (height, width, 3) uint8 BGR.

        Raises:
            DeviceError: the child has ended.
        """
        self._wait_for_byte()
        image: ImageArray = self._ring[self._taken % AHEAD].copy()
        self._taken += 1
        return image

    def close(self) -> None:
        """End the child; may be called again."""
        end(self._child)
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            if sys.platform != "linux":
                with contextlib.suppress(OSError):  # Windows keeps it while the ring is mapped
                    Path(self._path).unlink()

    def _wait_for_byte(self) -> None:
        try:
            done = b"" if self._child.stdout is None else os.read(self._child.stdout.fileno(), 1)
        except (OSError, ValueError) as error:
            raise self._ended() from error
        if not done:
            raise self._ended()

    def _ended(self) -> DeviceError:
        return DeviceError(f"camera {self._camera}: its renderer ended by itself, exit code {self._child.poll()}")


def _shared_file(camera: str) -> tuple[int, str]:
    """Return a new file, and the path by which a child opens it; on Linux it is in memory and goes by itself."""
    if sys.platform == "linux":
        file = os.memfd_create(f"rhot-{camera}")
        return file, f"/proc/{os.getpid()}/fd/{file}"
    else:  # noqa: RET505  # for mypy, which reads what follows a platform's return as dead
        return tempfile.mkstemp(prefix=f"rhot-{camera}-")


def _ring(file: int, width: int, height: int) -> ImageArray:
    """Return the ring of pictures (AHEAD, height, width, 3) that a file in memory holds."""
    shape = (AHEAD, height, width, 3)
    size = int(np.prod(shape))
    os.ftruncate(file, size)
    ring: ImageArray = np.frombuffer(mmap.mmap(file, size), np.uint8).reshape(shape)
    return ring


def serve(rig_path: Path, camera: str, path: str) -> None:
    """Render whatever standard input asks for until it closes."""
    first = first_request(BATCH * _REQUEST.size)
    file = os.open(path, os.O_RDWR)
    # Imported here: the parent needs none of it.
    from rhot_sim.rendering.renderer import Renderer  # noqa: PLC0415
    from rhot_sim.rig.calibration import true_cameras  # noqa: PLC0415
    from rhot_sim.world.world import World  # noqa: PLC0415

    become_drawing_child()
    rig = load_rig(rig_path)
    model: CameraModel = true_cameras(rig)[camera]
    index = list(rig.config.cameras).index(camera)
    renderer = Renderer(model, World.from_rig(rig), rig.config.sim, rig.config.cameras[camera], index)
    ring = _ring(file, model.width, model.height)
    keep_out_of_the_way()
    number = 0
    with contextlib.suppress(BrokenPipeError):
        _say_done()
        requests = _requests(first())
        while requests:
            slots = [ring[(number + place) % AHEAD] for place in range(len(requests))]
            for _ in renderer.render_all(requests, slots):
                _say_done()
            number += len(requests)
            # A pipe hands over whole requests: each batch is written at once, and is smaller than what a pipe never
            # cuts. None when nobody will ask any more.
            requests = _requests(os.read(sys.stdin.fileno(), BATCH * _REQUEST.size))


def _requests(asked: bytes) -> list[float]:
    return [t_s for (t_s,) in _REQUEST.iter_unpack(asked[: len(asked) // _REQUEST.size * _REQUEST.size])]


def _say_done() -> None:
    sys.stdout.buffer.write(_DONE)
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    serve(Path(sys.argv[1]), sys.argv[2], sys.argv[3])
