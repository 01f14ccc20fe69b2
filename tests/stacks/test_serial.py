"""Sensors on a serial port on the kernel itself: a USB gadget of the test is a sensor that a virtual cable plugs in.

With `RHOT_DEVICE=/dev/serial/by-id/…` (and RHOT_FORMAT, `text` or `binary`) one test reads the sensor that is there.
"""

from __future__ import annotations

import os
import re
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from machine.stacks import DEVICE, in_guest, needs_emulated

from rhot.errors import DeviceError
from rhot.rig.feet_config import ImuConfig
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.sources.imu.serial import SerialSource, encode_binary, encode_text

pytestmark = pytest.mark.stacks
RATE_HZ = 100.0
GADGET = Path("/dev/ttyGS0")


class Sensor:
    """The far end of the cable: sends samples until it is stopped."""

    def __init__(self, sample: Callable[[int], bytes]) -> None:
        self._sample = sample
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self.sent = 0

    def __enter__(self) -> Sensor:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10.0)

    def _send(self) -> None:
        handle = os.open(GADGET, os.O_WRONLY | os.O_NOCTTY | os.O_NONBLOCK)
        subprocess.run(["stty", "-F", str(GADGET), "raw", "-echo"], check=True)
        try:
            while not self._stop.wait(1.0 / RATE_HZ):
                try:
                    os.write(handle, self._sample(self.sent))
                except BlockingIOError:
                    continue
                self.sent += 1
        finally:
            os.close(handle)


def text(number: int) -> bytes:
    return encode_text(10 * number, (0.1, 0.2, 9.8), (0.0, 0.0, 0.0, 1.0))


def binary(number: int) -> bytes:
    return encode_binary(number, 10_000 * number, np.array([0.1, 0.2, 9.8]), np.array([0.0, 0.0, 0.5]))


def plug_in() -> Path:
    """Plug the gadget in and return its stable name."""
    subprocess.run(["modprobe", "dummy_hcd"], check=True)
    subprocess.run(["modprobe", "g_serial", "use_acm=1", "iSerialNumber=RHOT1"], check=True)
    return found()


def found() -> Path:
    deadline = time.monotonic() + 30.0
    while True:
        names = sorted(Path("/dev/serial/by-id").glob("*")) if Path("/dev/serial/by-id").exists() else []
        if names and GADGET.exists():
            return names[0]
        assert time.monotonic() < deadline, sorted(map(str, Path("/dev").glob("tty[AG]*")))
        time.sleep(0.1)


def pull_out() -> None:
    for _ in range(50):
        if not Path("/sys/module/g_serial").exists():
            return
        subprocess.run(["rmmod", "g_serial"], capture_output=True, check=False)
        time.sleep(0.1)
    pytest.fail("the gadget is still in use")


@pytest.fixture
def port() -> Iterator[Path]:
    needs_emulated("somebody would have to pull it out")
    in_guest()
    yield plug_in()
    pull_out()


def read_for(source: SerialSource, seconds: float) -> ImuSamples:
    parts = []
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        parts.append(source.read(time.monotonic_ns()))
        time.sleep(0.005)
    return ImuSamples.joined(parts)


@pytest.mark.parametrize(("form", "sample"), [("text", text), ("binary", binary)])
def test_both_protocols_come_through_a_real_port(port: Path, form: str, sample: Callable[[int], bytes]) -> None:
    source = SerialSource(ImuConfig(device=str(port), format=form, rate_hz=RATE_HZ))
    source.open(0)
    with Sensor(sample):
        samples = read_for(source, 4.0)
    source.close()
    assert len(samples) > 100
    assert source.faults <= 1
    # Every sample that the sensor sent is there, at the sensor's own spacing.
    steps_s = 1e-9 * np.diff(samples.t_ns)
    assert abs(float(np.median(steps_s)) - 1.0 / RATE_HZ) < 1e-4
    np.testing.assert_allclose(samples.specific_force[-1][:2], [0.1, 0.2], atol=0.02)


def test_a_sensor_is_found_by_its_name_under_another_number(port: Path) -> None:
    """While somebody holds the old number open, the kernel gives a sensor that comes back another one."""
    source = SerialSource(ImuConfig(device=str(port), format="binary", rate_hz=RATE_HZ))
    source.open(0)
    first = port.resolve()
    with Sensor(binary):
        assert len(read_for(source, 1.0))
    holder = os.open(first, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        pull_out()
        with pytest.raises(DeviceError, match=rf"at {re.escape(str(port))} went away: .*plug it in again"):
            read_for(source, 5.0)
        source.close()
        with pytest.raises(DeviceError, match=r"cannot be opened: .*is it plugged in"):
            source.open(0)
        again = plug_in()
    finally:
        os.close(holder)
    assert again == port
    assert again.resolve() != first
    source.open(0)
    with Sensor(binary):
        assert len(read_for(source, 1.0))
    source.close()


def test_garbage_between_samples_costs_only_itself(port: Path) -> None:
    def noisy(number: int) -> bytes:
        return (b"\xff\x00\xa5\x5a" * 5 if number % 10 == 0 else b"") + binary(number)

    source = SerialSource(ImuConfig(device=str(port), format="binary", rate_hz=RATE_HZ))
    source.open(0)
    with Sensor(noisy) as sensor:
        samples = read_for(source, 3.0)
    source.close()
    assert len(samples) > 0.9 * sensor.sent - 10
    assert source.faults > 0


def test_another_protocol_is_an_error_that_names_it(port: Path) -> None:
    source = SerialSource(ImuConfig(device=str(port), format="text", rate_hz=RATE_HZ))
    source.open(0)
    with Sensor(binary), pytest.raises(DeviceError, match=r"nothing readable for 2\.\d s .*format = 'text'"):
        read_for(source, 8.0)
    source.close()


def test_a_port_that_another_program_reads_is_refused(port: Path) -> None:
    source = SerialSource(ImuConfig(device=str(port)))
    source.open(0)
    with pytest.raises(DeviceError, match=r"cannot be opened: .*is no other program using it"):
        SerialSource(ImuConfig(device=str(port))).open(0)
    source.close()
    source.open(0)
    source.close()


def test_the_sensor_that_is_here() -> None:
    if not re.match(r"/dev/(tty|serial)", DEVICE):
        pytest.skip("RHOT_DEVICE names no serial port")
    config = ImuConfig.model_validate({"device": DEVICE, "format": os.environ.get("RHOT_FORMAT", "text")})
    source = SerialSource(config)
    source.open(0)
    samples = read_for(source, 5.0)
    source.close()
    assert len(samples) > 4.0 * config.rate_hz
    assert source.faults <= 2
