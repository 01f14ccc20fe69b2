"""What picamera2 and libcamera are told: the modules themselves, and the controls that lock a camera."""

from __future__ import annotations

import importlib
import logging
from dataclasses import dataclass
from typing import Any

from rhot.errors import DeviceError
from rhot.rig.config import CameraConfig

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PicameraModules:
    """The two modules that only a Pi has; replaced in tests.

    Attributes:
        picamera2: provides `Picamera2` and `MappedArray`.
        controls: `libcamera.controls`.
    """

    picamera2: Any
    controls: Any


def import_picamera() -> PicameraModules:
    """Import picamera2 and libcamera.

    Raises:
        DeviceError: not installed here, or they do not load; says how to install them.
    """
    try:
        return PicameraModules(importlib.import_module("picamera2"), importlib.import_module("libcamera").controls)
    except Exception as error:
        # Not only ImportError: beside numpy 2, the system's simplejpeg ends in a ValueError (docs/deploy.md).
        raise DeviceError(
            f"picamera2 cannot be imported ({error}); on a Raspberry Pi: `sudo apt install -y python3-picamera2 "
            "--no-install-recommends`, with a virtual environment made by `python3 -m venv --system-site-packages`; "
            'elsewhere set source = "v4l2" or "simulated" in rig.toml'
        ) from error


def locked_controls(
    enums: Any,
    camera: CameraConfig,
    name: str,
    exposure_s: float,
    gain: float,
    white_balance: tuple[float, float],
    focus_dioptres: float | None,
    *,
    has_focus: bool,
) -> dict[str, Any]:
    """Return libcamera's controls with everything automatic switched off.

    Args:
        enums: `libcamera.controls`.
        camera: rate and synchronisation.
        name: of the camera, for messages.
        exposure_s, gain, white_balance, focus_dioptres: as in `CameraSettings`.
        has_focus: the lens has a motor.

    Raises:
        DeviceError: libcamera is too old to synchronise.
    """
    frame_us = round(1e6 / camera.rate_hz)
    controls: dict[str, Any] = {
        "AeEnable": False,
        "AwbEnable": False,
        "ColourGains": white_balance,
        "ExposureTime": round(1e6 * exposure_s),
        "AnalogueGain": gain,
        "FrameDurationLimits": (frame_us, frame_us),
        "NoiseReductionMode": enums.draft.NoiseReductionModeEnum.Off,
    }
    if focus_dioptres is not None:
        if has_focus:
            controls |= {"AfMode": enums.AfModeEnum.Manual, "LensPosition": focus_dioptres}
        else:
            logger.warning("camera %s: has no focus motor; focus_dioptres is ignored", name)
    if camera.sync != "off":
        if not hasattr(enums, "rpi") or not hasattr(enums.rpi, "SyncModeEnum"):
            raise DeviceError(
                f'camera {name}: sync = "{camera.sync}" needs libcamera 0.4 or newer; '
                '`sudo apt full-upgrade`, or set sync = "off"'
            )
        modes = enums.rpi.SyncModeEnum
        controls["SyncMode"] = modes.Server if camera.sync == "server" else modes.Client
    return controls
