"""The firmware of the ankle sensor, compiled here: its bytes are read by our decoders, whole and damaged.

`board/` stands in for the board and for the sensor's library, so that the sketch itself runs, button included. No board
is involved.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from rhot_feet.imu.samples import ImuSamples
from rhot_feet.sources.imu.serial import BinaryDecoder, TextDecoder, encode_binary, encode_text

FIRMWARE = Path(__file__).parents[3] / "firmware" / "ankle_sensor"
BOARD = Path(__file__).parent / "board"
COMPILER = shutil.which("g++")
START = 1_700_000_000_000_000_000
MS = 1_000_000
FRAME = 30

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs g++ to compile the firmware on this machine")


def compile_here(out: Path, *sources: str, flags: tuple[str, ...] = ()) -> Path:
    warnings = ("-Wall", "-Wextra", "-Wconversion", "-Werror")
    command = [str(COMPILER), "-std=c++11", *warnings, *flags, f"-I{BOARD}", f"-I{FIRMWARE}", *sources, "-o", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return out


@pytest.fixture(scope="module")
def encoder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compile_here(tmp_path_factory.mktemp("firmware") / "lines", str(BOARD / "lines.cpp"))


def encoded(encoder: Path, records: list[str]) -> bytes:
    done = subprocess.run([str(encoder)], input="\n".join(records).encode(), capture_output=True, check=True)
    return done.stdout


def sketch(folder: Path, binary: int) -> tuple[bytes, int]:
    """Return what the sketch sends in two seconds, and how often it kept a calibration."""
    source = (FIRMWARE / "ankle_sensor.ino").read_text(encoding="utf-8")
    assert "#define RHOT_BINARY 0 " in source
    chosen = source.replace("#define RHOT_BINARY 0 ", f"#define RHOT_BINARY {binary} ")
    # The IDE adds this include to every sketch.
    (folder / "sketch.cpp").write_text(f"#include <Arduino.h>\n{chosen}", encoding="utf-8")
    program = compile_here(folder / "sketch", str(folder / "sketch.cpp"), str(BOARD / "board.cpp"))
    done = subprocess.run([str(program)], capture_output=True, check=True)
    return done.stdout, int(done.stderr)


def text_records(count: int) -> list[str]:
    records = []
    for k in range(count):
        stamp = (4_294_960_000 + 10_000 * k) % (1 << 32)
        records += [f"L {stamp} {0.1 * k:.3f} -1.5 2.25", f"R {stamp} 0 0 0.6 0.8"]
    return records


def frame_records(count: int) -> list[str]:
    return [
        f"F {k % 256} {(4_294_960_000 + 2500 * k) % (1 << 32)} "
        f"{0.05 * k:.3f} -2.5 9.81 0.1 -0.2 {0.01 * k:.3f} 0 0 0.6 0.8"
        for k in range(count)
    ]


def decode_text(data: bytes) -> tuple[ImuSamples, TextDecoder]:
    decoder = TextDecoder(100.0)
    lines = data.split(b"\n")
    parts = [decoder.decode(line + b"\n", START + k // 2 * 10 * MS + 3 * MS) for k, line in enumerate(lines) if line]
    return ImuSamples.joined(parts), decoder


def decode_frames(data: bytes) -> tuple[ImuSamples, BinaryDecoder]:
    decoder = BinaryDecoder()
    parts = [
        decoder.decode(data[at : at + FRAME], START + at // FRAME * 2_500_000 + 3 * MS)
        for at in range(0, len(data), FRAME)
    ]
    return ImuSamples.joined(parts), decoder


def test_text_is_what_our_encoder_writes(encoder: Path) -> None:
    data = encoded(encoder, text_records(40))
    ours = b"".join(
        encode_text((4_294_960_000 + 10_000 * k) % (1 << 32), (0.1 * k, -1.5, 2.25), (0.0, 0.0, 0.6, 0.8))
        for k in range(40)
    )
    assert data == ours
    samples, decoder = decode_text(data)
    assert decoder.faults == 0
    assert len(samples) >= 27
    np.testing.assert_allclose(np.diff(samples.specific_force[:, 0]), 0.1, atol=1e-9)
    np.testing.assert_allclose(samples.specific_force[:, 2], 2.25 + 9.81, atol=1e-9)
    np.testing.assert_allclose(samples.orientation_xyzw, [[0.0, 0.0, 0.6, 0.8]] * len(samples), atol=1e-5)
    np.testing.assert_allclose(np.diff(samples.t_ns), 10 * MS, atol=2000)


def test_frames_are_what_our_encoder_writes(encoder: Path) -> None:
    data = encoded(encoder, frame_records(600))
    ours = b"".join(
        encode_binary(
            k,
            4_294_960_000 + 2500 * k,
            np.array([np.float32(f"{0.05 * k:.3f}"), -2.5, np.float32(9.81)], dtype=np.float64),
            np.array([np.float32(0.1), np.float32(-0.2), np.float32(f"{0.01 * k:.3f}")], dtype=np.float64),
            (0.0, 0.0, 0.6, 0.8),
        )
        for k in range(600)
    )
    theirs = np.frombuffer(data, np.uint8).reshape(-1, FRAME)
    expected = np.frombuffer(ours, np.uint8).reshape(-1, FRAME)
    # Sync, length, sequence and time are equal; values may be a step apart where a half is rounded in single precision.
    np.testing.assert_array_equal(theirs[:, :8], expected[:, :8])
    values, ours_values = (frames[:, 8:28].copy().view("<i2").astype(int) for frames in (theirs, expected))
    assert np.abs(values - ours_values).max() <= 1
    samples, decoder = decode_frames(data)
    assert (len(samples), decoder.faults, decoder.lost) == (600, 0, 0)
    np.testing.assert_allclose(samples.specific_force[:, 2], 9.81, atol=0.003)
    np.testing.assert_allclose(samples.orientation_xyzw, [[0.0, 0.0, 0.6, 0.8]] * 600, atol=1e-4)


def test_values_beyond_the_scale_are_clipped_and_no_number_is_not_sent(encoder: Path) -> None:
    data = encoded(encoder, ["F 0 0 400 -400 9.81 50 -50 0 0 0 0 1"])
    values = np.frombuffer(data[8:28], "<i2")
    assert values[[0, 1, 3, 4, 9]].tolist() == [32767, -32768, 32767, -32768, 16384]
    assert encoded(encoder, ["F 1 2500 nan 0 9.81 0 0 0 0 0 0 1", "L 5 inf 0 0", "R 5 nan 0 0 1"]) == b""


@pytest.mark.parametrize("damage", ["flipped", "lost", "inserted"])
def test_a_bad_byte_costs_one_frame_and_no_more(encoder: Path, damage: str) -> None:
    data = encoded(encoder, frame_records(40))
    for at in range(10 * FRAME, 11 * FRAME):
        middle = {"flipped": bytes([data[at] ^ 0x41]), "lost": b"", "inserted": b"\xa5" + data[at : at + 1]}[damage]
        damaged = data[:at] + middle + data[at + 1 :]
        samples, decoder = decode_frames(damaged)
        # A byte too many between two frames, or a second A5 before the first, is no part of any frame.
        spared = data[10 * FRAME : 11 * FRAME] in damaged
        assert len(samples) == (40 if spared else 39)
        assert decoder.lost == (0 if spared else 1)
        force = samples.specific_force[:, 0]
        steps = np.round(force / 0.05).astype(int)
        assert spared or 10 not in steps
        np.testing.assert_allclose(force, 0.05 * steps, atol=0.003)


@pytest.mark.parametrize("damage", ["flipped", "lost", "inserted"])
def test_a_bad_byte_in_a_line_never_makes_a_wrong_direction(encoder: Path, damage: str) -> None:
    """Text has no check sum: a digit may change a value, but a quaternion of the wrong length is dropped."""
    data = encoded(encoder, text_records(40))
    lines = data.split(b";\n")
    start = sum(len(line) + 2 for line in lines[:41])
    assert lines[41].split()[1] == b"R"
    for at in range(start, start + len(lines[41]) + 1):
        middle = {"flipped": bytes([data[at] ^ 0x41]), "lost": b"", "inserted": b"\xff" + data[at : at + 1]}[damage]
        samples, _ = decode_text(data[:at] + middle + data[at + 1 :])
        assert len(samples) >= 24
        assert np.abs(samples.orientation_xyzw - [0.0, 0.0, 0.6, 0.8]).max() < 0.06


@pytest.mark.parametrize("binary", [0, 1])
def test_the_sketch_runs_and_its_button_keeps_the_calibration(tmp_path: Path, binary: int) -> None:
    data, saved = sketch(tmp_path, binary)
    assert saved == 2, "of four presses every second one keeps what was calibrated"
    samples, decoder = (decode_frames if binary else decode_text)(data)
    assert decoder.faults == 0
    rate_hz = 400 if binary else 100
    assert len(samples) >= 2 * rate_hz - 20
    np.testing.assert_allclose(np.diff(samples.t_ns), 1e9 / rate_hz, atol=2e4)
    # The acceleration is the time in seconds, the rotation half of it about z.
    np.testing.assert_allclose(np.diff(samples.specific_force[:, 0]), 1.0 / rate_hz, atol=0.006)
    z = samples.orientation_xyzw[:, 2] / samples.orientation_xyzw[:, 3]
    np.testing.assert_allclose(np.diff(2.0 * np.arctan(z)), 1.0 / rate_hz, atol=1e-3)
    if binary:
        np.testing.assert_allclose(samples.angular_rate[:, 0], 0.5, atol=0.002)
