"""What doctor says is missing on a Pi, on a PC with a RealSense and sensors, and on a laptop."""

from __future__ import annotations

import ctypes.util
import importlib.util
import shutil
from pathlib import Path

import pytest

from rhot.rig import Rig, load_rig
from rhot.rig.template import rig_template
from rhot_tools.operate.packages import check_packages, is_raspberry_pi


@pytest.fixture
def nothing_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: None)
    monkeypatch.setattr(shutil, "which", lambda name: None)


def rig_of(folder: Path, more: str, source: str = "picamera2") -> Rig:
    folder.mkdir()
    text = rig_template(folder="rig", name="test").replace('source = "picamera2"', f'source = "{source}"')
    (folder / "rig.toml").write_text(text + more)
    return load_rig(folder)


FEET = """
[feet.camera]
source = "realsense"
[feet.left]
marker_id = 0
imu = { device = "/dev/ttyACM0" }
"""


@pytest.mark.usefixtures("nothing_installed")
def test_a_pi_without_picamera2(tmp_path: Path) -> None:
    model = tmp_path / "proc/device-tree/model"
    model.parent.mkdir(parents=True)
    model.write_bytes(b"Raspberry Pi 4 Model B Rev 1.4\0")
    assert is_raspberry_pi(tmp_path)
    (found,) = check_packages(None, tmp_path)
    assert found.level == "bad"
    assert "apt install -y python3-picamera2" in found.remedy


@pytest.mark.usefixtures("nothing_installed")
def test_a_pc_with_a_realsense_and_sensors(tmp_path: Path) -> None:
    remedies = " | ".join(found.remedy for found in check_packages(rig_of(tmp_path / "rig", FEET), tmp_path))
    for wanted in ("rhot[realsense]", "apt install libusb-1.0-0", "udevadm trigger", "rhot[feet]"):
        assert wanted in remedies
    rules = tmp_path / "etc/udev/rules.d"
    rules.mkdir(parents=True)
    (rules / "99-realsense-libusb.rules").touch()
    assert "udevadm" not in " ".join(found.remedy for found in check_packages(load_rig(tmp_path / "rig"), tmp_path))


@pytest.mark.usefixtures("nothing_installed")
def test_a_laptop_with_webcams(tmp_path: Path) -> None:
    remedies = [found.remedy for found in check_packages(rig_of(tmp_path / "rig", "", "v4l2"), tmp_path)]
    assert "sudo apt install v4l-utils" in remedies


def test_a_machine_that_has_all_is_told_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object())
    monkeypatch.setattr(ctypes.util, "find_library", lambda name: "libusb-1.0.so.0")
    monkeypatch.setattr(shutil, "which", lambda name: f"/usr/bin/{name}")
    assert [f.remedy for f in check_packages(rig_of(tmp_path / "rig", FEET), tmp_path) if "udev" not in f.remedy] == []
