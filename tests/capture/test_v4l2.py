from __future__ import annotations

import logging
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from rhot.errors import DeviceError
from rhot.rig import CameraConfig
from rhot.rig.colors import nominal_colors
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.v4l2 import V4l2Source

NOW_NS = 5_000_000_000


class FakeCapture:
    """A driver: keeps what it is told except for what it refuses."""

    def __init__(self, opened: bool = True, **forced: float) -> None:
        self.opened = opened
        self.forced = {getattr(cv2, f"CAP_PROP_{name}"): value for name, value in forced.items()}
        self.values: dict[int, float] = {}
        self.frames: list[bool] = [True] * 10
        self.stamps_ms: Iterator[float] = iter(4_990.0 + 16.0 * number for number in range(100))
        self.stamp_ms = 0.0
        self.released = False

    def isOpened(self) -> bool:
        return self.opened

    def set(self, identifier: int, value: float) -> bool:
        self.values[identifier] = value
        return self.forced.get(identifier, value) == value

    def get(self, identifier: int) -> float:
        if identifier == cv2.CAP_PROP_POS_MSEC:
            return self.stamp_ms
        return self.forced.get(identifier, self.values.get(identifier, 0.0))

    def read(self) -> tuple[bool, Any]:
        ok = self.frames.pop(0) if self.frames else False
        self.stamp_ms = next(self.stamps_ms)
        return ok, np.zeros((480, 640, 3), np.uint8) if ok else None

    def release(self) -> None:
        self.released = True


def source_with(capture: FakeCapture, camera: CameraConfig | None = None) -> tuple[V4l2Source, list[Any]]:
    asked: list[Any] = []

    def video_capture(device: Any, backend: int) -> FakeCapture:
        asked.append((device, backend))
        return capture

    names = [name for name in dir(cv2) if name.startswith("CAP_")]
    module = SimpleNamespace(
        VideoCapture=video_capture,
        VideoWriter_fourcc=cv2.VideoWriter.fourcc,
        **{name: getattr(cv2, name) for name in names},
    )
    camera = camera or CameraConfig(source="v4l2", device="2", rate_hz=60.0, exposure_s=0.004)
    return V4l2Source("left", camera, module, lambda: max(NOW_NS, round(1e6 * capture.stamp_ms))), asked


def test_everything_is_locked(caplog: pytest.LogCaptureFixture) -> None:
    capture = FakeCapture()
    source, asked = source_with(capture, CameraConfig(source="v4l2", device="2", focus_dioptres=1.5))
    with caplog.at_level(logging.WARNING):
        source.open(0)
    assert asked == [(2, cv2.CAP_V4L2)]
    wanted = {
        cv2.CAP_PROP_FRAME_WIDTH: 640,
        cv2.CAP_PROP_FRAME_HEIGHT: 480,
        cv2.CAP_PROP_FPS: 60.0,
        cv2.CAP_PROP_AUTO_EXPOSURE: 1.0,
        cv2.CAP_PROP_EXPOSURE: 40.0,
        cv2.CAP_PROP_GAIN: 4.0,
        cv2.CAP_PROP_AUTO_WB: 0.0,
        cv2.CAP_PROP_AUTOFOCUS: 0.0,
        cv2.CAP_PROP_FOCUS: 1.5,
    }
    assert {key: capture.values[key] for key in wanted} == pytest.approx(wanted)
    assert not caplog.records


def test_what_the_driver_refuses_is_named(caplog: pytest.LogCaptureFixture) -> None:
    source, _ = source_with(FakeCapture(AUTO_EXPOSURE=3.0, FPS=30.0))
    with caplog.at_level(logging.WARNING):
        source.open(0)
    text = caplog.text
    assert "manual exposure" in text
    assert "rate_hz = 60" in text
    assert "gain" not in text


def test_a_wrong_size_is_an_error_and_frees_the_device() -> None:
    capture = FakeCapture(FRAME_WIDTH=1280.0)
    source, _ = source_with(capture)
    with pytest.raises(DeviceError, match="1280x480 instead of 640x480"):
        source.open(0)
    assert capture.released


def test_an_absent_device_is_named() -> None:
    source, _ = source_with(FakeCapture(opened=False), CameraConfig(source="v4l2", device="/dev/video9"))
    with pytest.raises(DeviceError, match=r"/dev/video9.*plugged in"):
        source.open(0)


def test_the_drivers_timestamp_less_the_exposure_counts() -> None:
    source, _ = source_with(FakeCapture())
    source.open(0)
    frame = source.read()
    assert frame is not None
    assert frame.t_first_row_ns == 4_990_000_000 - 4_000_000
    assert (frame.index, frame.exposure_s) == (0, 0.004)


def test_an_impossible_timestamp_is_replaced_and_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    capture = FakeCapture()
    capture.stamps_ms = iter([0.0] * 10)
    source, _ = source_with(capture, CameraConfig(source="v4l2", exposure_s=0.004, readout_s=0.01, rate_hz=60.0))
    with caplog.at_level(logging.WARNING):
        source.open(0)
        frames = [source.read(), source.read()]
    assert [frame.t_first_row_ns for frame in frames if frame] == [NOW_NS - 14_000_000] * 2
    assert caplog.text.count("away from the monotonic clock") == 1


def test_frames_before_the_start_are_thrown_away() -> None:
    source, _ = source_with(FakeCapture())
    source.open(5_000_000_000)
    source_frame = source.read()
    assert source_frame is not None
    assert source_frame.t_first_row_ns == 5_006_000_000 - 4_000_000
    assert source_frame.index == 1


def test_a_hiccup_is_survived_and_silence_is_an_error() -> None:
    capture = FakeCapture()
    capture.frames = [False, False, True]
    source, _ = source_with(capture)
    source.open(0)
    assert source.read() is not None
    with pytest.raises(DeviceError, match="stopped delivering"):
        source.read()


def test_live_settings_reach_the_driver_and_the_timestamps() -> None:
    capture = FakeCapture()
    source, _ = source_with(capture)
    camera = CameraConfig(source="v4l2")
    settings = CameraSettings.from_config(camera, nominal_colors({})).changed({"exposure_s": 0.002, "gain": 2.0}, 60.0)
    with pytest.raises(DeviceError, match="not open"):
        source.apply(settings)
    source.open(0)
    source.apply(settings)
    assert capture.values[cv2.CAP_PROP_EXPOSURE] == pytest.approx(20.0)
    frame = source.read()
    assert frame is not None
    assert frame.exposure_s == 0.002


def test_after_close_there_is_nothing() -> None:
    capture = FakeCapture()
    source, _ = source_with(capture)
    source.open(0)
    source.close()
    source.close()
    assert capture.released
    assert source.read() is None
