"""USB and other Video4Linux cameras through OpenCV, with settings locked as far as the driver allows."""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import cv2
import numpy as np

from rhot.errors import ConfigError, DeviceError, RhotError
from rhot.rig.config import CameraConfig
from rhot.rig.sections import PICTURE_NEUTRAL
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.frame import Frame
from rhot_capture.sources.opencv_camera import OpenCvCamera
from rhot_capture.sources.v4l2.controls import (
    AUTOGAIN,
    IDENTIFIERS,
    UNUSABLE,
    VIDIOC_QUERYCTRL,
    VIDIOC_S_CTRL,
    ControlRange,
    DriverControls,
    V4l2Control,
    V4l2QueryControl,
)

# V4L2 queries that OpenCV does not offer: meaning of a frame's timestamp, frame number, range of a control.
#
# `VIDIOC_QUERYBUF` works on any handle of the device, also while another one streams ("anyone can query buffers":
# `vb2_ioctl_querybuf` in the kernel's videobuf2-v4l2.c). `struct v4l2_buffer` and its flags are from the kernel's
# `linux/videodev2.h`.

VIDIOC_QUERYBUF: Final = 0xC0585609
"""`_IOWR('V', 9, struct v4l2_buffer)` with 64-bit longs, as everywhere where RHOT runs."""
SOURCE_MASK: Final = 0x00070000
"""`V4L2_BUF_FLAG_TSTAMP_SRC_MASK`."""
START_OF_EXPOSURE: Final = 0x00010000
"""`V4L2_BUF_FLAG_TSTAMP_SRC_SOE`; 0 in these bits is the end of the frame."""


