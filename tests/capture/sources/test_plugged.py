"""Which cameras are plugged in: Linux's own tree of devices, numbers elsewhere, and what each shows."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from rhot.errors import DeviceError
from rhot_capture.sources.plugged import Plugged, look, plugged_in
from rhot_tools.operate.webcams import half_blocks

C920, C270 = "HD Pro Webcam C920", "C270 HD WEBCAM"


def tree(root: Path, devices: dict[str, tuple[str, int]], links: dict[str, str]) -> dict[str, Any]:
    """Make `/dev` and `/sys` of cameras: device to (label, index), link below `/dev/v4l` to device."""
    for name, (label, index) in devices.items():
        about = root / "sys/class/video4linux" / name
        about.mkdir(parents=True)
        (about / "name").write_text(f"{label}\n")
        (about / "index").write_text(f"{index}\n")
        (root / "dev").mkdir(exist_ok=True)
        (root / "dev" / name).touch()
    for link, name in links.items():
        path = root / "dev/v4l" / link
        path.parent.mkdir(parents=True, exist_ok=True)
        path.symlink_to(root / "dev" / name)
    return {"dev": root / "dev", "sysfs": root / "sys", "system": "linux"}


def test_cameras_are_named_by_what_stays_when_they_are_plugged_in_again(tmp_path: Path) -> None:
    devices = {"video10": (C270, 0), "video2": (C920, 0), "video3": (C920, 1)}
    links = {
        "by-id/usb-C920_1234-video-index0": "video2",
        "by-id/usb-C270-video-index0": "video10",
        "by-path/pci-usb-0:1-video-index0": "video2",
        "by-path/pci-usb-0:2-video-index0": "video10",
    }
    found = plugged_in(**tree(tmp_path, devices, links))
    # In the order of their numbers; video3 holds the metadata of video2.
    assert [(each.label, Path(each.device).name) for each in found] == [
        (C920, "usb-C920_1234-video-index0"),
        (C270, "usb-C270-video-index0"),
    ]


def test_two_of_a_kind_without_serial_numbers_are_named_by_their_ports(tmp_path: Path) -> None:
    """Both have the same id, whose link names the one that came last."""
    links = {
        "by-id/usb-C270-video-index0": "video2",
        "by-path/pci-usb-0:1-video-index0": "video0",
        "by-path/pci-usb-0:2-video-index0": "video2",
    }
    found = plugged_in(**tree(tmp_path, {"video0": (C270, 0), "video2": (C270, 0)}, links))
    assert [Path(each.device).parent.name for each in found] == ["by-path", "by-path"]


def test_devices_without_links_are_named_as_they_are(tmp_path: Path) -> None:
    found = plugged_in(**tree(tmp_path, {"video20": ("left", 0)}, {}))
    assert found == [Plugged("v4l2", str(tmp_path / "dev/video20"), "left")]


class Camera:
    """A driver behind `cv2.VideoCapture`."""

    def __init__(self, opens: bool = True, size: tuple[int, int] = (480, 640), frames: int = 10**6) -> None:
        self.opens, self.size, self.frames = opens, size, frames
        self.controls = {cv2.CAP_PROP_GAIN: 17.4, cv2.CAP_PROP_WB_TEMPERATURE: 4600.0}
        self.now_s = 0.0
        self.released = False

    def isOpened(self) -> bool:  # OpenCV's name
        return self.opens

    def set(self, control: int, value: float) -> bool:
        return True

    def get(self, control: int) -> float:
        return self.controls.get(control, -1.0)

    def read(self) -> tuple[bool, Any]:
        self.frames -= 1
        self.now_s += 1.0 / 30.0
        return (True, np.full((*self.size, 3), 99, np.uint8)) if self.frames >= 0 else (False, None)

    def release(self) -> None:
        self.released = True


def opencv(cameras: dict[Any, Camera]) -> Any:
    def opened(device: int | str, _: int = 0) -> Camera:
        return cameras.get(device, Camera(opens=False))

    names = [name for name in dir(cv2) if name.startswith("CAP_")]
    constants = {name: getattr(cv2, name) for name in names}
    return SimpleNamespace(VideoCapture=opened, VideoWriter=cv2.VideoWriter, **constants)


def test_where_a_system_lists_none_the_numbers_are_tried() -> None:
    cameras: dict[Any, Camera] = {0: Camera(), 1: Camera()}
    found = plugged_in(opencv=opencv(cameras), system="win32")
    assert [(each.source, each.device) for each in found] == [("webcam", "0"), ("webcam", "1")]
    assert all(camera.released for camera in cameras.values())


def test_a_look_says_what_the_automatics_found() -> None:
    camera = Camera()
    seen = look(Plugged("v4l2", "/dev/video0", C920), opencv({"/dev/video0": camera}), lambda: camera.now_s)
    assert seen.image.shape == (480, 640, 3)
    assert seen.rate_hz == 30.0
    assert seen.held == {"gain": 17, "white_balance_temperature": 4600}, "it has no focus"
    assert camera.released


@pytest.mark.parametrize(
    ("camera", "says"),
    [
        (Camera(opens=False), "cannot be opened; does another program use it"),
        (Camera(frames=0), "delivers no pictures; unplugged"),
        (Camera(size=(720, 1280)), "delivers 1280x720 instead of 640x480"),
    ],
)
def test_a_camera_that_cannot_be_used_says_why(camera: Camera, says: str) -> None:
    with pytest.raises(DeviceError, match=says):
        look(Plugged("webcam", "0", C270), opencv({0: camera}), lambda: camera.now_s)
    assert camera.released


def test_a_picture_in_characters_has_the_colours_of_the_picture() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    image[:240], image[240:, 320:] = (0, 0, 255), (255, 0, 0)
    lines = half_blocks(image, 40)
    assert (len(lines), len(lines[0])) == (15, 40)
    assert lines[0][0] == ("#ff0000", "#ff0000")
    assert lines[7][39] == ("#ff0000", "#0000ff")
