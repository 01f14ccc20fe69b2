"""Sets a driver's controls and reads each back, because drivers may silently apply another value.

V4L2 defines a unit only for the exposure (`V4L2_CID_EXPOSURE_ABSOLUTE`: 100 µs). Gain has none, "the unit is undefined"
for the focus, and white balance is a colour temperature, if it can be set at all (kernel documentation, "User Control
Reference", "Camera Control Reference"). So `gain`, `white_balance` and `focus_dioptres` of a rig do not apply to such a
driver; its own values are set in `v4l2_controls`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rhot.rig.config import CameraConfig
from rhot.rig.sections import PICTURE_NEUTRAL

# Conversion of saturation, contrast and brightness to the units of a V4L2 driver.
#
# The kernel gives these controls no unit ("User Control Reference"), only a range and a default (`VIDIOC_QUERYCTRL`,
# `struct v4l2_queryctrl` of `linux/videodev2.h`). A factor s of the rig is set in proportion between the control's
# least value, which is 0, and its default, which is 1; a brightness b between default and either end:
#
#     saturation, contrast:  value = low + s · (default − low)
#     brightness:            value = default + b · (high − default)   for b ≥ 0, default + b · (default − low) below

VIDIOC_QUERYCTRL: Final = 0xC0445624
"""`_IOWR('V', 36, struct v4l2_queryctrl)`."""
IDENTIFIERS: Final = {"brightness": 0x00980900, "contrast": 0x00980901, "saturation": 0x00980902}
"""`V4L2_CID_BRIGHTNESS` and its neighbours."""
VIDIOC_S_CTRL: Final = 0xC008561C
"""`_IOWR('V', 28, struct v4l2_control)`."""
AUTOGAIN: Final = 0x00980912
"""`V4L2_CID_AUTOGAIN`, which OpenCV knows no name for."""
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


class V4l2Control(ctypes.Structure):
    """`struct v4l2_control`."""

    id: int
    value: int

    _fields_ = (("id", ctypes.c_uint32), ("value", ctypes.c_int32))


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


_EXPOSURE_UNIT_S: Final = 1e-4
_TOLERANCE: Final = 0.1
_ABSENT: Final = -1.0
"""Value that OpenCV returns for a control that the driver lacks (`cap_v4l.cpp`, `getProperty`)."""
_PROPERTIES: Final = {
    "gain": "CAP_PROP_GAIN",
    "focus_absolute": "CAP_PROP_FOCUS",
    "white_balance_temperature": "CAP_PROP_WB_TEMPERATURE",
    "brightness": "CAP_PROP_BRIGHTNESS",
    "contrast": "CAP_PROP_CONTRAST",
    "saturation": "CAP_PROP_SATURATION",
    "sharpness": "CAP_PROP_SHARPNESS",
    "gamma": "CAP_PROP_GAMMA",
    "backlight_compensation": "CAP_PROP_BACKLIGHT",
}


class DriverControls:
    """The controls of one opened capture."""

    def __init__(self, opencv: Any, capture: Any) -> None:
        """Take OpenCV's module and its capture."""
        self._cv = opencv
        self._capture = capture

    def lock(self, camera: CameraConfig) -> list[str]:
        """Switch off automatic functions, set the rig's values, and return the refused settings."""
        refused = self.set_exposure(camera.exposure_s)
        for name, property_name in (("white balance", "CAP_PROP_AUTO_WB"), ("focus", "CAP_PROP_AUTOFOCUS")):
            # Skipped for cameras that lack the function.
            if self.value(property_name) not in (_ABSENT, 0.0):
                refused += self.set(f"manual {name}", property_name, 0.0)
        for name, value in camera.v4l2_controls.items():
            refused += self.set(f"v4l2_controls.{name} = {value}", _PROPERTIES[name], float(value))
        return refused

    def set_exposure(self, exposure_s: float) -> list[str]:
        """Set manual exposure, and return the refused settings."""
        # `V4L2_EXPOSURE_MANUAL` of the menu of `V4L2_CID_EXPOSURE_AUTO`.
        return [
            *self.set("manual exposure", "CAP_PROP_AUTO_EXPOSURE", 1.0),
            *self.set(f"exposure_s = {exposure_s:g}", "CAP_PROP_EXPOSURE", exposure_s / _EXPOSURE_UNIT_S),
        ]

    def exposure_s(self, asked_s: float) -> float:
        """Return the driver's exposure time, seconds; the requested one if the driver does not report it."""
        units = self.value("CAP_PROP_EXPOSURE")
        return units * _EXPOSURE_UNIT_S if units > 0.0 else asked_s

    def set_picture(
        self, camera: CameraConfig, asked: Mapping[str, float], ranges: Callable[[str], ControlRange | None]
    ) -> list[str]:
        """Set saturation, contrast and brightness, and return what cannot be set, with the reason.

        Args:
            camera: whose `v4l2_controls` are what a neutral value goes back to.
            asked: field to value; only these are touched.
            ranges: asks the driver for the range of a field's control.
        """
        refused = []
        for field, value in asked.items():
            known = ranges(field)
            own = camera.v4l2_controls.get(field) if value == PICTURE_NEUTRAL[field] else None  # type: ignore[call-overload]
            if known is None:
                refused.append(f"{field} = {value:g} (the driver has no such control)")
            elif (units := known.units(field, value) if own is None else own) is None:
                refused.append(f"{field} = {value:g} (at most {known.most(field):.2f})")
            else:
                refused += self.set(f"{field} = {value:g}", _PROPERTIES[field], float(units))
        return refused

    def unset(self, camera: CameraConfig) -> str:
        """Return the rig's values that do not apply to the driver, with the driver's own values, as text."""
        own = [("gain", camera.gain), ("white_balance_temperature", camera.white_balance)]
        if camera.focus_dioptres is not None:
            own.append(("focus_absolute", camera.focus_dioptres))
        left = [name for name, _ in own if name not in camera.v4l2_controls]
        values = {name: self.value(_PROPERTIES[name]) for name in left}
        return ", ".join(
            f"{name} {'cannot be set' if value == _ABSENT else f'stays at {value:g}'}" for name, value in values.items()
        )

    def set(self, name: str, property_name: str, value: float) -> list[str]:
        """Set one control; if the driver deviates, return the control's name and the driver's value."""
        accepted = bool(self._capture.set(getattr(self._cv, property_name), value))
        got = self.value(property_name)
        if accepted and abs(got - value) <= _TOLERANCE * max(abs(value), 1e-9):
            return []
        return [f"{name} (driver says {got:g})" if accepted else name]

    def value(self, property_name: str) -> float:
        """Return the driver's value of a control."""
        return float(self._capture.get(getattr(self._cv, property_name)))
