"""Names of the V4L2 controls that a rig may set, as `v4l2-ctl --list-ctrls` shows them."""

from __future__ import annotations

from typing import Literal

V4l2Control = Literal[
    "gain",
    "focus_absolute",
    "white_balance_temperature",
    "brightness",
    "contrast",
    "saturation",
    "sharpness",
    "gamma",
    "backlight_compensation",
]
