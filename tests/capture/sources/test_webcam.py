"""Webcams without Video4Linux: OpenCV's own reader on a file, and a driver that locks what it pleases."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from machine.stacks import live_settings

from rhot.clock import SystemClock
from rhot.errors import ConfigError, DeviceError
from rhot.rig import load_rig
from rhot.rig.config import CameraConfig
from rhot_capture.sources import open_source
from rhot_capture.sources.webcam import WebcamSource

PERIOD_NS = 33_333_333


class Driver:
    """A camera behind `cv2.VideoCapture`, with the controls that it has."""

    def __init__(self, controls: dict[int, float], frames: int = 100) -> None:
        self.controls = controls
        self.times_ns = iter(range(0, 10**12, PERIOD_NS))
        self.now_ns = 0
        self.frames = frames
        self.released = False

    def isOpened(self) -> bool:  # OpenCV's name
        return True

    def set(self, control: int, value: float) -> bool:
        if control not in self.controls:
            return False
        self.controls[control] = value
        return True

    def get(self, control: int) -> float:
        return self.controls.get(control, 0.0)

    def read(self) -> tuple[bool, Any]:
        self.frames -= 1
        self.now_ns = next(self.times_ns)
        return (True, np.zeros((480, 640, 3), np.uint8)) if self.frames >= 0 else (False, None)

    def release(self) -> None:
        self.released = True


def everything() -> dict[int, float]:
    controls = ("FRAME_WIDTH", "FRAME_HEIGHT", "FPS", "AUTO_EXPOSURE", "EXPOSURE", "AUTO_WB", "AUTOFOCUS")
    return {getattr(cv2, f"CAP_PROP_{name}"): 0.0 for name in controls}


def webcam(driver: Driver, times_ns: list[int] | None = None, **fields: Any) -> WebcamSource:
    camera = CameraConfig.model_validate({"source": "webcam", "rate_hz": 30.0, "exposure_s": 1 / 256, **fields})
    opencv = SimpleNamespace(**{name: getattr(cv2, name) for name in dir(cv2) if name.startswith("CAP_")})
    opencv.VideoCapture = lambda _: driver
    if times_ns:
        driver.times_ns = iter(times_ns)
    return WebcamSource("left", camera, opencv, lambda: driver.now_ns)


def test_a_file_is_read_to_its_end(tmp_path: Path) -> None:
    file = tmp_path / "left.avi"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480))
    for level in range(0, 200, 20):
        writer.write(np.full((480, 640, 3), level, np.uint8))
    writer.release()
    camera = CameraConfig(source="webcam", device=str(file), rate_hz=30.0)
    source = WebcamSource("left", camera)
    source.open(0)
    frames = list(iter(source.read, None))
    assert [round(float(frame.image.mean()) / 20.0) for frame in frames] == list(range(10))
    assert all(frame.image.shape == (480, 640, 3) for frame in frames)
    assert [frame.index for frame in frames] == sorted({frame.index for frame in frames})
    # A file has nothing to lock.
    assert "exposure_s" in source.problem
    source.close()
    assert source.read() is None


def test_what_is_locked_and_what_is_not() -> None:
    controls = everything()
    source = webcam(Driver(controls))
    source.open(0)
    assert source.problem == ""
    assert controls[cv2.CAP_PROP_AUTO_EXPOSURE] == 0.25
    assert controls[cv2.CAP_PROP_EXPOSURE] == -8.0, "2^-8 s"
    assert controls[cv2.CAP_PROP_AUTO_WB] == controls[cv2.CAP_PROP_AUTOFOCUS] == 0.0
    source.close()

    lacking = everything()
    for control in (cv2.CAP_PROP_AUTO_WB, cv2.CAP_PROP_EXPOSURE):
        del lacking[control]
    source = webcam(Driver(lacking))
    source.open(0)
    assert source.refused == ["exposure_s = 0.00390625", "manual white balance"]
    assert "refused exposure_s = 0.00390625, manual white balance; in this session its brightness" in source.problem


def test_times_are_those_of_arrival_less_exposure_and_read_out() -> None:
    times = [1_000_000_000, 1_000_000_000 + PERIOD_NS, 1_000_000_000 + 4 * PERIOD_NS]
    source = webcam(Driver(everything()), times, readout_s=0.02)
    source.open(0)
    frames = [source.read() for _ in times]
    found = [(frame.t_first_row_ns, frame.index) for frame in frames if frame is not None]
    before_ns = 20_000_000 + round(1e9 / 256)
    assert found == [(t_ns - before_ns, index) for t_ns, index in zip(times, (0, 1, 4), strict=True)]


def test_frames_from_before_the_start_are_dropped() -> None:
    source = webcam(Driver(everything()))
    source.open(5 * PERIOD_NS)
    frame = source.read()
    assert frame is not None
    assert frame.t_first_row_ns >= 5 * PERIOD_NS


def test_a_wrong_size_is_named() -> None:
    controls = everything()
    driver = Driver(controls)
    driver.set = lambda *_: True  # type: ignore[method-assign]
    controls[cv2.CAP_PROP_FRAME_WIDTH], controls[cv2.CAP_PROP_FRAME_HEIGHT] = 1280.0, 720.0
    with pytest.raises(DeviceError, match="delivers 1280x720 instead of 640x480"):
        webcam(driver).open(0)
    assert driver.released


def test_a_camera_that_is_not_there_is_named() -> None:
    source = WebcamSource("left", CameraConfig(source="webcam", device=97))
    with pytest.raises(DeviceError, match="camera left: cannot open 97; is it plugged in"):
        source.open(0)


def test_a_camera_that_falls_silent_is_reported() -> None:
    source = webcam(Driver(everything(), frames=3))
    source.open(0)
    assert source.read() is not None
    assert source.read() is not None
    with pytest.raises(DeviceError, match="stopped delivering"):
        source.read()


def test_only_the_exposure_changes_while_it_runs() -> None:
    controls = everything()
    source = webcam(Driver(controls))
    camera = source._camera
    with pytest.raises(DeviceError, match="not open"):
        source.apply(live_settings(camera))
    source.open(0)
    source.apply(live_settings(camera, exposure_s=1 / 64))
    assert controls[cv2.CAP_PROP_EXPOSURE] == -6.0
    with pytest.raises(ConfigError, match="no units for gain"):
        source.apply(live_settings(camera, gain=8.0))
    del controls[cv2.CAP_PROP_EXPOSURE]
    with pytest.raises(ConfigError, match=r"refuses exposure_s = 0\.01"):
        source.apply(live_settings(camera, exposure_s=0.01))


def test_elsewhere_v4l2_is_called_webcam(rig_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = load_rig(rig_folder)
    for source, answer in (("webcam", None), ("v4l2", 'write source = "webcam"')):
        cameras = {"left": CameraConfig.model_validate({"source": source})}
        rig = dataclasses.replace(found, config=found.config.model_copy(update={"cameras": cameras}))
        monkeypatch.setattr(sys, "platform", "win32")
        try:
            if answer is None:
                assert isinstance(open_source("left", rig, SystemClock()), WebcamSource)
            else:
                with pytest.raises(ConfigError, match=answer):
                    open_source("left", rig, SystemClock())
        finally:
            monkeypatch.undo()
