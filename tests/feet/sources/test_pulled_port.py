"""A sensor whose plug is pulled in the middle of a session comes back whenever it is plugged in again."""

from __future__ import annotations

import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
from devices.pulled_port import PulledPort

from rhot.errors import DeviceError
from rhot.rig.feet_config import ImuConfig
from rhot_feet.sources.imu.serial import SerialSource, encode_text

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
LEVEL = (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def port(tmp_path: Path) -> Iterator[PulledPort]:
    port = PulledPort(tmp_path)
    yield port
    port.pull_out()


def hear(source: SerialSource, port: PulledPort, since_ns: int, lines: int = 40) -> int:
    """Send samples, ten milliseconds apart, and return how many came out."""
    heard = 0
    for k in range(lines):
        port.send(encode_text(5000 + 10 * k, (0.0, 0.0, 0.0), LEVEL))
        until_s = time.monotonic() + 5.0
        while True:
            got = len(source.read(since_ns + k * 10_000_000))
            heard += got
            # The first dozen lines show the timestamp's unit and give nothing.
            if got or k < 13 or time.monotonic() > until_s:
                break
    return heard


def test_a_sensor_that_returns_late_is_heard_again(port: PulledPort) -> None:
    source = SerialSource(ImuConfig(source="serial", device=str(port.path)))
    source.open(START)
    assert hear(source, port, START) >= 25
    port.pull_out()
    with pytest.raises(DeviceError, match="went away"):
        for _ in range(100):
            source.read(START + 2 * SECOND)
    source.close()
    with pytest.raises(DeviceError, match="cannot be opened"):
        source.open(START)
    port.plug_in()
    # The service opens with the start of the session, a minute ago by now.
    source.open(START)
    now_ns = START + 60 * SECOND
    assert len(source.read(now_ns)) == 0
    assert len(source.read(now_ns + SECOND)) == 0, "it has two seconds from its opening on"
    assert hear(source, port, now_ns + 3 * SECOND // 2) >= 25
    source.close()


def test_a_sensor_that_is_opened_late_and_stays_silent_is_told(port: PulledPort) -> None:
    source = SerialSource(ImuConfig(source="serial", device=str(port.path)))
    source.open(START)
    assert len(source.read(START + 60 * SECOND)) == 0
    with pytest.raises(DeviceError, match=r"nothing readable for 2\.1 s"):
        source.read(START + 62 * SECOND + SECOND // 10)
    source.close()


def test_a_clock_that_steps_back_does_not_hide_silence(port: PulledPort) -> None:
    source = SerialSource(ImuConfig(source="serial", device=str(port.path)))
    source.open(START)
    assert len(source.read(START + 3600 * SECOND)) == 0
    assert len(source.read(START)) == 0
    with pytest.raises(DeviceError, match=r"nothing readable for 2\.5 s"):
        source.read(START + 5 * SECOND // 2)
    source.close()


@pytest.mark.parametrize(
    "error", [termios.error(5, "Input/output error"), TypeError("fd is None"), OSError(19, "gone")]
)
def test_what_the_driver_raises_is_a_device_error(
    port: PulledPort, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    source = SerialSource(ImuConfig(source="serial", device=str(port.path)))

    def fail(*_: object, **__: object) -> None:
        raise error

    with monkeypatch.context() as patch:
        patch.setattr(serial, "Serial", fail)
        with pytest.raises(DeviceError, match="cannot be opened"):
            source.open(START)
    source.open(START)
    monkeypatch.setattr(serial.Serial, "read", fail)
    with pytest.raises(DeviceError, match="went away"):
        source.read(START)
    monkeypatch.setattr(serial.Serial, "close", fail)
    source.close()
