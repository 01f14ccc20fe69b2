"""A V4L2 camera below OpenCV: what `VideoCapture` of its V4L2 back end does, and what `VIDIOC_QUERYBUF` says.

Follows opencv's `modules/videoio/src/cap_v4l.cpp` (4.x, 5.0) and the kernel's V4L2 documentation:

- `grab` waits in `select` for as many seconds as `OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT` says, 10 by default, and then
  returns False; a device that was pulled out fails at once. `retrieve` gives the buffer back to the driver.
- `release` unmaps the buffers (`releaseBuffers`): beside a running `grab` on another thread this is a use after free.
- `set` of a control calls VIDIOC_S_CTRL: the value is the driver's own integer, clamped to its range and step; `get` of
  a control that there is not returns -1. `CAP_PROP_AUTO_WB`, `CAP_PROP_GAIN` and `CAP_PROP_FOCUS` are
  V4L2_CID_AUTO_WHITE_BALANCE, V4L2_CID_GAIN and V4L2_CID_FOCUS_ABSOLUTE ("the unit is undefined").
- `POS_MSEC` is the timestamp of the buffer grabbed last. What it marks is in `v4l2_buffer.flags`: uvcvideo says start
  of exposure (V4L2_BUF_FLAG_TSTAMP_SRC_SOE, kernel commit c767492a58fd), the default is the end of the frame.
- `v4l2_buffer.sequence` counts frames, those included for which there was no buffer; videobuf2 clears it when a buffer
  goes back to the driver (`vb2_fill_vb2_v4l2_buffer`).
"""

from __future__ import annotations

import errno
import os
import threading
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, Final

import cv2
import numpy as np

from rhot_capture.sources.v4l2.controls import IDENTIFIERS, VIDIOC_QUERYCTRL, V4l2Control, V4l2QueryControl
from rhot_capture.sources.v4l2.source import START_OF_EXPOSURE, VIDIOC_QUERYBUF, BufferQuery, V4l2Buffer

_NAMES: Final = (
    "FOURCC",
    "BUFFERSIZE",
    "FRAME_WIDTH",
    "FRAME_HEIGHT",
    "FPS",
    "AUTO_EXPOSURE",
    "EXPOSURE",
    "GAIN",
    "AUTO_WB",
    "WB_TEMPERATURE",
    "AUTOFOCUS",
    "FOCUS",
    "BRIGHTNESS",
    "CONTRAST",
    "SATURATION",
    "SHARPNESS",
    "GAMMA",
    "BACKLIGHT",
    "POS_MSEC",
)


@dataclass
class Control:
    """One control of the driver, with the range that it is clamped to."""

    value: float
    low: float = 0.0
    high: float = 1.0


@dataclass
class Picture:
    """A frame that the camera has taken: its number and its timestamp."""

    sequence: int
    stamp_us: int


def uvc_controls() -> dict[str, Control]:
    """Controls of an ordinary webcam, everything automatic switched on."""
    return {
        "AUTO_EXPOSURE": Control(3.0, 0.0, 3.0),
        "EXPOSURE": Control(250.0, 3.0, 2047.0),
        "GAIN": Control(64.0, 0.0, 255.0),
        "AUTO_WB": Control(1.0),
        "WB_TEMPERATURE": Control(4000.0, 2800.0, 6500.0),
        "AUTOFOCUS": Control(1.0),
        "FOCUS": Control(30.0, 0.0, 250.0),
        "BRIGHTNESS": Control(0.0, -64.0, 64.0),
        "CONTRAST": Control(32.0, 0.0, 64.0),
        "SATURATION": Control(64.0, 0.0, 128.0),
    }


