"""Sets a driver's controls and reads each back, because drivers may silently apply another value.

V4L2 defines a unit only for the exposure (`V4L2_CID_EXPOSURE_ABSOLUTE`: 100 µs). Gain has none, "the unit is undefined"
for the focus, and white balance is a colour temperature, if it can be set at all (kernel documentation, "User Control
Reference", "Camera Control Reference"). So `gain`, `white_balance` and `focus_dioptres` of a rig do not apply to such a
driver; its own values are set in `v4l2_controls`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from rhot.rig.config import CameraConfig
from rhot.rig.picture_config import PICTURE_NEUTRAL
from rhot_capture.sources.v4l2.picture import ControlRange

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
