"""Choice of a sensor mode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from rhot.errors import DeviceError
from rhot.rig.config import CameraConfig

_SYNC_MARGIN: Final = 0.95
"""A synchronised camera must be able to shorten frames, so it may not run at the mode's full rate."""


def choose_mode(modes: Sequence[Mapping[str, Any]], camera: CameraConfig, name: str) -> Mapping[str, Any]:
    """Return the sensor mode to use: fast enough, widest view, then fewest pixels.

    Args:
        modes: picamera2's `sensor_modes`.
        camera: size and rate wanted.
        name: of the camera, for messages.

    Raises:
        DeviceError: no mode is fast enough at that size.
    """
    margin = _SYNC_MARGIN if camera.sync != "off" else 1.0
    large = [mode for mode in modes if mode["size"][0] >= camera.width and mode["size"][1] >= camera.height]
    usable = [mode for mode in large if float(mode["fps"]) * margin >= camera.rate_hz]
    if not usable:
        choices = ", ".join(f"{mode['size'][0]}x{mode['size'][1]} at {float(mode['fps']):.1f} Hz" for mode in modes)
        raise DeviceError(
            f"camera {name}: no sensor mode gives {camera.width}x{camera.height} at {camera.rate_hz:g} Hz"
            f"{' with room to synchronise' if margin < 1.0 else ''}; it has {choices or 'none'}; lower rate_hz or size"
        )

    def cost(mode: Mapping[str, Any]) -> tuple[float, float]:
        crop = mode.get("crop_limits", (0, 0, *mode["size"]))
        return -float(crop[2]) * float(crop[3]), float(mode["size"][0]) * float(mode["size"][1])

    return min(usable, key=cost)
