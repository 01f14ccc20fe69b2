"""A simulated camera: renders the world that every other simulated node knows too, in real time.

The next frame is rendered ahead of its time and delivered when a real camera would deliver it. Frames are timed on
the camera's own clock, which is off and drifts when it is a `SkewedClock`.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Protocol

from rhot.camera import CameraModel
from rhot.clock import NodeClock, SkewedClock
from rhot.errors import ConfigError
from rhot.rig import CameraConfig, Rig
from rhot_capture.color_table import ImageArray
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.frame import Frame
from rhot_capture.sources.pacing import Pacer

_LOG = logging.getLogger(__name__)


class FrameMoment(Protocol):
    """When one simulated frame happens, seconds since the world's start."""

    @property
    def t_first_row_s(self) -> float:
        """Start of the first row's exposure."""
        ...

    @property
    def delivered_s(self) -> float:
        """When the picture is there."""
        ...

    @property
    def dropped(self) -> bool:
        """Whether it is lost."""
        ...


class Schedule(Protocol):
    """When the frames of one simulated camera happen."""

    def frame(self, index: int) -> FrameMoment:
        """Return a frame by its number."""
        ...

    def first_after(self, t_s: float) -> int:
        """Return the number of the first frame that does not begin before `t_s`."""
        ...


class TrueClock:
    """The machine's wall clock, the true time of the simulation."""

    def now_ns(self) -> int:
        """Return nanoseconds since the Unix epoch."""
        return time.time_ns()


class SimulatedSource:
    """Delivers rendered frames at their due time."""

    def __init__(
        self,
        name: str,
        camera: CameraConfig,
        render: Callable[[float], ImageArray],
        schedule: Schedule,
        clock: NodeClock,
    ) -> None:
        """Prepare.

        Args:
            name: of the camera.
            camera: its configuration.
            render: returns the picture whose first row begins at some seconds since the world's start.
            schedule: when its frames happen.
            clock: the node's own clock.
        """
        self._name = name
        self._camera = camera
        self._render = render
        self._schedule = schedule
        self._clock = clock
        self._pacer = Pacer(TrueClock())
        self._world_start_ns = 0
        self._number = 0
        self._settings: CameraSettings | None = None

    @classmethod
    def from_rig(cls, name: str, rig: Rig, clock: NodeClock) -> SimulatedSource:
        """Build the source of a simulated camera: rendered with its true geometry, not with what calibration found."""
        from rhot.sim.calibration import simulated_rig_calibration  # noqa: PLC0415
        from rhot.sim.renderer import Renderer  # noqa: PLC0415
        from rhot.sim.schedule import FrameSchedule  # noqa: PLC0415
        from rhot.sim.world import World  # noqa: PLC0415

        sim, cameras = rig.config.sim, rig.config.cameras
        place = list(cameras).index(name)
        truth = simulated_rig_calibration(cameras, sim.seed).truth.cameras[name]
        renderer = Renderer(CameraModel.from_calibration(truth), World.from_rig(rig), sim, cameras[name], place)
        schedule = FrameSchedule(name, place, cameras[name], sim)
        return cls(name, cameras[name], renderer.render, schedule, clock)

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Let the world begin at a moment; late, join at the frame that is due next."""
        self._pacer.restart()
        # The world begins at the broadcast start time itself where it is known: were it read off the node's clock,
        # errors of the clock exchange would shift the world along and could not be seen.
        self._world_start_ns = self._true_ns(start_ns) if start_t_ns is None else start_t_ns
        passed_s = 1e-9 * (self._pacer.now_ns() - self._world_start_ns)
        self._number = self._schedule.first_after(passed_s) if passed_s > 0.0 else 0

    def read(self) -> Frame | None:
        """Render the next frame, wait until it is due and return it."""
        while not self._pacer.stopped:
            moment = self._schedule.frame(self._number)
            number = self._number
            self._number += 1
            if moment.dropped:
                continue
            if self._world_start_ns + round(1e9 * moment.delivered_s) < self._pacer.now_ns() - self._behind_ns():
                # Rendering does not keep up: frames fall out as they would from a camera that nobody empties.
                continue
            image = self._render(moment.t_first_row_s)
            if not self._pacer.wait_until(self._world_start_ns + round(1e9 * moment.delivered_s)):
                return None
            return Frame(
                image,
                number,
                self._node_ns(self._world_start_ns + round(1e9 * moment.t_first_row_s)),
                self._camera.exposure_s,
                self._camera.readout_s,
            )
        return None

    def apply(self, settings: CameraSettings) -> None:
        """Accept settings that leave the optics alone: the simulated light is what it is."""
        if self._settings is not None and not settings.same_optics(self._settings):
            raise ConfigError(
                f"camera {self._name} is simulated: exposure, gain, white balance and focus follow rig.toml; only "
                "colours can change while it runs"
            )
        self._settings = settings

    def close(self) -> None:
        """Stop; a waiting `read` returns None."""
        self._pacer.stop()

    def _behind_ns(self) -> int:
        return round(1e9 / self._camera.rate_hz)

    def _node_ns(self, true_ns: int) -> int:
        if isinstance(self._clock, SkewedClock):
            return self._clock.from_true_ns(true_ns)
        return true_ns + self._clock.now_ns() - self._pacer.now_ns()

    def _true_ns(self, node_ns: int) -> int:
        true_ns = self._pacer.now_ns() + node_ns - self._clock.now_ns()
        if isinstance(self._clock, SkewedClock):
            # One correction leaves drift² of the error: nothing.
            true_ns += node_ns - self._clock.from_true_ns(true_ns)
        return true_ns
