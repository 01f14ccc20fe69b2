from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from rhot.errors import CalibrationError, ConfigError
from rhot_calibration.cameras.board.command import Rectangle, Sheet, Text, board_sheet, svg_text, write_sheet
from rhot_calibration.cameras.board.command import board as command
from rhot_calibration.cameras.board.detect import detect_board
from rhot_calibration.cameras.board.grid import parse_board
from rhot_calibration.cameras.solve.views import Board

PX_PER_MM = 5


def drawn(sheet: Sheet) -> NDArray[np.uint8]:
    """The sheet as its SVG says, 5 px/mm; read back from the text, so that the writer is tested too."""
    image = np.zeros((round(sheet.height_mm * PX_PER_MM), round(sheet.width_mm * PX_PER_MM)), np.uint8)
    for attributes in re.findall(r"<rect ([^>]*)/>", svg_text(sheet)):
        values = dict(re.findall(r'(\w+)="([^"]*)"', attributes))
        x, y = (float(values.get(name, 0.0)) for name in ("x", "y"))
        right, bottom = x + float(values["width"]), y + float(values["height"])
        place = [round(PX_PER_MM * edge) for edge in (y, bottom, x, right)]
        image[place[0] : place[1], place[2] : place[3]] = 0 if values["fill"] == "black" else 255
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), dtype=np.uint8)


@pytest.mark.parametrize(
    ("board", "paper"),
    [
        (parse_board("9x6", 0.025), "a4"),
        (parse_board("6x9", 0.025), "a4"),
        (parse_board("9x6", 0.025, 0.018), "a4"),
        (parse_board("6x8", 0.030, 0.020, "4x4_50"), "a3"),
        (parse_board("7x5", 0.030, 0.020, "APRILTAG_36H11"), "letter"),
    ],
)
def test_the_printed_board_is_found_at_its_size(board: Board, paper: str) -> None:
    sheet = board_sheet(board, paper)
    view = detect_board(drawn(sheet), board)
    assert view is not None
    assert len(view.ids) == board.columns * board.rows
    found_mm = (view.corners + 0.5) / PX_PER_MM
    wanted_mm = 1e3 * (board.points[:, :2] + board.square_m) + (sheet.board_x_mm, sheet.board_y_mm)
    if board.columns + board.rows == 12 and not board.is_charuco:
        found_mm = found_mm[::-1]
    assert np.abs(found_mm - wanted_mm).max() < 0.15


def test_the_ruler_is_100_mm_and_everything_lies_on_the_paper() -> None:
    for paper, counts in (("a4", "9x6"), ("a4", "5x8"), ("letter", "6x4")):
        sheet = board_sheet(parse_board(counts, 0.025), paper)
        line = max((s for s in sheet.shapes if isinstance(s, Rectangle) and s.height < 0.5), key=lambda s: s.width)
        ticks = [s.x for s in sheet.shapes if isinstance(s, Rectangle) and s.width < 0.5]
        assert max(ticks) - min(ticks) == pytest.approx(100.0)
        assert line.width == pytest.approx(100.2)
        for shape in sheet.shapes:
            right = shape.x + (0.55 * shape.size * len(shape.content) if isinstance(shape, Text) else shape.width)
            bottom = shape.y + (0.0 if isinstance(shape, Text) else shape.height)
            assert shape.x >= 4.9
            assert shape.y >= 4.9
            assert right <= sheet.width_mm - 4.9
            assert bottom <= sheet.height_mm - 4.9


def test_a_board_too_large_for_the_paper_names_what_fits() -> None:
    with pytest.raises(CalibrationError, match=r"does not fit on a4; print on a2 or take squares of 26 mm"):
        board_sheet(parse_board("9x6", 0.040), "a4")
    board_sheet(parse_board("9x6", 0.040), "a2")
    board_sheet(parse_board("9x6", 0.026), "a4")
    with pytest.raises(CalibrationError, match="take squares of 3 mm"):
        board_sheet(parse_board("60x60", 0.025), "a4")
    with pytest.raises(CalibrationError, match="paper 'b7'"):
        board_sheet(parse_board("9x6", 0.025), "b7")


def test_files(tmp_path: Path) -> None:
    sheet = board_sheet(parse_board("9x6", 0.025), "a4")
    write_sheet(sheet, tmp_path / "board.pdf")
    data = (tmp_path / "board.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    assert b"/MediaBox [0 0 841.89 595.28]" in data
    write_sheet(sheet, tmp_path / "board.svg")
    assert 'width="297mm" height="210mm"' in (tmp_path / "board.svg").read_text()
    with pytest.raises(ConfigError, match=r"\.pdf or \.svg"):
        write_sheet(sheet, tmp_path / "board.png")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_sheet(sheet, tmp_path / "nowhere" / "board.svg")


def test_command(tmp_path: Path) -> None:
    ran = CliRunner().invoke(command, [str(tmp_path / "b.svg"), "--charuco", "--board", "9x5"])
    assert ran.exit_code == 0, ran.output
    assert "--board 9x5 --square-mm 25 --marker-mm 17.5 --dictionary DICT_5X5_100" in ran.output
    ran = CliRunner().invoke(command, [str(tmp_path / "b.svg"), "--marker-mm", "18"])
    assert isinstance(ran.exception, ConfigError)
    ran = CliRunner().invoke(command, [str(tmp_path / "b.svg"), "--board", "8x6"])
    assert "same after half a turn" in ran.output
