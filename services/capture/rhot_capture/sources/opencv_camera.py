"""What cameras behind OpenCV's `VideoCapture` share: who may read, when one counts as gone, how it is released."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any, Final

import cv2

from rhot.errors import DeviceError
from rhot.rig.config import CameraConfig
from rhot_capture.drift import Drift
from rhot_capture.sources.frame import Frame

_SILENCE_S: Final = 3.0
"""Time without a frame after which a camera counts as disconnected; useful cameras deliver at least 5 Hz."""
_LOOK_S: Final = 1.0
"""Between two looks at how far unlocked settings have drifted."""


class OpenCvCamera(ABC):
    """Reads and releases; a kind of camera opens its `_capture` and says in `_grab` what a frame is."""

    def __init__(
        self,
        name: str,
        camera: CameraConfig,
        opencv: ModuleType | Any = cv2,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        """Prepare; `open` touches the device.

        Args:
            name: of the camera.
            camera: its configuration.
            opencv: the module that provides `VideoCapture`; replaced in tests.
            now_ns: the monotonic clock.
        """
        self._name = name
        self._camera = camera
        self._cv = opencv
        self._now_ns = now_ns
        self._capture: Any = None
        self._start_ns = 0
        self._index = -1
        self.refused: Sequence[str] = ()
        self._drift = Drift()
        self._look_ns = 0
        self._closing = threading.Event()
        # `release` frees OpenCV's buffers, so it must not run during a `read` on another thread.
        self._reading = threading.Lock()
        self._setting = threading.Lock()

    @property
    def problem(self) -> str:
        """Settings that the driver refused, and how far the picture has drifted since; empty when none."""
        if not self.refused:
            return ""
        return (
            f"camera {self._name}: its driver refused {', '.join(self.refused)}; in this session its brightness has "
            f"drifted by {100 * self._drift.brightness:+.0f} %, its colours by {100 * self._drift.colour:.0f} % "
            "(docs/use.md: what that costs)"
        )

    def read(self) -> Frame | None:
        """Wait for the next frame; None after `close`, and at the end of a file.

        Raises:
            DeviceError: the camera delivers no more.
        """
        failed, begun_ns = 0, self._now_ns()
        while not self._closing.is_set():
            with self._reading:
                if self._capture is None:
                    return None
                frame = self._grab(self._capture)
            if frame is None:
                if self._ends():
                    return None
                failed += 1
                silent_s = 1e-9 * (self._now_ns() - begun_ns)
                # Consecutive failed reads after which a camera counts as disconnected.
                if not self._closing.is_set() and (failed >= 5 or silent_s >= _SILENCE_S):
                    raise DeviceError(
                        f"camera {self._name}: {self._camera.device} stopped delivering {silent_s:.1f} s ago; "
                        "unplugged, or short of USB bandwidth (try a lower rate_hz or another port)"
                    )
                continue
            failed, begun_ns = 0, self._now_ns()
            if frame.t_first_row_ns >= self._start_ns:
                if self.refused and frame.t_first_row_ns >= self._look_ns:
                    self._drift.see(frame.image)
                    self._look_ns = frame.t_first_row_ns + round(1e9 * _LOOK_S)
                return frame
        return None

    def close(self) -> None:
        """Release the device, after a read in progress has ended."""
        self._closing.set()
        with self._reading, self._setting:
            capture, self._capture = self._capture, None
            self._release()
            if capture is not None:
                capture.release()

    def _begin(self, start_ns: int) -> None:
        """Begin a session."""
        self._closing.clear()
        self._start_ns, self._index, self.refused = start_ns, -1, ()
        self._compare_anew()

    def _compare_anew(self) -> None:
        """Compare with the pictures from here on: the settings were changed on purpose."""
        self._drift, self._look_ns = Drift(), 0

    def _device(self) -> int | str:
        device = self._camera.device
        return int(device) if isinstance(device, str) and device.isdecimal() else device

    @abstractmethod
    def _grab(self, capture: Any) -> Frame | None:
        """Wait for a frame and return it; None if none arrives within OpenCV's timeout."""

    def _ends(self) -> bool:
        """Return whether a read without a frame is the end of the input."""
        return False

    def _release(self) -> None:  # noqa: B027  # most hold nothing else
        """Release what is held beside the capture."""
