"""V4L2 queries that OpenCV does not offer: meaning of a frame's timestamp, frame number, range of a control.

`VIDIOC_QUERYBUF` works on any handle of the device, also while another one streams ("anyone can query buffers":
`vb2_ioctl_querybuf` in the kernel's videobuf2-v4l2.c). `struct v4l2_buffer` and its flags are from the kernel's
`linux/videodev2.h`.
"""

from __future__ import annotations

import ctypes
import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

from rhot_capture.sources.v4l2.picture import IDENTIFIERS, UNUSABLE, VIDIOC_QUERYCTRL, ControlRange, V4l2QueryControl

VIDIOC_QUERYBUF: Final = 0xC0585609
"""`_IOWR('V', 9, struct v4l2_buffer)` with 64-bit longs, as everywhere where RHOT runs."""
SOURCE_MASK: Final = 0x00070000
"""`V4L2_BUF_FLAG_TSTAMP_SRC_MASK`."""
START_OF_EXPOSURE: Final = 0x00010000
"""`V4L2_BUF_FLAG_TSTAMP_SRC_SOE`; 0 in these bits is the end of the frame."""
_CAPTURE: Final = 1
"""`V4L2_BUF_TYPE_VIDEO_CAPTURE`."""
_MMAP: Final = 1
"""`V4L2_MEMORY_MMAP`, which OpenCV uses."""
_MOST_BUFFERS: Final = 10
"""OpenCV's `MAX_V4L_BUFFERS`."""


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


Ioctl = Callable[[int, int, V4l2Buffer | V4l2QueryControl], object]


class BufferQuery:
    """Queries a device's buffers and controls; None if the driver does not answer (multi-planar devices)."""

    def __init__(self, device: str, ioctl: Ioctl = fcntl.ioctl) -> None:
        """Open a further handle of a device.

        Args:
            device: path, such as `/dev/video0`.
            ioctl: replaced in tests.

        Raises:
            OSError: it cannot be opened.
        """
        self._ioctl = ioctl
        self._handle = os.open(device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)

    def stamps_mark_start(self) -> bool | None:
        """Return whether the driver's timestamps mark the start of the exposure; None if unknown."""
        buffer = self._query(0)
        return None if buffer is None else buffer.flags & SOURCE_MASK == START_OF_EXPOSURE

    def sequence(self, stamp_us: int) -> int | None:
        """Return the driver's number of a grabbed frame that is not yet returned; a gap means lost frames.

        Args:
            stamp_us: the frame's timestamp, which identifies its buffer.
        """
        for index in range(_MOST_BUFFERS):
            buffer = self._query(index)
            if buffer is None:
                return None
            if buffer.seconds * 1_000_000 + buffer.microseconds == stamp_us:
                return int(buffer.sequence)
        return None

    def control_range(self, field: str) -> ControlRange | None:
        """Return the range of `brightness`, `contrast` or `saturation`; None where the driver has no such control."""
        query = V4l2QueryControl(id=IDENTIFIERS[field])
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
        buffer = V4l2Buffer(index=index, type=_CAPTURE, memory=_MMAP)
        try:
            self._ioctl(self._handle, VIDIOC_QUERYBUF, buffer)
        except OSError:
            return None
        return buffer
