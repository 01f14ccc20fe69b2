"""Conversion of saturation, contrast and brightness to the units of a V4L2 driver.

The kernel gives these controls no unit ("User Control Reference"), only a range and a default
(`VIDIOC_QUERYCTRL`, `struct v4l2_queryctrl` of `linux/videodev2.h`). A factor s of the rig is set in proportion between
the control's least value, which is 0, and its default, which is 1; a brightness b between default and either end:

    saturation, contrast:  value = low + s · (default − low)
    brightness:            value = default + b · (high − default)   for b ≥ 0, and   default + b · (default − low) below
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Final

VIDIOC_QUERYCTRL: Final = 0xC0445624
"""`_IOWR('V', 36, struct v4l2_queryctrl)`."""
IDENTIFIERS: Final = {"brightness": 0x00980900, "contrast": 0x00980901, "saturation": 0x00980902}
"""`V4L2_CID_BRIGHTNESS` and its neighbours."""
UNUSABLE: Final = 0x0001 | 0x0004
"""`V4L2_CTRL_FLAG_DISABLED`, `V4L2_CTRL_FLAG_READ_ONLY`."""


class V4l2QueryControl(ctypes.Structure):
    """`struct v4l2_queryctrl`."""

    id: int
    minimum: int
    maximum: int
    default_value: int
    flags: int

    _fields_ = (
        ("id", ctypes.c_uint32),
        ("type", ctypes.c_uint32),
        ("name", ctypes.c_char * 32),
        ("minimum", ctypes.c_int32),
        ("maximum", ctypes.c_int32),
        ("step", ctypes.c_int32),
        ("default_value", ctypes.c_int32),
        ("flags", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32 * 2),
    )


@dataclass(frozen=True, slots=True)
class ControlRange:
    """Range of one control in the driver's units.

    Attributes:
        low, high: smallest and largest value.
        default: the driver's default.
    """

    low: int
    high: int
    default: int

    def units(self, field: str, value: float) -> int | None:
        """Return a setting of the rig in the driver's units; None where it lies beyond the driver's range."""
        if field == "brightness":
            reach = self.high - self.default if value >= 0.0 else self.default - self.low
            return round(self.default + value * reach)
        units = round(self.low + value * (self.default - self.low))
        return units if units <= self.high else None

    def most(self, field: str) -> float:
        """Return the greatest setting of a field that the driver has."""
        if field == "brightness" or self.default == self.low:
            return 1.0
        return (self.high - self.low) / (self.default - self.low)
