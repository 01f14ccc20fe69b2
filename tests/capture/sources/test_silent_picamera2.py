"""A camera that falls silent: the driver's stop waits behind the frame that never comes."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator

import pytest
from devices.fake_picamera2 import FakePicamera2, Job
from wall_clock import in_time

from rhot.errors import DeviceError, HungDeviceError
from rhot.rig import CameraConfig
from rhot.rig.colors import nominal_colors
from rhot_capture.settings import CameraSettings
from rhot_capture.sources import grab
from rhot_capture.sources import picamera2 as module
from rhot_capture.sources.picamera2 import Picamera2Source

SECOND = 1_000_000_000
LIMIT_S = 20.0


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakePicamera2]:
    monkeypatch.setattr(module, "_WAIT_S", 0.02)
    monkeypatch.setattr(module, "_SILENCE_S", 0.1)
    fake = FakePicamera2()
    yield fake
    fake.end()


def opened(device: FakePicamera2, camera: CameraConfig | None = None) -> Picamera2Source:
    source = Picamera2Source("left", camera or CameraConfig(), device.modules, lambda: 0)
    source.open(0)
    return source


async def test_a_camera_that_falls_silent_is_closed_and_can_be_opened_again(device: FakePicamera2) -> None:
    source = opened(device)
    grabber = grab(source, "left")
    grabber.start()
    device.complete(SECOND)
    assert await asyncio.wait_for(grabber.next_frame(), LIMIT_S) is not None
    with pytest.raises(DeviceError, match="no frame for"):
        await asyncio.wait_for(grabber.next_frame(), LIMIT_S)
    # `stop` would wait for ever behind the capture that was given up.
    await asyncio.wait_for(grabber.stop(), LIMIT_S)
    assert device.calls == ["start", "flush", "stop", "close"]


@pytest.mark.real_time
async def test_a_stop_that_hangs_in_the_kernel_is_given_up(device: FakePicamera2) -> None:
    device.stop_hangs = True
    grabber = grab(opened(device), "left")
    grabber.start()
    begun = time.monotonic()
    with pytest.raises(HungDeviceError, match=r"camera left: close: its driver has not returned for 0\.3 s"):
        await asyncio.wait_for(grabber.stop(limit_s=0.3), LIMIT_S)
    in_time(time.monotonic() - begun, 1.5, "giving up a driver that hangs")


@pytest.mark.parametrize("call", ["open", "configure", "start"])
def test_what_the_driver_raises_at_the_opening_is_a_device_error(device: FakePicamera2, call: str) -> None:
    device.fails[call] = KeyError("libcamera: -22")
    with pytest.raises(DeviceError, match=r"camera left.*libcamera: -22"):
        opened(device)


def test_what_the_driver_raises_at_a_setting_is_a_device_error(device: FakePicamera2) -> None:
    source = opened(device)
    device.fails["set_controls"] = RuntimeError("Control FocusFoM is not advertised by libcamera")
    with pytest.raises(DeviceError, match=r"camera left.*not advertised"):
        source.apply(CameraSettings.from_config(CameraConfig(), nominal_colors({})))
    source.close()


def test_a_client_without_a_server_says_so_and_goes_on_alone(
    device: FakePicamera2, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_SYNC_WAIT_S", 2.0)
    source = opened(device, CameraConfig(sync="client"))
    first = [device.complete(round(k * SECOND), SyncReady=False) for k in (1, 2, 2.9)]
    device.complete(4 * SECOND, SyncReady=False)
    frame = source.read()
    assert frame is not None and frame.t_first_row_ns == 4 * SECOND - 4_000_000
    assert [request.released for request in first] == [1, 1, 1]
    assert "camera left" in source.problem and 'sync = "server"' in source.problem
    device.complete(5 * SECOND, SyncReady=True)
    assert source.read() is not None
    assert source.problem == ""
    source.close()


def test_no_capture_gets_between_the_emptied_queue_and_the_stop(
    device: FakePicamera2, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = opened(device)
    capture, flush = device.capture_request, device.cancel_all_and_flush
    entered, go_on, queued = threading.Event(), threading.Event(), threading.Event()

    def slow(wait: bool) -> Job:
        entered.set()
        go_on.wait(LIMIT_S)
        job = capture(wait)
        queued.set()
        return job

    def flush_first() -> None:
        flush()
        go_on.set()
        queued.wait(LIMIT_S)

    monkeypatch.setattr(device, "capture_request", slow)
    monkeypatch.setattr(device, "cancel_all_and_flush", flush_first)
    reader = threading.Thread(target=source.read, daemon=True)
    reader.start()
    assert entered.wait(LIMIT_S)
    closer = threading.Thread(target=source.close, daemon=True)
    closer.start()
    closer.join(0.1)
    go_on.set()
    closer.join(LIMIT_S)
    reader.join(LIMIT_S)
    assert not closer.is_alive()
    assert device.calls == ["start", "flush", "stop", "close"]
