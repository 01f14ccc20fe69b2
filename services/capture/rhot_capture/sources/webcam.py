"""Cameras of any system through OpenCV's own choice of driver: for Windows and macOS, which have no Video4Linux.

OpenCV's drivers there (Media Foundation, DirectShow, AVFoundation) give no times, and lock what they please: each
setting is asked for, read back, and reported where it was not taken.
"""

from __future__ import annotations

import logging
import math
from typing import Any, Final

import numpy as np

from rhot.errors import ConfigError, DeviceError
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.frame import Frame
from rhot_capture.sources.opencv_camera import OpenCvCamera

logger = logging.getLogger(__name__)

_MANUAL: Final = 0.25
"""CAP_PROP_AUTO_EXPOSURE of Media Foundation and DirectShow: 0.25 manual, 0.75 automatic (OpenCV's cap_dshow.cpp)."""
_TOLERANCE: Final = 0.51
"""Of the exposure in powers of two: drivers have whole ones."""


class WebcamSource(OpenCvCamera):
    """A camera by its number, or a video file by its path.

    A frame's time is that of its arrival less read-out and exposure: late by the transfer, which nobody states here.
    """

    _last_ns: int | None = None

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Open and lock the camera; frames before `start_ns` are discarded.

        Raises:
            DeviceError: no such camera, or it does not deliver the size in `rig.toml`.
        """
        self._begin(start_ns)
        self._last_ns = None
        self._capture = self._cv.VideoCapture(self._device())
        if not self._capture.isOpened():
            self.close()
            raise DeviceError(
                f"camera {self._name}: cannot open {self._camera.device}; is it plugged in, not in use by another "
                "program, and allowed to programs in the system's privacy settings?"
            )
        try:
            self._configure(self._capture)
        except DeviceError:
            self.close()
            raise

    def apply(self, settings: CameraSettings) -> None:
        """Set the exposure while running.

        Raises:
            ConfigError: another setting, or an exposure that the driver refuses.
            DeviceError: the camera is not open.
        """
        camera = self._camera
        others = ("gain", "white_balance", "focus_dioptres", "saturation", "contrast", "brightness")
        changed = [name for name in others if getattr(settings, name) != getattr(camera, name)]
        if changed:
            raise ConfigError(f"camera {self._name}: a webcam's driver has no units for {', '.join(changed)}")
        with self._setting:
            if self._capture is None:
                raise DeviceError(f"camera {self._name}: not open; start it first")
            if not self._set_exposure(self._capture, settings.exposure_s):
                self._set_exposure(self._capture, camera.exposure_s)
                raise ConfigError(f"camera {self._name}: its driver refuses exposure_s = {settings.exposure_s:g}")
            self._compare_anew()

    def _ends(self) -> bool:
        return isinstance(self._device(), str)

    def _grab(self, capture: Any) -> Frame | None:
        ok, image = capture.read()
        return self._frame(np.asarray(image, dtype=np.uint8), self._now_ns()) if ok else None

    def _configure(self, capture: Any) -> None:
        camera, cv = self._camera, self._cv
        capture.set(cv.CAP_PROP_FRAME_WIDTH, float(camera.width))
        capture.set(cv.CAP_PROP_FRAME_HEIGHT, float(camera.height))
        got = int(capture.get(cv.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv.CAP_PROP_FRAME_HEIGHT))
        if got != (camera.width, camera.height):
            raise DeviceError(
                f"camera {self._name}: {camera.device} delivers {got[0]}x{got[1]} instead of "
                f"{camera.width}x{camera.height}; set width and height in rig.toml to a size that it has"
            )
        refused = []
        capture.set(cv.CAP_PROP_FPS, camera.rate_hz)
        if abs(capture.get(cv.CAP_PROP_FPS) - camera.rate_hz) > 1.0:
            refused.append(f"rate_hz = {camera.rate_hz:g} (it is {capture.get(cv.CAP_PROP_FPS):g})")
        if not capture.set(cv.CAP_PROP_AUTO_EXPOSURE, _MANUAL) or not self._set_exposure(capture, camera.exposure_s):
            refused.append(f"exposure_s = {camera.exposure_s:g}")
        for what, control in (("white balance", cv.CAP_PROP_AUTO_WB), ("focus", cv.CAP_PROP_AUTOFOCUS)):
            if not capture.set(control, 0.0):
                refused.append(f"manual {what}")
        self.refused = refused
        if refused:
            logger.warning("camera %s: its driver refused %s; colours may drift", self._name, ", ".join(refused))

    def _set_exposure(self, capture: Any, exposure_s: float) -> bool:
        """Set the exposure, which these drivers take as a power of two; return whether it was taken."""
        asked = math.log2(exposure_s)
        taken = capture.set(self._cv.CAP_PROP_EXPOSURE, float(round(asked)))
        return bool(taken) and abs(capture.get(self._cv.CAP_PROP_EXPOSURE) - asked) <= _TOLERANCE

    def _frame(self, image: np.ndarray[Any, np.dtype[np.uint8]], arrived_ns: int) -> Frame:
        camera = self._camera
        # Frames that were lost on the way leave a gap in the numbers.
        gone_ns = 0 if self._last_ns is None else arrived_ns - self._last_ns
        self._index += max(1, round(1e-9 * gone_ns * camera.rate_hz))
        self._last_ns = arrived_ns
        first_row_ns = arrived_ns - round(1e9 * (camera.readout_s + camera.exposure_s))
        return Frame(image, self._index, first_row_ns, camera.exposure_s, camera.readout_s)
