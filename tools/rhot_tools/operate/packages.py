"""What `rhot doctor` finds on this machine: roles, disk, and what the devices of a rig need that is missing."""

from __future__ import annotations

import ctypes.util
import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rhot.rig import Rig
from rhot_tools.operate.findings import Finding

_PICAMERA2: Final = (
    "sudo apt install -y python3-picamera2 --no-install-recommends, in an environment made by "
    "python3 -m venv --system-site-packages"
)
_RULES: Final = ("etc/udev/rules.d", "lib/udev/rules.d", "usr/lib/udev/rules.d")

_ROLES: Final = {
    "capture": ("rhot_capture", "cv2"),
    "fusion": ("rhot_fusion", "cv2"),
    "ik": ("rhot_ik",),
    "objects": ("rhot_objects",),
}


def check_machine() -> Iterator[Finding]:
    """Look at this machine: Python, roles that are installed, cores, disk."""
    version = ".".join(map(str, sys.version_info[:3]))
    yield Finding("ok", f"Python {version} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores")
    for role, modules in _ROLES.items():
        missing = [module for module in modules if not _has_module(module)]
        if missing:
            yield Finding("note", f"role {role}: {', '.join(missing)} not installed", f"pip install 'rhot[{role}]'")
        else:
            yield Finding("ok", f"role {role} can run here")
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    if free_gb < 1:
        yield Finding("warn", f"{free_gb:.1f} GB of disk free", "recordings need more")


def check_packages(rig: Rig | None, root: Path = Path("/")) -> Iterator[Finding]:
    """Tell which packages and rights the devices need that this machine does not have.

    Args:
        rig: whose devices; None where there is no rig folder: then what the machine itself suggests.
        root: of the file system; replaced in tests.
    """
    if is_raspberry_pi(root) and not _has_module("picamera2"):
        yield Finding("bad", "this is a Raspberry Pi without picamera2: its camera cannot be used", _PICAMERA2)
    if rig is None:
        return
    config, feet = rig.config, rig.config.feet
    local = [camera.video_path for camera in config.cameras.values() if camera.source == "v4l2"]
    if local:
        if shutil.which("v4l2-ctl") is None:
            yield Finding("note", "v4l2-ctl, which lists a camera's modes, is missing", "sudo apt install v4l-utils")
        yield from _may_use(local, "video")
    if any(thing.source == "steamvr" for thing in config.objects.values()) and not _has_module("openvr"):
        yield Finding("note", "SteamVR's client library is missing", "pip install 'rhot[steamvr]', where SteamVR runs")
    if feet is None:
        return
    if feet.camera.source == "realsense":
        yield from _check_realsense(root)
    ports = [foot.imu.device for foot in feet.feet.values() if foot.imu is not None and foot.imu.source == "serial"]
    if ports:
        if not _has_module("serial"):
            yield Finding("bad", "pyserial, for the ankle sensors, is missing", "pip install 'rhot[feet]'")
        yield from _may_use(ports, "dialout")


def is_raspberry_pi(root: Path = Path("/")) -> bool:
    """Return whether this machine is one."""
    try:
        return "Raspberry Pi" in (root / "proc/device-tree/model").read_text(errors="replace")
    except OSError:
        return False


def _check_realsense(root: Path) -> Iterator[Finding]:
    if not _has_module("pyrealsense2"):
        yield Finding("note", "the RealSense SDK is missing", "pip install 'rhot[realsense]', where the camera is")
    if ctypes.util.find_library("usb-1.0") is None:
        yield Finding("bad", "libusb, which the RealSense SDK needs, is missing", "sudo apt install libusb-1.0-0")
    if not any(list((root / folder).glob("*realsense*")) for folder in _RULES):
        yield Finding(
            "note",
            "no udev rules for a RealSense: only root can open it",
            "copy config/99-realsense-libusb.rules of the SDK's sources to /etc/udev/rules.d, then "
            "sudo udevadm control --reload && sudo udevadm trigger",
        )


def _may_use(devices: list[str], group: str) -> Iterator[Finding]:
    for device in devices:
        if Path(device).exists() and not os.access(device, os.R_OK | os.W_OK):
            yield Finding(
                "bad", f"you may not use {device}", f"sudo usermod -aG {group} $USER, then log out and in again"
            )


def _has_module(name: str) -> bool:
    return importlib.util.find_spec(name) is not None
