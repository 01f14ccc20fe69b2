"""USB and other Video4Linux cameras through OpenCV, locked as far as the driver lets itself be locked.

Drivers take a setting and quietly do something else, so each one is read back: a wrong size is an error, because
calibration depends on it; everything else that was refused is named in one warning.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Final

import cv2
import numpy as np

from rhot.errors import DeviceError
from rhot.rig.config import CameraConfig
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.frame import Frame

_LOG = logging.getLogger(__name__)

_MANUAL_EXPOSURE: Final = 1.0
"""`V4L2_EXPOSURE_MANUAL` of the kernel's `V4L2_CID_EXPOSURE_AUTO` menu."""
_EXPOSURE_UNIT_S: Final = 1e-4
"""`V4L2_CID_EXPOSURE_ABSOLUTE` counts in 100 µs."""
_MAX_TIMESTAMP_AGE_S: Final = 2.0
_TOLERANCE: Final = 0.1
_MAX_FAILED_READS: Final = 5


@dataclass(frozen=True, slots=True)
class _Setting:
    name: str
    property_name: str
    value: float


class V4l2Source:
    """A camera behind `/dev/video*`.

    Frames carry the driver's own timestamp (monotonic clock, when the first row arrived, which for a rolling
    shutter is the end of its exposure); where the driver gives none that can be true, the time of arrival less the
    read-out counts, which is late by the transfer.
    """

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
        self._exposure_s = camera.exposure_s
        self._start_ns = 0
        self._index = 0
        self._trusts_driver = True
        self._closing = threading.Event()

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Open and lock the camera; frames before `start_ns` are thrown away.

        Raises:
            DeviceError: no such device, or it does not deliver the size in `rig.toml`.
        """
        self._closing.clear()
        self._start_ns = start_ns
        self._index = 0
        device = self._device()
        capture = self._cv.VideoCapture(device, self._cv.CAP_V4L2)
        if not capture.isOpened():
            raise DeviceError(
                f"camera {self._name}: cannot open {self._camera.device}; is it plugged in, not in use by another "
                "program, and readable (group video)? `v4l2-ctl --list-devices` lists what there is"
            )
        self._capture = capture
        try:
            self._configure()
        except BaseException:
            self.close()
            raise

    def read(self) -> Frame | None:
        """Wait for the next frame.

        Raises:
            DeviceError: the camera delivers no more.
        """
        failed = 0
        while not self._closing.is_set():
            capture = self._capture
            if capture is None:
                return None
            ok, image = capture.read()
            arrived_ns = self._now_ns()
            if not ok:
                failed += 1
                if self._closing.is_set():
                    return None
                if failed >= _MAX_FAILED_READS:
                    raise DeviceError(
                        f"camera {self._name}: {self._camera.device} stopped delivering; unplugged, or short of USB "
                        "bandwidth (try a lower rate_hz or another port)"
                    )
                continue
            failed = 0
            t_first_row_ns = self._first_row_ns(arrived_ns)
            self._index += 1
            if t_first_row_ns >= self._start_ns:
                return Frame(
                    np.asarray(image, dtype=np.uint8),
                    self._index - 1,
                    t_first_row_ns,
                    self._exposure_s,
                    self._camera.readout_s,
                )
        return None

    def apply(self, settings: CameraSettings) -> None:
        """Set exposure, gain and focus while running.

        Raises:
            DeviceError: the camera is not open.
        """
        if self._capture is None:
            raise DeviceError(f"camera {self._name}: not open; start it first")
        self._exposure_s = settings.exposure_s
        self._lock(settings.exposure_s, settings.gain, settings.focus_dioptres)

    def close(self) -> None:
        """Free the device."""
        self._closing.set()
        capture, self._capture = self._capture, None
        if capture is not None:
            capture.release()

    def _device(self) -> int | str:
        device = self._camera.device
        return int(device) if isinstance(device, str) and device.isdecimal() else device

    def _configure(self) -> None:
        camera = self._camera
        # The format comes first: size and rate depend on it. Raw YUYV at 60 Hz does not fit through USB 2.
        self._set("pixel format MJPG", "CAP_PROP_FOURCC", float(self._cv.VideoWriter_fourcc(*"MJPG")))
        self._capture.set(self._cv.CAP_PROP_BUFFERSIZE, 2.0)
        for name, value in (("FRAME_WIDTH", camera.width), ("FRAME_HEIGHT", camera.height)):
            self._capture.set(getattr(self._cv, f"CAP_PROP_{name}"), float(value))
        got = (
            int(self._capture.get(self._cv.CAP_PROP_FRAME_WIDTH)),
            int(self._capture.get(self._cv.CAP_PROP_FRAME_HEIGHT)),
        )
        if got != (camera.width, camera.height):
            raise DeviceError(
                f"camera {self._name}: {camera.device} delivers {got[0]}x{got[1]} instead of "
                f"{camera.width}x{camera.height}; set width and height in rig.toml to a size that it has "
                "(`v4l2-ctl --list-formats-ext`)"
            )
        refused = self._refused(_Setting(f"rate_hz = {camera.rate_hz:g}", "CAP_PROP_FPS", camera.rate_hz))
        self._warn(refused)
        self._lock(camera.exposure_s, camera.gain, camera.focus_dioptres)

    def _lock(self, exposure_s: float, gain: float, focus_dioptres: float | None) -> None:
        settings = [
            _Setting("manual exposure", "CAP_PROP_AUTO_EXPOSURE", _MANUAL_EXPOSURE),
            _Setting(f"exposure_s = {exposure_s:g}", "CAP_PROP_EXPOSURE", exposure_s / _EXPOSURE_UNIT_S),
            _Setting(f"gain = {gain:g}", "CAP_PROP_GAIN", gain),
            _Setting("manual white balance", "CAP_PROP_AUTO_WB", 0.0),
        ]
        if focus_dioptres is not None:
            settings += [
                _Setting("manual focus", "CAP_PROP_AUTOFOCUS", 0.0),
                _Setting(f"focus_dioptres = {focus_dioptres:g}", "CAP_PROP_FOCUS", focus_dioptres),
            ]
        self._warn([name for setting in settings for name in self._refused(setting)])

    def _set(self, name: str, property_name: str, value: float) -> None:
        self._warn(self._refused(_Setting(name, property_name, value)))

    def _refused(self, setting: _Setting) -> list[str]:
        identifier = getattr(self._cv, setting.property_name)
        accepted = bool(self._capture.set(identifier, setting.value))
        got = float(self._capture.get(identifier))
        if accepted and abs(got - setting.value) <= _TOLERANCE * max(abs(setting.value), 1e-9):
            return []
        return [f"{setting.name} (driver says {got:g})" if accepted else setting.name]

    def _warn(self, refused: list[str]) -> None:
        if refused:
            _LOG.warning(
                "camera %s: the driver of %s refused %s; colours and times may drift",
                self._name,
                self._camera.device,
                ", ".join(refused),
            )

    def _first_row_ns(self, arrived_ns: int) -> int:
        stamped_ns = round(1e6 * float(self._capture.get(self._cv.CAP_PROP_POS_MSEC)))
        age_s = 1e-9 * (arrived_ns - stamped_ns)
        if 0.0 <= age_s <= _MAX_TIMESTAMP_AGE_S:
            return stamped_ns - round(1e9 * self._exposure_s)
        if self._trusts_driver:
            self._trusts_driver = False
            _LOG.warning(
                "camera %s: the driver's timestamp is %.3f s away from the monotonic clock; times of arrival count",
                self._name,
                age_s,
            )
        return arrived_ns - round(1e9 * (self._camera.readout_s + self._exposure_s))