@dataclass
class FakeV4l2:
    """One device and its capture.

    Attributes:
        pictures: what `grab` delivers, in this order; None = one timeout of `select`.
        label: flags of every buffer; by default as uvcvideo's.
        answers_queries: VIDIOC_QUERYBUF works.
        forced: properties that the driver keeps at a value whatever is asked.
        hang: set by a test that lets `grab` wait until it is set.
        misuse: what would have crashed the process.
    """

    pictures: list[Picture | None] = field(default_factory=list)
    controls: dict[str, Control] = field(default_factory=uvc_controls)
    label: int = START_OF_EXPOSURE
    answers_queries: bool = True
    forced: dict[str, float] = field(default_factory=dict)
    present: bool = True
    now_ns: int = 5_000_000_000
    hang: threading.Event | None = None
    grabbing: threading.Event = field(default_factory=threading.Event)
    released: bool = False
    misuse: list[str] = field(default_factory=list)
    set_values: dict[str, float] = field(default_factory=dict)
    _format: dict[str, float] = field(default_factory=dict)
    _held: Picture | None = None
    stamp_us: int = 0

    # What V4l2Source is made with.

    def opencv(self) -> Any:
        """OpenCV's module, with this device as the only one."""
        return SimpleNamespace(
            VideoCapture=lambda device, backend: self,
            VideoWriter_fourcc=cv2.VideoWriter.fourcc,
            CAP_V4L2=cv2.CAP_V4L2,
            **{f"CAP_PROP_{name}": getattr(cv2, f"CAP_PROP_{name}") for name in _NAMES},
        )

    def clock_ns(self) -> int:
        """The monotonic clock, which waiting moves on."""
        return self.now_ns

    def query(self, device: str) -> BufferQuery:
        """A second handle of the device."""
        return BufferQuery(os.devnull, self._ioctl)

    def is_released(self) -> bool:
        """Whether the capture was released by now."""
        return self.released

    # cv2.VideoCapture

    def isOpened(self) -> bool:
        return self.present

    def set(self, identifier: int, value: float) -> bool:
        name = self._name(identifier)
        self.set_values[name] = value
        if name in self.controls:
            control = self.controls[name]
            control.value = float(min(max(round(value), control.low), control.high))
            return True
        if name in ("FRAME_WIDTH", "FRAME_HEIGHT", "FPS", "FOURCC", "BUFFERSIZE"):
            self._format[name] = value
            return True
        return False

    def get(self, identifier: int) -> float:
        name = self._name(identifier)
        if name == "POS_MSEC":
            return 1e-3 * self.stamp_us
        if name in self.forced:
            return self.forced[name]
        if name in self.controls:
            return self.controls[name].value
        return self._format.get(name, -1.0)

    def grab(self) -> bool:
        if self.is_released():
            self.misuse.append("grab after release")
            return False
        self.grabbing.set()
        if self.hang is not None:
            self.hang.wait()
        if self.is_released():
            self.misuse.append("released beside a running grab")
        picture = self.pictures.pop(0) if self.pictures else None
        if not self.present:
            return False
        if picture is None:
            self.now_ns += int(os.environ.get("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "10")) * 1_000_000_000
            return False
        self._held, self.stamp_us = picture, picture.stamp_us
        return True

    def retrieve(self) -> tuple[bool, Any]:
        self._held = None
        return True, np.zeros((480, 640, 3), np.uint8)

    def read(self) -> tuple[bool, Any]:
        return self.retrieve() if self.grab() else (False, None)

    def release(self) -> None:
        self.released = True

    # The kernel

    def _ioctl(self, handle: int, request: int, buffer: V4l2Buffer | V4l2Control | V4l2QueryControl) -> None:
        if isinstance(buffer, V4l2QueryControl):
            assert request == VIDIOC_QUERYCTRL
            self._query_control(buffer)
            return
        assert request == VIDIOC_QUERYBUF
        assert isinstance(buffer, V4l2Buffer)
        if not self.answers_queries or buffer.index >= 2:
            raise OSError(errno.EINVAL, "Invalid argument")
        buffer.flags = self.label | 0x2000
        if self._held is not None and buffer.index == 1:
            buffer.seconds, buffer.microseconds = divmod(self._held.stamp_us, 1_000_000)
            buffer.sequence = self._held.sequence

    def _query_control(self, query: V4l2QueryControl) -> None:
        if query.id not in IDENTIFIERS.values():
            raise OSError(errno.EINVAL, "Invalid argument")
        name = {number: field for field, number in IDENTIFIERS.items()}[query.id].upper()
        if name not in self.controls:
            raise OSError(errno.EINVAL, "Invalid argument")
        control, default = self.controls[name], uvc_controls()[name].value
        query.minimum, query.maximum, query.default_value = int(control.low), int(control.high), int(default)

    @staticmethod
    def _name(identifier: int) -> str:
        return next(name for name in _NAMES if getattr(cv2, f"CAP_PROP_{name}") == identifier)
