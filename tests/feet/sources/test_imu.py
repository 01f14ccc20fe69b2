from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.anatomy.body_proportions import BodyModel
from rhot.errors import ConfigError, DeviceError
from rhot.geometry.rotations import quaternion_from_rotation, rotation_x
from rhot.rig.feet_config import BodyConfig, ImuConfig
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.service import make_imu_source
from rhot_feet.sources.imu.recorded import RecordedSource, read_samples
from rhot_feet.sources.imu.serial import (
    BinaryDecoder,
    DeviceClock,
    SerialSource,
    TextDecoder,
    encode_binary,
    encode_text,
)
from rhot_sim.sources.imu import SimulatedSource
from rhot_sim.walker.world import WalkerWorld

START = 1_700_000_000_000_000_000
MS = 1_000_000
LEVEL = (0.0, 0.0, 0.0, 1.0)


def text_lines(count: int, tick_us: int = 1000, first: int = 5000) -> list[bytes]:
    """Lines of 100 samples a second; the x acceleration counts up by 0.1."""
    return [encode_text((first + k * 10_000 // tick_us) % (1 << 32), (0.1 * k, 0.0, 0.0), LEVEL) for k in range(count)]


def feed_text(lines: list[bytes], decoder: TextDecoder | None = None) -> ImuSamples:
    decoder = decoder or TextDecoder(100.0)
    return ImuSamples.joined([decoder.decode(line, START + k * 10 * MS + 3 * MS) for k, line in enumerate(lines)])


@pytest.mark.parametrize("tick_us", [1000, 1])
def test_text_in_milliseconds_or_microseconds(tick_us: int) -> None:
    samples = feed_text(text_lines(60, tick_us))
    # The first dozen shows the unit of the timestamp.
    assert len(samples) >= 47
    np.testing.assert_allclose(np.diff(samples.t_ns), 10 * MS, atol=2000)
    np.testing.assert_allclose(np.diff(samples.specific_force[:, 0]), 0.1, atol=1e-9)
    np.testing.assert_allclose(samples.specific_force[:, 2], 9.81, atol=1e-9)
    assert abs(int(samples.t_ns[-1]) - (START + 59 * 10 * MS + 3 * MS)) < 10_000


def test_text_arrives_in_crumbs() -> None:
    stream = b"".join(text_lines(60))
    decoder = TextDecoder(100.0)
    parts = [decoder.decode(stream[at : at + 7], START + at * MS // 7) for at in range(0, len(stream), 7)]
    assert len(ImuSamples.joined(parts)) >= 46
    assert decoder.faults == 0


def test_text_with_lost_bytes_and_garbage() -> None:
    random = np.random.default_rng(4)
    stream = bytearray(b"".join(text_lines(400)))
    for _ in range(40):
        at = int(random.integers(2000, len(stream) - 10))
        if random.random() < 0.5:
            del stream[at : at + int(random.integers(1, 6))]
        else:
            stream[at : at + 3] = random.integers(0, 256, 3, dtype=np.uint8).tobytes()
    decoder = TextDecoder(100.0)
    parts = [
        decoder.decode(bytes(stream[at : at + 40]), START + at * 10 * MS // 40) for at in range(0, len(stream), 40)
    ]
    samples = ImuSamples.joined(parts)
    # One sample is two lines; each damage costs one or two samples.
    assert 320 <= len(samples) <= 388
    assert decoder.faults >= 20
    assert (np.diff(samples.t_ns) > 0).all()
    np.testing.assert_allclose(np.linalg.norm(samples.orientation_xyzw, axis=1), 1.0)


def test_text_of_another_baud_rate_fills_no_memory() -> None:
    decoder = TextDecoder(100.0)
    noise = np.random.default_rng(1).integers(128, 256, 100_000, dtype=np.uint8).tobytes()
    for at in range(0, len(noise), 1000):
        assert len(decoder.decode(noise[at : at + 1000], START)) == 0
    assert decoder.faults == 100


def test_text_timestamp_wraps_around() -> None:
    samples = feed_text(text_lines(60, tick_us=1, first=(1 << 32) - 300_000))
    assert len(samples) >= 47
    np.testing.assert_allclose(np.diff(samples.t_ns), 10 * MS, atol=2000)


def test_text_pairs_lines_of_different_moments() -> None:
    """Accelerations between two rotations get the rotation of their own moment."""
    decoder = TextDecoder(100.0)
    parts = []
    for k in range(40):
        q = quaternion_from_rotation(rotation_x(0.02 * k))
        parts.append(decoder.decode(f"{10 * k} R {' '.join(f'{v:.6f}' for v in q)};\n".encode(), START + k * 10 * MS))
        parts.append(decoder.decode(f"{10 * k + 5} L 0 0 0;\n".encode(), START + (k * 10 + 5) * MS))
    samples = ImuSamples.joined(parts)
    angles = 2.0 * np.arctan2(samples.orientation_xyzw[:, 0], samples.orientation_xyzw[:, 3])
    ticks = np.rint((samples.t_ns - samples.t_ns[0]) / MS)
    np.testing.assert_allclose(angles - angles[0], 0.002 * ticks, atol=1e-4)
    np.testing.assert_allclose(samples.angular_rate[1:, 0], 2.0, atol=0.02)


@pytest.mark.parametrize("order", ["LR", "RL"])
@pytest.mark.parametrize("apart_ms", [-14, -4, -1, 1, 4, 9, 14])
def test_text_reports_whose_stamps_differ_are_paired(apart_ms: int, order: str) -> None:
    """A BNO080 stamps each report with its own measurement; their order on the line says nothing."""
    decoder = TextDecoder(100.0)
    parts = []
    for k in range(60):
        lines = {"L": f"{1000 + 10 * k + apart_ms} L {0.1 * k:.1f} 0 0;", "R": f"{1000 + 10 * k} R 0 0 0 1;"}
        data = "\n".join(lines[kind] for kind in order).encode()
        parts.append(decoder.decode(data, START + k * 10 * MS + 12 * MS))
    samples = ImuSamples.joined(parts)
    assert len(samples) >= 45
    assert decoder.faults == 0
    np.testing.assert_allclose(np.diff(samples.t_ns), 10 * MS, atol=2000)
    np.testing.assert_allclose(np.diff(samples.specific_force[:, 0]), 0.1, atol=1e-9)


def test_stamps_that_step_back_within_one_kind_are_refused_and_counted() -> None:
    decoder = TextDecoder(100.0)
    lines = text_lines(60)
    samples = feed_text([*lines[:40], *lines[30:32], *lines[40:]], decoder)
    assert decoder.faults == 4, "two lines of each of two samples"
    assert (np.diff(samples.t_ns) > 0).all()


def binary_frames(count: int, first_us: int = 0) -> list[bytes]:
    return [
        encode_binary(
            k, first_us + 2500 * k, np.array([0.1, -0.2, 9.81]), np.array([0.0, 0.5, -1.0]), (0.6, 0.0, 0.0, 0.8)
        )
        for k in range(count)
    ]


def test_binary_round_trip() -> None:
    decoder = BinaryDecoder()
    frames = binary_frames(300, (1 << 32) - 100_000)
    samples = ImuSamples.joined([decoder.decode(frame, START + k * 2_500_000) for k, frame in enumerate(frames)])
    assert len(samples) == 300 and decoder.faults == 0 and decoder.lost == 0
    np.testing.assert_allclose(samples.specific_force, np.tile([0.1, -0.2, 9.81], (300, 1)), atol=0.0026)
    np.testing.assert_allclose(samples.angular_rate, np.tile([0.0, 0.5, -1.0], (300, 1)), atol=0.0006)
    np.testing.assert_allclose(samples.orientation_xyzw, np.tile([0.6, 0.0, 0.0, 0.8], (300, 1)), atol=1e-4)
    assert set(np.diff(samples.t_ns)) == {2_500_000}


def test_binary_with_lost_and_flipped_bytes() -> None:
    random = np.random.default_rng(2)
    stream = bytearray(b"".join(binary_frames(1000)))
    for _ in range(30):
        at = int(random.integers(100, len(stream) - 100))
        if random.random() < 0.5:
            del stream[at]
        else:
            stream[at] ^= int(random.integers(1, 256))
    decoder = BinaryDecoder()
    parts = [decoder.decode(bytes(stream[at : at + 61]), START + at * 83_333) for at in range(0, len(stream), 61)]
    samples = ImuSamples.joined(parts)
    assert 965 <= len(samples) < 1000
    assert abs(decoder.lost - (1000 - len(samples))) <= 1
    # Nothing damaged gets through: the check sums hold.
    np.testing.assert_allclose(samples.specific_force, np.tile([0.1, -0.2, 9.81], (len(samples), 1)), atol=0.0026)


def test_binary_without_orientation_finds_down() -> None:
    force = np.array([0.0, 9.81, 0.0])
    frames = [encode_binary(k, 2500 * k, force, np.zeros(3)) for k in range(50)]
    decoder = BinaryDecoder()
    samples = ImuSamples.joined([decoder.decode(frame, START + k * 2_500_000) for k, frame in enumerate(frames)])
    x, y, z, w = samples.orientation_xyzw[-1]
    # The sensor's y axis is up.
    np.testing.assert_allclose(
        [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], [0, 0, 1], atol=1e-3
    )


def test_clock_takes_the_shortest_delay_and_follows_drift() -> None:
    random = np.random.default_rng(0)
    clock = DeviceClock(1000)
    errors = []
    for k in range(6000):
        true_ns = START + k * 10 * MS
        stamp = (4_000_000_000 + round(k * 10_000 * (1.0 - 30e-6))) % (1 << 32)
        t_ns = clock.to_rig_ns(stamp, true_ns + 1 * MS + int(random.exponential(6.0) * MS))
        assert t_ns is not None
        errors.append((t_ns - true_ns) / MS)
    assert 0.8 < np.median(errors[300:]) < 1.6
    assert np.ptp(errors[300:]) < 1.5


def test_clock_survives_a_restart_and_doubts_a_single_jump() -> None:
    clock = DeviceClock(1000)
    times = [clock.to_rig_ns(1_000_000 + 10_000 * k, START + k * 10 * MS) for k in range(10)]
    assert None not in times
    assert clock.to_rig_ns(900_000_000, START + 100 * MS) is None
    assert clock.to_rig_ns(1_110_000, START + 110 * MS) == START + 110 * MS
    after = [clock.to_rig_ns(10_000 * k, START + 2_000 * MS + k * 10 * MS) for k in range(8)]
    assert after[:4] == [None] * 4
    assert after[4:] == [START + 2_000 * MS + k * 10 * MS for k in range(4, 8)]


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_clock_follows_a_rig_clock_that_was_set(step_s: int) -> None:
    clock = DeviceClock(1000)
    for k in range(10):
        assert clock.to_rig_ns(10_000 * k, START + k * 10 * MS) == START + k * 10 * MS
    for k in range(10, 20):
        arrival_ns = START + step_s * 1000 * MS + k * 10 * MS
        assert clock.to_rig_ns(10_000 * k, arrival_ns) == arrival_ns


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    """A pseudo terminal: what is written to the file descriptor arrives at the port."""
    master, slave = os.openpty()
    name = os.ttyname(slave)
    os.close(slave)
    yield master, name
    with contextlib.suppress(OSError):
        os.close(master)


def drain(source: SerialSource, wanted: int, now_ns: int) -> ImuSamples:
    parts: list[ImuSamples] = []
    # A pseudo terminal hands on what was written when the kernel finds time for it.
    until_s = time.monotonic() + 10.0
    while True:
        parts.append(source.read(now_ns))
        if sum(map(len, parts)) >= wanted or time.monotonic() > until_s:
            return ImuSamples.joined(parts)
        time.sleep(0.001)


def wait_until_there(port: int, wanted: int) -> None:
    """Wait until a port has so many bytes to read; counted in reads, a late byte would look like a lost one."""
    until_s = time.monotonic() + 10.0
    while struct.unpack("i", fcntl.ioctl(port, termios.FIONREAD, bytes(4)))[0] < wanted:
        assert time.monotonic() < until_s
        time.sleep(0.0005)


def test_serial_text_unplugged_and_back(terminal: tuple[int, str]) -> None:
    master, name = terminal
    source = SerialSource(ImuConfig(source="serial", device=name))
    keeper = os.open(name, os.O_RDWR | os.O_NOCTTY)
    source.open(START)
    count = 0
    for k, lines in enumerate(text_lines(40)):
        os.write(master, lines)
        wait_until_there(keeper, len(lines))
        count += len(source.read(START + k * 10 * MS))
    assert count >= 27
    os.close(keeper)
    os.close(master)
    with pytest.raises(DeviceError, match=f"{name} went away.*plug it in"):
        for _ in range(100):
            source.read(START + 500 * MS)
    source.close()
    with pytest.raises(DeviceError, match="cannot be opened"):
        source.open(START)
    again, slave = os.openpty()
    source = SerialSource(ImuConfig(source="serial", device=os.ttyname(slave), format="binary"))
    source.open(START)
    for k, frame in enumerate(binary_frames(20)):
        os.write(again, frame)
        assert len(drain(source, 1, START + k * 2_500_000)) == 1
    source.close()
    source.close()
    os.close(slave)
    os.close(again)


def test_serial_silence_is_an_error(terminal: tuple[int, str]) -> None:
    _, name = terminal
    source = SerialSource(ImuConfig(source="serial", device=name))
    with pytest.raises(DeviceError, match="is not open"):
        source.read(START)
    source.open(START)
    assert len(source.read(START)) == 0
    assert len(source.read(START + 1900 * MS)) == 0
    with pytest.raises(DeviceError, match=r"nothing readable for 2\.1 s.*115200.*'text'"):
        source.read(START + 2100 * MS)
    source.close()


def test_recorded_plays_at_its_pace_and_loops(tmp_path: Path) -> None:
    rows = [f"{10 + 0.01 * k:.3f},1,0,0,0,{k},0,0,9,9" for k in range(50)]
    path = tmp_path / "imu.csv"
    path.write_text("t,qw,qx,qy,qz,lax,lay,laz,px,py\n" + "\n".join(rows))
    once, loop = RecordedSource(path), RecordedSource(path, loop=True)
    for source in (once, loop):
        source.open(START)
        assert len(source.read(START - 1)) == 0
        assert len(source.read(START + 95 * MS)) == 10
        assert len(source.read(START + 95 * MS)) == 0
        assert len(source.read(START + 495 * MS)) == 40
    assert len(once.read(START + 2000 * MS)) == 0
    second = loop.read(START + 1245 * MS)
    assert second.t_ns[0] == START + 500 * MS and second.specific_force[0, 0] == 0.0
    assert len(second) == 75 and (np.diff(second.t_ns) == 10 * MS).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,2\n", "line 1: the header must hold t,qw"),
        ("t,ax,ay,az,gx,gy,gz\n0,0,0,9.8,0,0,0\n", "holds 1 samples"),
        ("t,ax,ay,az,gx,gy,gz\n0,0,0,9.8,0,0,0\n0.01,0,0,x,0,0,0\n", "line 3: az 'x' is not a number"),
        ("t,ax,ay,az,gx,gy,gz\n0,0,0,9.8,0,0,0\n0.01,0,0,nan,0,0,0\n", "line 3: az 'nan' is out of bounds"),
        ("t,ax,ay,az,gx,gy,gz\n0,0,0,9.8,0,0,0\n0.01,0\n", "line 3: 2 values, 7 are needed"),
        ("t,ax,ay,az,gx,gy,gz\n1,0,0,9.8,0,0,0\n0.5,0,0,9.8,0,0,0\n", "line 3: time 0.5 s is not after"),
        ("t,qw,qx,qy,qz,lax,lay,laz\n1,0,0,0,0,0,0,0\n2,1,0,0,0,0,0,0\n", "line 2: the quaternion"),
    ],
)
def test_recorded_files_that_are_wrong(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "imu.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        RecordedSource(path).open(START)


def test_recorded_bytes_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "imu.csv"
    path.write_bytes(b"\xff\xfe\x00\x01" * 100)
    with pytest.raises(ConfigError, match="cannot be read"):
        read_samples(path)


def test_real_recordings_agree(shared_data: Path) -> None:
    """Both forms of one trial are the same motion: forces at 100 Hz are those at 200 Hz."""
    folder = shared_data / "foot_imu"
    fused, raw = (read_samples(folder / f"2017-11-22-11-48-35_{form}.csv") for form in ("bno100", "raw200"))

    def at(samples: ImuSamples, values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.interp(fused.t_ns[50:-50], samples.t_ns, values)

    for axis in range(3):
        rates = at(raw, raw.angular_rate[:, axis]), at(fused, fused.angular_rate[:, axis])
        assert np.corrcoef(*rates)[0, 1] > 0.95
        forces = at(raw, raw.specific_force[:, axis]), at(fused, fused.specific_force[:, axis])
        assert np.corrcoef(*forces)[0, 1] > 0.9


def test_simulated_sensor_delivers_each_sample_once() -> None:
    world = WalkerWorld(1, BodyModel.from_config(BodyConfig()), "walk")
    source = SimulatedSource(world, "left")
    source.open(START)
    parts = [source.read(START + k * 7 * MS) for k in range(300)]
    samples = ImuSamples.joined(parts)
    assert (np.diff(samples.t_ns) > 0).all()
    expected = world.imu("left", 0.0, 2.093)[0]
    assert len(expected) - 3 <= len(samples) <= len(expected)
    assert 9.0 < np.linalg.norm(samples.specific_force[:50], axis=1).mean() < 10.5
    source.close()
    assert len(source.read(START + 5000 * MS)) == 0


def test_factory(tmp_path: Path) -> None:
    assert isinstance(make_imu_source(ImuConfig(device="/dev/null"), tmp_path), SerialSource)
    assert isinstance(make_imu_source(ImuConfig(source="recorded", path="a.csv"), tmp_path), RecordedSource)
    with pytest.raises(ConfigError, match="only in `rhot sim --feet`"):
        make_imu_source(ImuConfig(source="simulated"), tmp_path)
