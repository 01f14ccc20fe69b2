"""Finding a RealSense among those plugged in, setting up its sensors, and reading its lens."""

from __future__ import annotations

import logging
import re
from typing import Any, Final

import numpy as np

from rhot.errors import DeviceError
from rhot.geometry.camera import CameraModel
from rhot_feet.frames import pinhole

_LOG = logging.getLogger(__name__)

Sdk = Any
"""The module `pyrealsense2`, or what stands in for it in tests."""

_BROWN_CONRADY: Final = ("brown_conrady", "modified_brown_conrady", "inverse_brown_conrady")
"""The SDK bends points by the same equation and order of coefficients as OpenCV for all of these, whatever their names
say (`rs2_project_point_to_pixel`; measured with 2.59, also for the inverse kind that D400 colour cameras report)."""


def describe_devices(sdk: Sdk) -> dict[str, str]:
    """Return serial number to name of the RealSense cameras that are plugged in."""
    info = sdk.camera_info
    return {device.get_info(info.serial_number): device.get_info(info.name) for device in sdk.context().query_devices()}


def find_device(sdk: Sdk, serial: str | None) -> Any:
    """Return the device of a serial number, or the only one.

    Raises:
        DeviceError: none, not this one, or several to choose from; names those that are there.
    """
    devices = list(sdk.context().query_devices())
    info = sdk.camera_info
    names = [f"{device.get_info(info.serial_number)} ({device.get_info(info.name)})" for device in devices]
    if not devices:
        raise DeviceError(
            "no RealSense camera is plugged in; on Linux it also needs the SDK's udev rules, and a USB 3 port"
        )
    if serial is None:
        if len(devices) > 1:
            raise DeviceError(
                f"several RealSense cameras: {', '.join(names)}; set serial in [feet.camera] to one of them"
            )
        return devices[0]
    for device in devices:
        if device.get_info(info.serial_number) == serial:
            return device
    raise DeviceError(
        f"no RealSense with serial {serial}; there is {', '.join(names)}; correct serial in [feet.camera]"
    )


def is_usb2(sdk: Sdk, device: Any) -> bool:
    """Return whether a device hangs on USB 2."""
    descriptor = sdk.camera_info.usb_type_descriptor
    return bool(device.supports(descriptor)) and str(device.get_info(descriptor)).startswith("2")


def configure_sensors(sdk: Sdk, device: Any) -> None:
    """Let times come in the machine's clock and exposure not slow the pictures down; warn of old firmware and USB 2."""
    option, info = sdk.option, sdk.camera_info
    for sensor in device.query_sensors():
        # The colour camera would rather halve its rate in dim light than gain up.
        for name, value in ((option.global_time_enabled, 1.0), (option.auto_exposure_priority, 0.0)):
            if sensor.supports(name) and not sensor.is_option_read_only(name):
                try:
                    sensor.set_option(name, value)
                except RuntimeError as error:
                    _LOG.warning("RealSense: %s cannot be set: %s", name, error)
    if device.supports(info.firmware_version) and device.supports(info.recommended_firmware_version):
        has, wanted = device.get_info(info.firmware_version), device.get_info(info.recommended_firmware_version)
        if _version(has) < _version(wanted):
            _LOG.warning("RealSense: firmware %s is older than %s; update it with rs-fw-update", has, wanted)
    if is_usb2(sdk, device):
        _LOG.warning("RealSense is on USB 2: rates and sizes are limited; use a USB 3 port and cable")


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", text))


def camera_of(intrinsics: Any) -> CameraModel:
    """Return the camera of an SDK `intrinsics` (width, height, fx, fy, ppx, ppy, model, coeffs).

    Raises:
        DeviceError: a kind of lens that OpenCV's model cannot express.
    """
    K = np.array([[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]])
    coefficients = np.array(intrinsics.coeffs, dtype=np.float64)
    # The enum's name, so that no SDK is needed here.
    model = str(intrinsics.model).rpartition(".")[2]
    if model == "none" or not coefficients.any():
        coefficients = np.empty(0)
    elif model not in _BROWN_CONRADY:
        raise DeviceError(
            f"RealSense: a colour lens of the kind {model} is not supported; use a camera of the D400 series"
        )
    return pinhole(int(intrinsics.width), int(intrinsics.height), K, coefficients)
