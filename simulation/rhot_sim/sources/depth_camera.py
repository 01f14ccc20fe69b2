"""The depth camera of the simulated walking person, in real time.

Pictures are drawn ahead of their time and delivered when a real camera would deliver them. Where drawing takes longer
than a frame, the frames that cannot be ready in time are left out, as from a camera that nobody empties.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.rig import Rig
from rhot_feet.frames import ColorImage, DepthFrame, DepthImage, pinhole

_FIRST_DRAWING_S: Final = 0.05
_FORGETTING: Final = 0.2


class FrameMoment(Protocol):
    """When one simulated frame happens, seconds since the world's start."""

    @property
    def t_s(self) -> float:
        """Middle of the exposure."""
        ...

    @property
    def delivered_s(self) -> float:
        """When the picture is there."""
        ...

    @property
    def dropped(self) -> bool:
        """Whether it is lost."""
        ...


class DepthWorld(Protocol):
    """What a simulated camera looks at; `rhot_sim.walker.world.WalkerWorld` is one."""

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """K (3, 3), pixels."""
        ...

    def timing(self, index: int) -> FrameMoment:
        """Return when a frame happens."""
        ...

    def frame(self, index: int) -> tuple[float, ColorImage, DepthImage]:
        """Return a frame's time, seconds, its colour and its aligned depth."""
        ...


class SimulatedDepthSource:
    """Delivers drawn frames at their due time."""

    def __init__(
        self,
        world: DepthWorld,
        rate_hz: float,
        camera: CameraModel,
        now_ns: Callable[[], int],
        release: Callable[[], None] | None = None,
    ) -> None:
        """Prepare.

        Args:
            world: draws the pictures.
            rate_hz: frames per second.
            camera: its lens.
            now_ns: rig time.
            release: called at `close`, after which the world is of no more use.
        """
        self._world = world
        self._release = release
        self._rate_hz = rate_hz
        self._camera = camera
        self._now_ns = now_ns
        self._start_ns = 0
        self._next = 0
        self._drawing_s = _FIRST_DRAWING_S
        self._ready: DepthFrame | None = None
        self._closed = threading.Event()

    @classmethod
    def from_rig(cls, rig: Rig, now_ns: Callable[[], int]) -> SimulatedDepthSource:
        """Build the camera of the world that a rig describes; its pictures are drawn by a process of their own.

        Raises:
            ConfigError: the rig has no [feet].
        """
        from rhot_sim.walker.pictures.draw_process import DrawProcess  # noqa: PLC0415

        if rig.config.feet is None:
            raise ConfigError(f"{rig.path / 'rig.toml'} has no [feet]; add [feet.left] or [feet.right] with marker_id")
        config = rig.config.feet.camera
        world = DrawProcess(rig)
        camera = pinhole(config.width, config.height, world.intrinsics, np.empty(0))
        return cls(world, config.rate_hz, camera, now_ns, world.close)

    @property
    def finished(self) -> bool:
        """Never: the world goes on."""
        return False

    def open(self, start_ns: int) -> None:
        """Let the world begin at `start_ns`; late, join at the frame that is due next."""
        self._start_ns, self._next, self._ready = start_ns, 0, None
        self._drawing_s = _FIRST_DRAWING_S
        self._closed.clear()
        # Floor and lens are prepared with the first picture, which takes seconds and tells nothing of the others.
        self._world.frame(0)

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Draw the next frame that can be ready in time, wait until it is due and return it."""
        if self._closed.is_set():
            return None
        deadline_ns = self._now_ns() + round(1e9 * timeout_s)
        frame = self._ready or self._draw()
        self._ready = frame
        due_ns = self._start_ns + round(1e9 * self._world.timing(frame.index).delivered_s)
        wait_s = 1e-9 * (min(due_ns, deadline_ns) - self._now_ns())
        if wait_s > 0.0 and self._closed.wait(wait_s):
            return None
        if due_ns > self._now_ns():
            return None
        self._ready = None
        return frame

    def close(self) -> None:
        """Stop; a waiting `read` returns None."""
        self._closed.set()
        if self._release is not None:
            self._release()

    def _draw(self) -> DepthFrame:
        index = self._first_in_time()
        began_ns = self._now_ns()
        t_s, color, depth_mm = self._world.frame(index)
        took_s = 1e-9 * (self._now_ns() - began_ns)
        # One slow picture must not make all that follow wait for a time that they do not need.
        self._drawing_s += _FORGETTING * (min(took_s, 3.0 * self._drawing_s) - self._drawing_s)
        self._next = index + 1
        return DepthFrame(self._start_ns + round(1e9 * t_s), color, depth_mm, self._camera, index)

    def _first_in_time(self) -> int:
        """Return the number of the next frame that is not lost and, drawn now, is there when it is due."""
        ready_s = 1e-9 * (self._now_ns() - self._start_ns) + self._drawing_s
        index = max(self._next, int(np.floor((ready_s - 1.0) * self._rate_hz)))
        while self._world.timing(index).dropped or self._world.timing(index).delivered_s < ready_s:
            index += 1
        return index
