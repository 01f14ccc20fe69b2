"""A simulated camera: renders the world that every other simulated node knows too, in real time.

Frames are rendered ahead of their time, a few at once, and delivered when a real camera would deliver them. They are
timed on the camera's own clock, which is off and drifts when it is a `SkewedClock`.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Mapping
from typing import Final, Protocol

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.clock import NodeClock, SkewedClock, difference_ns
from rhot.errors import ConfigError, DeviceError
from rhot.rig import CameraConfig, Rig
from rhot.rig.colors import ColorsFile
from rhot.rig.sections import PICTURE_NEUTRAL
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.frame import Frame
from rhot_capture.sources.pacing import Pacer
from rhot_sim.rendering.backdrop import Image
from rhot_sim.rendering.render_process import AHEAD, BATCH, RenderProcess

# Saturation, contrast and brightness of a simulated picture, as a camera's own processor applies them.
#
#     grey = 0.114 B + 0.587 G + 0.299 R
#     C' = 127.5 + contrast · (grey + saturation · (C − grey) − 127.5) + 255 · brightness
#
# The order is that of a Raspberry Pi's: colour matrix, then the tone curve about the middle level (libcamera,
# `src/ipa/rpi/controller/rpi/contrast.cpp`). Grey is ITU-R BT.601's.

_GREY_BGR: Final = np.array([0.114, 0.587, 0.299])
_MIDDLE: Final = 127.5
_RANGE: Final = 255.0


def with_picture(image: Image, picture: Mapping[str, float]) -> Image:
    """Return a picture with settings applied; a neutral setting returns the picture itself.

    Args:
        image: (H, W, 3) uint8, blue green red.
        picture: `saturation`, `contrast` and `brightness` as in `CameraConfig`.
    """
    saturation, contrast, brightness = picture["saturation"], picture["contrast"], picture["brightness"]
    if (saturation, contrast, brightness) == (1.0, 1.0, 0.0):
        return image
    colors = saturation * np.eye(3) + (1.0 - saturation) * np.tile(_GREY_BGR, (3, 1))
    offset = _MIDDLE * (1.0 - contrast) + _RANGE * brightness
    matrix = np.column_stack([contrast * colors, np.full(3, offset)])
    return np.asarray(cv2.transform(image, matrix), dtype=np.uint8)


# Which frames a simulated camera draws on a machine that cannot draw them all.
#
# A tracker does far better with every second frame than with frames that fall out at random: a point needs both cameras
# at one moment, and a share p of frames lost at random leaves only (1 − p)² of the moments.

_WINDOW: Final = 60
"""Frames looked at together: a second at 60 Hz."""
_MOST: Final = 4
_START: Final = 180
"""Frames after the start that tell nothing: three seconds in which every service loads its modules."""
_FIRST_PATIENCE: Final = 180
_MOST_PATIENCE: Final = 1440
"""Frames drawn in time before more are tried again, doubled each time that was too soon."""


class Stride:
    """How many frames lie from one that is drawn to the next.

    Attributes:
        value: 1 (all), 2 or 4.
    """

    def __init__(self) -> None:
        self.value = 1
        self._waiting = _START
        self._looked = 0
        self._late = 0
        self._in_time = 0
        self._patience = _FIRST_PATIENCE

    def next_after(self, number: int) -> int:
        """Return the number of the frame to draw after another: a multiple of the stride, the same in all cameras."""
        return (number // self.value + 1) * self.value

    def count(self, late: bool) -> bool:
        """Take whether a frame was too late to be drawn; return whether the stride has changed."""
        if self._waiting:
            self._waiting -= 1
            return False
        self._looked += 1
        self._late += late
        self._in_time = 0 if late else self._in_time + 1
        # Share of them that came too late to be drawn; a camera then loses 36 % of all moments.
        if self._late > 0.2 * _WINDOW and self.value < _MOST:
            self._begin(2 * self.value)
            return True
        if self._looked >= _WINDOW:
            self._looked = self._late = 0
        if self.value > 1 and self._in_time * self.value >= self._patience:
            self._patience = min(2 * self._patience, _MOST_PATIENCE)
            self._begin(self.value // 2)
            return True
        return False

    def _begin(self, value: int) -> None:
        self.value = value
        self._looked = self._late = self._in_time = 0


logger = logging.getLogger(__name__)

_FORGETTING: Final = 0.1
"""Share of the newest picture in the mean time that a picture is waited for."""


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


class FrameRenderer(Protocol):
    """Renders pictures; `AHEAD` may be begun and not yet taken."""

    def wait_until_ready(self) -> None:
        """Wait until pictures can be begun; called once, before the first."""
        ...

    def begin(self, t_first_row_s: float) -> None:
        """Begin the picture whose first row begins at a time, seconds since the world's start."""
        ...

    def finish(self) -> ImageArray:
        """Return the picture begun earliest."""
        ...

    def close(self) -> None:
        """Let go of everything."""
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
        renderer: FrameRenderer,
        schedule: Schedule,
        clock: NodeClock,
    ) -> None:
        """Prepare.

        Args:
            name: of the camera.
            camera: its configuration.
            renderer: makes its pictures.
            schedule: when its frames happen.
            clock: the node's own clock.
        """
        self._name = name
        self._camera = camera
        self._renderer = renderer
        self._schedule = schedule
        self._clock = clock
        self._pacer = Pacer(TrueClock())
        self._world_start_ns = 0
        self._number = 0
        self._stride = Stride()
        self._begun: deque[tuple[int, FrameMoment]] = deque()
        self._drawing_s = 0.0
        self._is_ready = False
        self._picture: Mapping[str, float] = {name: getattr(camera, name) for name in PICTURE_NEUTRAL}

    @classmethod
    def from_rig(cls, name: str, rig: Rig, clock: NodeClock) -> SimulatedSource:
        """Build the source of a simulated camera: rendered with its true geometry, not with what calibration found."""
        from rhot_sim.rig.schedule import FrameSchedule  # noqa: PLC0415

        cameras = rig.config.cameras
        camera = cameras[name]
        schedule = FrameSchedule(name, list(cameras).index(name), camera, rig.config.sim)
        return cls(name, camera, RenderProcess(rig.path, name, camera.width, camera.height), schedule, clock)

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Let the world begin at a moment; late, join at the frame that is due next."""
        self._pacer.restart()
        # The world begins at the broadcast start time itself where it is known: were it read off the node's clock,
        # errors of the clock exchange would shift the world along and could not be seen.
        self._world_start_ns = self._true_ns(start_ns) if start_t_ns is None else start_t_ns
        passed_s = 1e-9 * (self._pacer.now_ns() - self._world_start_ns)
        self._number = self._schedule.first_after(passed_s) if passed_s > 0.0 else 0

    def read(self) -> Frame | None:
        """Wait until the next frame is due and return it; the ones after it are begun by then."""
        if not self._wait_for_renderer():
            return None
        while True:
            self._begin_ahead()
            image = self._finish()
            if image is None:
                return None
            number, moment = self._begun.popleft()
            if self._is_late(moment, 0.0):
                # The machine was too busy; a camera would have delivered this frame long ago.
                continue
            self._begin_ahead()
            if not self._pacer.wait_until(self._due_ns(moment)):
                return None
            break
        return Frame(
            with_picture(image, self._picture),
            number,
            self._node_ns(self._world_start_ns + round(1e9 * moment.t_first_row_s)),
            self._camera.exposure_s,
            self._camera.readout_s,
        )

    def _wait_for_renderer(self) -> bool:
        """Wait until pictures can be drawn; return False when closed meanwhile.

        Nothing is asked for before: pictures for the time of loading would be late, and the time of loading is none of
        drawing, by which late frames are told.
        """
        try:
            if not self._is_ready:
                self._renderer.wait_until_ready()
                self._is_ready = True
        except DeviceError:
            if not self._pacer.stopped:
                raise
        return self._is_ready

    def _begin_ahead(self) -> None:
        """Begin to render the next frames that are not lost and can be ready in time, a batch at a time."""
        if len(self._begun) > AHEAD - BATCH:
            return
        batch: list[tuple[int, FrameMoment]] = []
        while len(self._begun) + len(batch) < AHEAD and not self._pacer.stopped:
            number, moment = self._number, self._schedule.frame(self._number)
            self._number = self._stride.next_after(number)
            if moment.dropped:
                continue
            # Where rendering does not keep up, frames fall out as they would from a camera that nobody empties.
            late = self._is_late(moment, (len(self._begun) + len(batch)) * self._drawing_s)
            if self._stride.count(late):
                self._tell_rate()
            if not late:
                batch.append((number, moment))
        if batch:
            self._renderer.begin(*(moment.t_first_row_s for _, moment in batch))
            self._begun.extend(batch)

    def _tell_rate(self) -> None:
        rate_hz = self._camera.rate_hz
        if self._stride.value == 1:
            logger.info("camera %s: all %g pictures a second are drawn again", self._name, rate_hz)
        else:
            logger.warning(
                "camera %s: this machine is too busy to draw %g pictures a second; the simulated camera runs at %g Hz",
                self._name,
                rate_hz,
                rate_hz / self._stride.value,
            )

    def _finish(self) -> ImageArray | None:
        since_s = time.monotonic()
        try:
            image = self._renderer.finish() if self._begun and not self._pacer.stopped else None
        except DeviceError:
            if self._pacer.stopped:
                return None
            raise
        self._drawing_s += _FORGETTING * (time.monotonic() - since_s - self._drawing_s)
        return image

    def apply(self, settings: CameraSettings) -> None:
        """Take saturation, contrast and brightness; the simulated light is what it is.

        Raises:
            ConfigError: exposure, gain, white balance or focus are to change.
        """
        if not settings.same_lens_and_sensor(CameraSettings.from_config(self._camera, ColorsFile(markers={}))):
            raise ConfigError(
                f"camera {self._name} is simulated: exposure, gain, white balance and focus follow rig.toml; only "
                "saturation, contrast, brightness and colours can change while it runs"
            )
        self._picture = settings.picture

    def close(self) -> None:
        """Stop; a waiting `read` returns None."""
        self._pacer.stop()
        self._renderer.close()

    def _due_ns(self, moment: FrameMoment) -> int:
        return self._world_start_ns + round(1e9 * moment.delivered_s)

    def _is_late(self, moment: FrameMoment, ready_in_s: float) -> bool:
        ready_ns = self._pacer.now_ns() + round(1e9 * (ready_in_s - 1.0 / self._camera.rate_hz))
        return self._due_ns(moment) < ready_ns

    def _node_ns(self, true_ns: int) -> int:
        if isinstance(self._clock, SkewedClock):
            return self._clock.from_true_ns(true_ns)
        return true_ns + difference_ns(self._clock.now_ns, self._pacer.now_ns)

    def _true_ns(self, node_ns: int) -> int:
        true_ns = node_ns + difference_ns(self._pacer.now_ns, self._clock.now_ns)
        if isinstance(self._clock, SkewedClock):
            # One correction leaves drift² of the error: nothing.
            true_ns += node_ns - self._clock.from_true_ns(true_ns)
        return true_ns
