"""Saturation, contrast and brightness of a camera's picture: their units, and what leaves a picture alone; V4L2's own.

The units are libcamera's (`Saturation`, `Contrast`, `Brightness` of its control list): 1 is the camera's own colour and
contrast, 0 its own brightness. A driver with units of its own (V4L2) is set in proportion; see `PICTURE_NEUTRAL`.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Final, Literal

from pydantic import Field

Saturation = Annotated[float, Field(ge=0.0, le=4.0)]
"""Factor on the distance of colours from grey; 0 is a grey picture."""
Contrast = Annotated[float, Field(ge=0.1, le=4.0)]
"""Factor on the distance of levels from the middle of their range."""
Brightness = Annotated[float, Field(ge=-1.0, le=1.0)]
"""What is added to all levels, as a share of their range."""

PICTURE_NEUTRAL: Final[Mapping[str, float]] = MappingProxyType({"saturation": 1.0, "contrast": 1.0, "brightness": 0.0})
"""Fields of a camera's picture and the values that leave it as the camera makes it."""

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
"""Names of the V4L2 controls that a rig may set, as `v4l2-ctl --list-ctrls` shows them."""
