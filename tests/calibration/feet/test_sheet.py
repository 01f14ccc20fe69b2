from __future__ import annotations

import re
import zlib
from pathlib import Path

import pytest
from click.testing import CliRunner

from rhot.errors import CalibrationError, ConfigError
from rhot_calibration.feet.command import markers, write_marker_sheet

MM = 72.0 / 25.4


def test_the_squares_are_true_to_scale(tmp_path: Path) -> None:
    pytest.importorskip("fpdf")
    file = tmp_path / "markers.pdf"
    write_marker_sheet(file, {"left": 0, "right": 1}, "3X3_32", 0.06)
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", file.read_bytes(), re.DOTALL)
    drawing = b"".join(zlib.decompress(stream) if stream[:1] == b"x" else stream for stream in streams).decode(
        "latin-1"
    )
    squares = [
        (float(width), -float(height))
        for width, height in re.findall(r"[\d.]+ [\d.]+ ([\d.]+) (-[\d.]+) re f", drawing)
        if abs(float(width) - 60.0 * MM) < 0.02
    ]
    assert len(squares) == 2
    assert all(abs(height - 60.0 * MM) < 0.02 for _, height in squares)


def test_what_cannot_be_printed(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"\.pdf"):
        write_marker_sheet(tmp_path / "markers.png", {"left": 0}, "3X3_32", 0.06)
    with pytest.raises(CalibrationError, match="a4, letter"):
        write_marker_sheet(tmp_path / "markers.pdf", {"left": 0}, "3X3_32", 0.06, "a9")
    with pytest.raises(CalibrationError, match="lower marker_size_m"):
        write_marker_sheet(tmp_path / "markers.pdf", {"left": 0, "right": 1}, "3X3_32", 0.10)
    with pytest.raises(ConfigError, match="marker_id = 40"):
        write_marker_sheet(tmp_path / "markers.pdf", {"left": 40}, "3X3_32", 0.06)
    with pytest.raises(ConfigError, match="cannot be written"):
        write_marker_sheet(tmp_path / "nowhere" / "markers.pdf", {"left": 0}, "3X3_32", 0.06)


FEET = """
[feet]
[feet.left]
marker_id = 1
[feet.right]
marker_id = 2
"""


def test_the_command_draws_the_markers_of_the_rig(rig_folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "markers.pdf"
    with pytest.raises(ConfigError, match="names no feet"):
        CliRunner().invoke(markers, [str(file), "--rig", str(rig_folder)], catch_exceptions=False)
    (rig_folder / "rig.toml").write_text((rig_folder / "rig.toml").read_text() + FEET)
    done = CliRunner().invoke(markers, [str(file), "--rig", str(rig_folder)], catch_exceptions=False)
    assert "left 1 and right 2" in done.output
    assert file.read_bytes().startswith(b"%PDF")
