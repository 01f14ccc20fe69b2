"""Which USB cameras are plugged into this machine, what each shows, and how far it lets itself be locked."""

from __future__ import annotations

import itertools
import re
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, Final, Literal

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.errors import DeviceError
from rhot.rig.config import CameraConfig
from rhot_capture.sources.factory import open_usb

_SETTLE_S: Final = 1.5
"""For automatic exposure and white balance to come to rest: what they find is what the camera is then locked at."""
_WIDTH, _HEIGHT, _FASTEST_HZ = 640, 480, 60.0
_MOST_NUMBERS: Final = 10
"""Webcams beyond this are not looked for where a system lists none."""
_HELD: Final = {
    "gain": "CAP_PROP_GAIN",
    "white_balance_temperature": "CAP_PROP_WB_TEMPERATURE",
    "focus_absolute": "CAP_PROP_FOCUS",
}
"""Automatic values of a V4L2 driver that are held where they came to rest."""


@dataclass(frozen=True, slots=True)
class Plugged:
    """A camera that is plugged in.

    Attributes:
        source: kind of source in `rig.toml`.
        device: what `rig.toml` calls it; a name that stays when it is plugged in again, where the system has one.
        label: the driver's name for people.
    """

    source: Literal["v4l2", "webcam"]
    device: str
    label: str


@dataclass(frozen=True, slots=True)
class Looked:
    """What a camera showed.

    Attributes:
        image: (480, 640, 3) uint8 BGR, after its automatics settled.
        rate_hz: frames a second that it delivered.
        held: `v4l2_controls` where the automatics came to rest.
    """

    image: ImageArray
    rate_hz: float
    held: Mapping[str, int]


def plugged_in(
    dev: Path = Path("/dev"), sysfs: Path = Path("/sys"), opencv: ModuleType | Any = cv2, system: str = sys.platform
) -> list[Plugged]:
    """Return the cameras of this machine, in the order of their numbers.

    Args:
        dev, sysfs: where Linux has its devices and says what they are; replaced in tests.
        opencv: the module that provides `VideoCapture`, by which other systems are searched.
        system: as `sys.platform`.
    """
    if system == "linux":
        return list(_video4linux(dev, sysfs))
    return list(_numbered(opencv))


def _video4linux(dev: Path, sysfs: Path) -> Iterator[Plugged]:
    """One entry a camera: a UVC camera has further devices, with an `index` above 0, for metadata."""
    number = re.compile(r"video(\d+)$")
    numbered = sorted((int(match[1]), path) for path in dev.glob("video*") if (match := number.fullmatch(path.name)))
    labels = {}
    for _, path in numbered:
        about = sysfs / "class/video4linux" / path.name
        if _told(about / "index", "0") == "0":
            labels[path] = _told(about / "name", path.name)
    by_id, by_path = (
        {link.resolve(): str(link) for link in dev.glob(f"v4l/{kind}/*")} for kind in ("by-id", "by-path")
    )
    for path, label in labels.items():
        # Cameras of one kind without serial numbers share one id, which then names either of them.
        alike = [other for other in labels if labels[other] == label]
        names = by_id if all(each.resolve() in by_id for each in alike) else by_path
        yield Plugged("v4l2", names.get(path.resolve(), str(path)), label)


def _told(file: Path, otherwise: str) -> str:
    try:
        return file.read_text(errors="replace").strip() or otherwise
    except OSError:
        return otherwise


def _numbered(opencv: ModuleType | Any) -> Iterator[Plugged]:
    for number in range(_MOST_NUMBERS):
        capture = opencv.VideoCapture(number)
        try:
            if not capture.isOpened():
                # Numbers have no gaps in Media Foundation, DirectShow and AVFoundation.
                return
            yield Plugged("webcam", str(number), f"camera {number}")
        finally:
            capture.release()


def look(camera: Plugged, opencv: ModuleType | Any = cv2, now_s: Callable[[], float] = time.monotonic) -> Looked:
    """Let a camera's automatics settle, and return what it shows then.

    Raises:
        DeviceError: it cannot be opened, delivers nothing, or not in 640x480.
    """
    is_v4l2 = camera.source == "v4l2"
    if is_v4l2:
        capture = opencv.VideoCapture(camera.device, opencv.CAP_V4L2)
        capture.set(opencv.CAP_PROP_FOURCC, float(opencv.VideoWriter.fourcc(*"MJPG")))
    else:
        capture = opencv.VideoCapture(int(camera.device))
    try:
        if not capture.isOpened():
            raise DeviceError(f"{camera.label} ({camera.device}) cannot be opened; does another program use it?")
        for name, value in (("FRAME_WIDTH", _WIDTH), ("FRAME_HEIGHT", _HEIGHT), ("FPS", _FASTEST_HZ)):
            capture.set(getattr(opencv, f"CAP_PROP_{name}"), float(value))
        image, times_s = _settled(camera, capture, now_s)
        held: dict[str, int] = {}
        if is_v4l2:
            values = {name: float(capture.get(getattr(opencv, constant))) for name, constant in _HELD.items()}
            # OpenCV says −1 for a control that the driver lacks.
            held = {name: round(value) for name, value in values.items() if value >= 0.0}
        if image.shape[:2] != (_HEIGHT, _WIDTH):
            raise DeviceError(
                f"{camera.label} ({camera.device}) delivers {image.shape[1]}x{image.shape[0]} instead of "
                f"{_WIDTH}x{_HEIGHT}; write it into rig.toml by hand, see docs/use.md"
            )
        steps_s = [later - before for before, later in itertools.pairwise(times_s)]
        return Looked(image, round(1.0 / max(statistics.median(steps_s), 1e-3)), held)
    finally:
        capture.release()


def _settled(camera: Plugged, capture: Any, now_s: Callable[[], float]) -> tuple[ImageArray, list[float]]:
    """Return the last picture and the times of all."""
    image: ImageArray | None = None
    times_s: list[float] = []
    begun_s = now_s()
    while now_s() - begun_s < _SETTLE_S or len(times_s) < 3:
        ok, picture = capture.read()
        if ok:
            image = np.asarray(picture, dtype=np.uint8)
            times_s.append(now_s())
        elif now_s() - begun_s > 2.0 * _SETTLE_S:
            break
    if image is None or len(times_s) < 3:
        raise DeviceError(
            f"{camera.label} ({camera.device}) delivers no pictures; unplugged, or short of USB bandwidth (try another "
            "port)"
        )
    return image, times_s


def locked(name: str, camera: CameraConfig) -> Sequence[str]:
    """Open a camera as its capture service will; return the settings that its driver refused.

    Raises:
        DeviceError: it cannot be opened.
    """
    source = open_usb(name, camera)
    try:
        source.open(0)
        source.read()
        return source.refused
    finally:
        source.close()
