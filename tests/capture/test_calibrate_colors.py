from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
from click.testing import CliRunner, Result

from rhot.errors import RhotError
from rhot.rig.colors import load_colors
from rhot_capture.calibrate_colors import colors, parse_picks


@pytest.fixture
def pictured(
    scene: Any, six_shapes: Any, tmp_path: Path, write_rig: Callable[..., Path]
) -> tuple[Path, Path, list[str]]:
    """A picture, a rig, and the pick options for all markers."""
    drawn = scene(six_shapes(4), noise=2.0)
    cv2.imwrite(str(tmp_path / "hand.png"), drawn.image)
    picks = [part for name, (u, v, _) in drawn.truth.items() for part in ("--pick", f"{name}={u:.0f},{v:.0f}")]
    return tmp_path / "hand.png", write_rig({"left": ""}), picks


def run(*arguments: object) -> Result:
    return CliRunner().invoke(colors, [str(argument) for argument in arguments])


def test_colours_are_written_and_reported(pictured: tuple[Path, Path, list[str]], tmp_path: Path) -> None:
    image, rig, picks = pictured
    result = run(image, *picks, "--rig", rig, "--preview", tmp_path / "seen.jpg")
    assert result.exit_code == 0, result.output
    written = load_colors(rig / "colors.json")
    assert set(written.markers) == {"thumb", "index", "middle", "ring", "little", "base"}
    assert written.date
    assert written.quality["ring"]["recovered"] > 0.9
    for name in written.markers:
        assert name in result.output
    assert cv2.imread(str(tmp_path / "seen.jpg")) is not None


def test_picks_name_their_image() -> None:
    images = [Path("a.png"), Path("b.png")]
    assert parse_picks(["thumb=1,2", "ring=3.5, 4@2", "thumb=5,6@2"], images) == [
        {"thumb": (1.0, 2.0)},
        {"ring": (3.5, 4.0), "thumb": (5.0, 6.0)},
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--pick", "thumb=12"], "--pick thumb=12: not NAME=U,V"),
        (["--pick", "thumb=1,2@3"], "there is no image 3; 1 given"),
        (["--pick", "thumb=1,2", "--pick", "thumb=3,4"], "thumb is picked twice"),
        (["--pick", "nose=1,2"], "pick nose: no such marker"),
        (["--pick", "thumb=700,2"], "outside picture 1, which is 640x480"),
        (["--pick", "thumb=620,460"], "pick thumb"),
    ],
)
def test_wrong_picks_are_one_clear_error(
    pictured: tuple[Path, Path, list[str]], arguments: list[str], words: str
) -> None:
    image, rig, _ = pictured
    result = run(image, *arguments, "--rig", rig)
    assert isinstance(result.exception, RhotError)
    assert words in str(result.exception)
    assert not (rig / "colors.json").exists()


def test_unreadable_images_are_named(pictured: tuple[Path, Path, list[str]], tmp_path: Path) -> None:
    _, rig, picks = pictured
    (tmp_path / "broken.png").write_bytes(b"nothing")
    for name, words in (("absent.png", "no such image"), ("broken.png", "not an image")):
        result = run(tmp_path / name, *picks, "--rig", rig)
        assert isinstance(result.exception, RhotError)
        assert words in str(result.exception)
        assert name in str(result.exception)
