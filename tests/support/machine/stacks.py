"""Tests of a driver on its real software stack, or, with `RHOT_DEVICE`, on the real device."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rhot.rig.config import CameraConfig
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.frame import Frame, Source

DEVICE = os.environ.get("RHOT_DEVICE", "")
"""The device to test: `realsense`, `openvr`, `picamera2`, or the path of a camera or a sensor; empty: none is here."""

SHARE = Path("/share")
"""Of the emulated machine: what the machine below has put there, and what it takes from there."""


def needs_emulated(why: str) -> None:
    """Skip a test that cannot run on a real device."""
    if DEVICE:
        pytest.skip(f"not on the device {DEVICE}: {why}")


def in_guest() -> None:
    """Skip a test that loads kernel modules, outside the machine that `make stacks` emulates."""
    if not os.environ.get("RHOT_GUEST"):
        pytest.skip("runs in the machine that `make stacks` emulates, or with RHOT_DEVICE on a real device")


def read_frames(source: Source, count: int) -> list[Frame]:
    """Return the next frames of a camera, each of which has to come."""
    frames = []
    for _ in range(count):
        frame = source.read()
        assert frame is not None
        frames.append(frame)
    return frames


def live_settings(camera: CameraConfig, **changes: float) -> CameraSettings:
    """Return the settings of a running camera, some of them changed."""
    fields = ("exposure_s", "gain", "white_balance", "focus_dioptres", "saturation", "contrast", "brightness")
    return CameraSettings.model_validate({**{field: getattr(camera, field) for field in fields}, **changes})