class V4l2Buffer(ctypes.Structure):
    """`struct v4l2_buffer`."""

    index: int
    flags: int
    seconds: int
    microseconds: int
    sequence: int

    _fields_ = (
        ("index", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("bytesused", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("field", ctypes.c_uint32),
        ("seconds", ctypes.c_int64),
        ("microseconds", ctypes.c_int64),
        ("timecode", ctypes.c_uint8 * 16),
        ("sequence", ctypes.c_uint32),
        ("memory", ctypes.c_uint32),
        ("m", ctypes.c_uint64),
        ("length", ctypes.c_uint32),
        ("reserved2", ctypes.c_uint32),
        ("request_fd", ctypes.c_uint32),
    )


def stamps_arrival(device: str, sysfs: Path = Path("/sys")) -> bool:
    """Return whether a driver stamps a frame when its first packet arrives, contrary to the buffer's flags.

    uvcvideo labels all its stamps as the start of the exposure, but computes that only with its parameter
    `hwtimestamps`, which is off by default (kernel, uvc_video.c: `uvc_video_decode_start`, `uvc_video_clock_update`).

    Args:
        device: path, such as `/dev/video0` or a link to it.
        sysfs: where the kernel shows its drivers.
    """
    driver = (sysfs / "class/video4linux" / Path(device).resolve().name / "device/driver").resolve().name
    if driver != "uvcvideo":
        return False
    try:
        return (sysfs / "module/uvcvideo/parameters/hwtimestamps").read_text().strip() == "0"
    except OSError:
        return False


if sys.platform == "linux":
    from fcntl import ioctl as kernel_ioctl
else:

    def kernel_ioctl(handle: int, request: int, argument: object) -> object:
        """Refuse: only Linux has Video4Linux; `open_source` lets nobody come here."""
        raise OSError(f"{sys.platform} has no Video4Linux")


Ioctl = Callable[[int, int, V4l2Buffer | V4l2Control | V4l2QueryControl], object]


class BufferQuery:
    """Queries a device's buffers and controls; None if the driver does not answer (multi-planar devices)."""

    def __init__(self, device: str, ioctl: Ioctl = kernel_ioctl) -> None:
        """Open a further handle of a device.

        Args:
            device: path, such as `/dev/video0`.
            ioctl: replaced in tests.

        Raises:
            OSError: it cannot be opened.
        """
        self._ioctl = ioctl
        self._handle = os.open(device, os.O_RDWR | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))

    def stamps_mark_start(self) -> bool | None:
        """Return whether the driver's timestamps mark the start of the exposure; None if unknown."""
        buffer = self._query(0)
        return None if buffer is None else buffer.flags & SOURCE_MASK == START_OF_EXPOSURE

    def sequence(self, stamp_us: int) -> int | None:
        """Return the driver's number of a grabbed frame that is not yet returned; a gap means lost frames.

        Args:
            stamp_us: the frame's timestamp, which identifies its buffer.
        """
        # OpenCV's `MAX_V4L_BUFFERS`.
        for index in range(10):
            buffer = self._query(index)
            if buffer is None:
                return None
            if buffer.seconds * 1_000_000 + buffer.microseconds == stamp_us:
                return int(buffer.sequence)
        return None

    def control_range(self, field: str) -> ControlRange | None:
        """Return the range of `brightness`, `contrast` or `saturation`; None where the driver has no such control."""
        return self._control(IDENTIFIERS[field])

    def lock_gain(self) -> bool:
        """Switch off the automatic gain; False where the driver refuses, True also where it has none."""
        if self._control(AUTOGAIN) is None:
            return True
        try:
            self._ioctl(self._handle, VIDIOC_S_CTRL, V4l2Control(AUTOGAIN, 0))
        except OSError:
            return False
        return True

    def _control(self, identifier: int) -> ControlRange | None:
        query = V4l2QueryControl(id=identifier)
        try:
            self._ioctl(self._handle, VIDIOC_QUERYCTRL, query)
        except OSError:
            return None
        if query.flags & UNUSABLE or query.minimum >= query.maximum:
            return None
        return ControlRange(query.minimum, query.maximum, query.default_value)

    def close(self) -> None:
        """Close the handle; closing twice does no harm."""
        handle, self._handle = self._handle, -1
        if handle >= 0:
            os.close(handle)

    def _query(self, index: int) -> V4l2Buffer | None:
        # `V4L2_BUF_TYPE_VIDEO_CAPTURE`.
        # `V4L2_MEMORY_MMAP`, which OpenCV uses.
        buffer = V4l2Buffer(index=index, type=1, memory=1)
        try:
            self._ioctl(self._handle, VIDIOC_QUERYBUF, buffer)
        except OSError:
            return None
        return buffer


_LOG = logging.getLogger(__name__)

_SELECT_LIMIT: Final = ("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "1")
"""Seconds after which OpenCV stops waiting for a frame (default 10); it reads this environment variable once."""


class V4l2Source(OpenCvCamera):
    """A camera behind `/dev/video*`.

    Frames carry the driver's own timestamp (monotonic clock), which by its label marks the start of the exposure (as of
    uvcvideo: kernel commit c767492a58fd) or the end of the frame; uvcvideo without `hwtimestamps` stamps the first
    packet, which comes when the first row has been exposed. Where the driver gives no time that can be true, the time
    of arrival less read-out and exposure counts, which is late by the transfer.
    """

    def __init__(
        self,
        name: str,
        camera: CameraConfig,
        opencv: ModuleType | Any = cv2,
        now_ns: Callable[[], int] = time.monotonic_ns,
        query: Callable[[str], BufferQuery] = BufferQuery,
        stamps_arrival: Callable[[str], bool] = stamps_arrival,
    ) -> None:
        """Prepare; `open` touches the device.

        Args:
            name: of the camera.
            camera: its configuration.
            opencv: the module that provides `VideoCapture`; replaced in tests.
            now_ns: the monotonic clock.
            query: asks the driver of its buffers; replaced in tests.
            stamps_arrival: whether a device's driver stamps the arrival of the first packet; replaced in tests.
        """
        super().__init__(name, camera, opencv, now_ns)
        self._query = query
        self._stamps_arrival = stamps_arrival
        self._buffers: BufferQuery | None = None
        self._stamps = "end of frame"
        self._asked_exposure_s = self._exposure_s = camera.exposure_s
        self._picture: dict[str, float] = dict(PICTURE_NEUTRAL)
        self._period_ns = round(1e9 / camera.rate_hz)
        self._last: tuple[int | None, int | None] = None, None
        self._trusts_driver = True

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Open and lock the camera; frames before `start_ns` are discarded.

        Raises:
            DeviceError: no such device, or it does not deliver the size in `rig.toml`.
        """
        os.environ.setdefault(*_SELECT_LIMIT)
        self._begin(start_ns)
        self._last = None, None
        try:
            self._capture = self._cv.VideoCapture(self._device(), self._cv.CAP_V4L2)
            if not self._capture.isOpened():
                raise DeviceError(
                    f"camera {self._name}: cannot open {self._camera.device}; is it plugged in, not in use by another "
                    "program, and readable (group video)? `v4l2-ctl --list-devices` lists what there is"
                )
            self._configure()
        except BaseException as error:
            self.close()
            if isinstance(error, RhotError) or not isinstance(error, Exception):
                raise
            raise DeviceError(f"camera {self._name}: {self._camera.device}: {type(error).__name__}: {error}") from error

    def apply(self, settings: CameraSettings) -> None:
        """Set exposure and picture while running.

        Raises:
            ConfigError: a setting that V4L2 has no unit for, or an exposure that the driver refuses.
            DeviceError: the camera is not open.
        """
        camera = self._camera
        asked = (settings.gain, settings.white_balance, settings.focus_dioptres)
        if asked != (camera.gain, camera.white_balance, camera.focus_dioptres):
            raise ConfigError(
                f"camera {self._name}: gain, white_balance and focus_dioptres mean nothing to a V4L2 driver, which has "
                "units of its own; set gain, white_balance_temperature or focus_absolute in [cameras."
                f"{self._name}.v4l2_controls] of rig.toml (`v4l2-ctl --list-ctrls` shows their ranges)"
            )
        with self._setting:
            if self._capture is None:
                raise DeviceError(f"camera {self._name}: not open; start it first")
            controls = DriverControls(self._cv, self._capture)
            refused = self._set_picture(controls, settings.picture)
            # What was refused at the start is in the status; it must not stand in the way of other changes.
            changes_exposure = settings.exposure_s != self._asked_exposure_s
            if changes_exposure and not refused and (refused := controls.set_exposure(settings.exposure_s)):
                controls.set_exposure(self._exposure_s)
            if refused:
                raise ConfigError(f"camera {self._name}: the driver of {camera.device} refuses {', '.join(refused)}")
            self._compare_anew()
            if changes_exposure:
                self._asked_exposure_s = settings.exposure_s
                self._exposure_s = controls.exposure_s(settings.exposure_s)

    def _release(self) -> None:
        buffers, self._buffers = self._buffers, None
        if buffers is not None:
            buffers.close()

    def _configure(self) -> None:
        camera, controls = self._camera, DriverControls(self._cv, self._capture)
        # The format comes first: size and rate depend on it. Raw YUYV at 60 Hz does not fit through USB 2.
        motion_jpeg = float(self._cv.VideoWriter_fourcc(*"MJPG"))
        refused = []
        if controls.set("", "CAP_PROP_FOURCC", motion_jpeg):
            got_format = max(0, int(controls.value("CAP_PROP_FOURCC"))).to_bytes(8, "little")[:4]
            refused.append(f"pixel format MJPG (driver says {got_format.decode('ascii', 'replace')})")
        self._capture.set(self._cv.CAP_PROP_BUFFERSIZE, 2.0)
        for name, value in (("FRAME_WIDTH", camera.width), ("FRAME_HEIGHT", camera.height)):
            self._capture.set(getattr(self._cv, f"CAP_PROP_{name}"), float(value))
        got = (int(controls.value("CAP_PROP_FRAME_WIDTH")), int(controls.value("CAP_PROP_FRAME_HEIGHT")))
        if got != (camera.width, camera.height):
            raise DeviceError(
                f"camera {self._name}: {camera.device} delivers {got[0]}x{got[1]} instead of "
                f"{camera.width}x{camera.height}; set width and height in rig.toml to a size that it has "
                "(`v4l2-ctl --list-formats-ext`)"
            )
        refused += controls.set(f"rate_hz = {camera.rate_hz:g}", "CAP_PROP_FPS", camera.rate_hz)
        rate_hz = controls.value("CAP_PROP_FPS")
        self._period_ns = round(1e9 / (rate_hz if rate_hz > 0.0 else camera.rate_hz))
        self._ask_for_stamps()
        if self._buffers is not None and not self._buffers.lock_gain():
            refused.append("manual gain")
        refused += controls.lock(camera)
        self._picture = dict(PICTURE_NEUTRAL)
        asked = {name: getattr(camera, name) for name in PICTURE_NEUTRAL}
        for name, value in asked.items():
            refused += self._set_picture(controls, {**self._picture, name: value})
        # Reported once in the status; later changes of other settings must not fail because of it.
        self._picture = asked
        self._asked_exposure_s = camera.exposure_s
        self._exposure_s = controls.exposure_s(camera.exposure_s)
        self.refused = refused
        if refused:
            _LOG.warning(
                "camera %s: the driver of %s refused %s; colours and times may drift",
                self._name, camera.device, ", ".join(refused),
            )  # fmt: skip
        if left := controls.unset(camera):
            _LOG.warning(
                "camera %s: V4L2 has no units for gain, white balance and focus, so %s; set what you want in "
                "[cameras.%s.v4l2_controls] of rig.toml",
                self._name, left, self._name,
            )  # fmt: skip

    def _set_picture(self, controls: DriverControls, picture: Mapping[str, float]) -> list[str]:
        """Set the changed picture settings; return those that the driver refused, in which case none is changed."""
        ranges: Callable[[str], ControlRange | None] = (
            self._buffers.control_range if self._buffers is not None else lambda _: None
        )
        changes = {name: value for name, value in picture.items() if value != self._picture[name]}
        refused = controls.set_picture(self._camera, changes, ranges)
        if refused:
            controls.set_picture(self._camera, {name: self._picture[name] for name in changes}, ranges)
        else:
            self._picture = dict(picture)
        return refused

    def _ask_for_stamps(self) -> None:
        path = self._camera.video_path
        try:
            self._buffers = self._query(path)
        except OSError as error:
            _LOG.warning("camera %s: what its timestamps mark is not known: %s", self._name, error)
        marks_start = self._buffers is not None and self._buffers.stamps_mark_start()
        self._stamps = "end of frame" if not marks_start else "arrival" if self._stamps_arrival(path) else "start"

    def _grab(self, capture: Any) -> Frame | None:
        """Wait for a frame and return it; None if none arrives within OpenCV's timeout."""
        if not capture.grab():
            return None
        arrived_ns = self._now_ns()
        stamp_ns = self._stamp_ns(capture, arrived_ns)
        # Between grab and retrieve the buffer is not in the driver's queue and keeps its number.
        number = None if self._buffers is None or stamp_ns is None else self._buffers.sequence(stamp_ns // 1000)
        ok, image = capture.retrieve()
        if not ok:
            return None
        self._count(number, stamp_ns)
        scan_ns, exposure_ns = round(1e9 * self._camera.readout_s), round(1e9 * self._exposure_s)
        if stamp_ns is None:
            first_row_ns = arrived_ns - scan_ns - exposure_ns
        else:
            late_ns = {"start": 0, "arrival": exposure_ns, "end of frame": scan_ns + exposure_ns}
            first_row_ns = stamp_ns - late_ns[self._stamps]
        return Frame(
            np.asarray(image, dtype=np.uint8), self._index, first_row_ns, self._exposure_s, self._camera.readout_s
        )

    def _stamp_ns(self, capture: Any, arrived_ns: int) -> int | None:
        """Return the driver's timestamp of the grabbed frame; None if it is implausible."""
        stamp_ns = 1000 * round(1e3 * float(capture.get(self._cv.CAP_PROP_POS_MSEC)))
        age_s = 1e-9 * (arrived_ns - stamp_ns)
        max_timestamp_age_s = 2.0
        # A driver that computes the end of a frame from its rate can be ahead by a frame (vivid).
        if -1e-9 * self._period_ns <= age_s <= max_timestamp_age_s:
            return stamp_ns
        if self._trusts_driver:
            self._trusts_driver = False
            _LOG.warning(
                "camera %s: the driver's timestamp is %.3f s away from the monotonic clock; times of arrival count",
                self._name,
                age_s,
            )
        return None

    def _count(self, number: int | None, stamp_ns: int | None) -> None:
        """Update the frame index, from the driver's number or else from the time between frames."""
        last_number, last_ns = self._last
        self._last = number, stamp_ns
        if number is not None and last_number is not None:
            step = number - last_number
        elif stamp_ns is not None and last_ns is not None:
            step = round((stamp_ns - last_ns) / self._period_ns)
        else:
            step = 1
        self._index += max(1, step)
