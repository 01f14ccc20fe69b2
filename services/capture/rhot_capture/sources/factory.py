"""Creates the source that `rig.toml` names; the module of each kind is imported only when needed."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from rhot.clock import NodeClock
from rhot.errors import ConfigError
from rhot.plugins import load_simulated
from rhot.rig import Rig
from rhot.service.grabber import Grabber
from rhot_capture.sources.frame import Frame, Source

if TYPE_CHECKING:
    from rhot.rig.config import CameraConfig
    from rhot_capture.sources.v4l2 import V4l2Source
    from rhot_capture.sources.webcam import WebcamSource


def open_source(name: str, rig: Rig, clock: NodeClock) -> Source:
    """Return the source of a camera of the rig, not yet opened.

    Args:
        name: of the camera.
        rig: the loaded rig.
        clock: the node's clock, on which frames are timed. A simulated camera has a clock error only with a
            `rhot.clock.SkewedClock`.

    Raises:
        ConfigError: no such camera, or its recording cannot be used.
    """
    camera = rig.config.cameras.get(name)
    if camera is None:
        raise ConfigError(f"no camera {name} in {rig.path / 'rig.toml'}; it has {', '.join(rig.config.cameras)}")
    if camera.source == "simulated":
        source: Source = load_simulated("camera").from_rig(name, rig, clock)
        return source
    if camera.source in ("images", "video"):
        from rhot_capture.sources.recorded import RecordedSource  # noqa: PLC0415

        return RecordedSource.from_rig(name, rig, clock)
    if camera.source in ("v4l2", "webcam"):
        return open_usb(name, camera)
    from rhot_capture.sources.picamera2 import Picamera2Source  # noqa: PLC0415

    return Picamera2Source(name, camera)


def open_usb(name: str, camera: CameraConfig) -> V4l2Source | WebcamSource:
    """Return the source of a USB camera, not yet opened.

    Raises:
        ConfigError: this system has no such driver.
    """
    if camera.source == "webcam":
        from rhot_capture.sources.webcam import WebcamSource  # noqa: PLC0415

        return WebcamSource(name, camera)
    has_v4l2 = sys.platform == "linux"
    if not has_v4l2:
        raise ConfigError(f'camera {name}: source = "v4l2" is of Linux; write source = "webcam"')
    from rhot_capture.sources.v4l2 import V4l2Source  # noqa: PLC0415

    return V4l2Source(name, camera)


def grab(source: Source, name: str = "camera") -> Grabber[Frame]:
    """Return a grabber of a source, which is then read on the grabber's thread only.

    Args:
        source: to read.
        name: of the camera, for messages.
    """
    return Grabber(f"camera {name}", lambda: iter(source.read, None), source.close)
