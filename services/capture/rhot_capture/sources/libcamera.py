"""The modules picamera2 and libcamera, and the controls that lock a camera's settings."""

from __future__ import annotations

import importlib
import logging
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Any, Final

from rhot.errors import DeviceError
from rhot.rig.config import CameraConfig
from rhot.rig.sections import PICTURE_NEUTRAL
from rhot_capture.settings import CameraSettings

logger = logging.getLogger(__name__)

_TOLERANCE: Final = 0.05
"""Relative tolerance of reported settings: sensors quantise exposure time and gain."""


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
        # Not only ImportError: with numpy 2, the system's simplejpeg raises a ValueError (docs/deploy.md).
        raise DeviceError(
            f"picamera2 cannot be imported ({error}); on a Raspberry Pi: `sudo apt install -y python3-picamera2 "
            "--no-install-recommends`, with a virtual environment made by `python3 -m venv --system-site-packages`; "
            'elsewhere set source = "v4l2" or "simulated" in rig.toml'
        ) from error


def locked_controls(
    enums: Any,
    camera: CameraConfig,
    name: str,
    settings: CameraConfig | CameraSettings,
    offered: Container[str],
) -> dict[str, Any]:
    """Return libcamera's controls with all automatic functions switched off, as far as a camera has them.

    Args:
        enums: `libcamera.controls`.
        camera: rate and synchronisation.
        name: of the camera, for messages.
        settings: what is set now; at the start the same as `camera`.
        offered: names of the controls that the camera has.

    Raises:
        DeviceError: libcamera is too old to synchronise.
    """
    frame_us = round(1e6 / camera.rate_hz)
    controls: dict[str, Any] = {
        "AeEnable": False,
        "AwbEnable": False,
        "ColourGains": settings.white_balance,
        "ExposureTime": round(1e6 * settings.exposure_s),
        "AnalogueGain": settings.gain,
        "FrameDurationLimits": (frame_us, frame_us),
        "NoiseReductionMode": enums.draft.NoiseReductionModeEnum.Off,
    }
    controls |= {name.capitalize(): getattr(settings, name) for name in PICTURE_NEUTRAL}
    if settings.focus_dioptres is not None:
        if "LensPosition" in offered:
            controls |= {"AfMode": enums.AfModeEnum.Manual, "LensPosition": settings.focus_dioptres}
        else:
            logger.warning("camera %s: has no focus motor; focus_dioptres is ignored", name)
    if camera.sync != "off":
        if "SyncMode" not in offered or not hasattr(enums, "rpi") or not hasattr(enums.rpi, "SyncModeEnum"):
            raise DeviceError(
                f'camera {name}: sync = "{camera.sync}" needs a Raspberry Pi with libcamera 0.4 or newer; '
                '`sudo apt full-upgrade`, or set sync = "off"'
            )
        modes = enums.rpi.SyncModeEnum
        controls["SyncMode"] = modes.Server if camera.sync == "server" else modes.Client
    return {control: value for control, value in controls.items() if control in offered}


_MUST_LOCK: Final = {"ExposureTime": "exposure", "AnalogueGain": "gain", "ColourGains": "white balance"}


def lacking_controls(settings: CameraConfig | CameraSettings, offered: Container[str], name: str) -> str:
    """Return what a camera cannot be set to, as sentences; empty when all can be."""
    lacking = [
        f"{field} = {value:g}"
        for field, neutral in PICTURE_NEUTRAL.items()
        if (value := getattr(settings, field)) != neutral and field.capitalize() not in offered
    ]
    told = []
    if lacking:
        told.append(
            f"camera {name} has no control for {', '.join(lacking)}; take it out of [cameras.{name}] in rig.toml"
        )
    if open_ended := [what for control, what in _MUST_LOCK.items() if control not in offered]:
        told.append(f"camera {name} cannot lock {', '.join(open_ended)}: colours may drift when the light changes")
    return ". ".join(told)


def differences(metadata: Mapping[str, Any], expected: Mapping[str, float]) -> list[str]:
    """Return the settings that a camera reports differently than requested."""
    return [
        f"{key} {float(metadata[key]):g} instead of {value:g}"
        for key, value in expected.items()
        if key in metadata and abs(float(metadata[key]) - value) > _TOLERANCE * value
    ]
