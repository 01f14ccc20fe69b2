from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import pytest
from click.testing import CliRunner, Result

from rhot.errors import RhotError
from rhot.rig.colors import load_colors
from rhot.rig.folder import load_config
from rhot_calibration.colors.command import colors


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
    result = run(image, *picks, "--rig", rig, "--preview", tmp_path / "seen.jpg", "--report", tmp_path / "report.png")
    assert result.exit_code == 0, result.output
    written = load_colors(rig / "colors.json")
    assert set(written.markers) == {"thumb", "index", "middle", "ring", "little", "base"}
    assert written.date
    assert written.quality["ring"]["recovered"] > 0.9
    for name in written.markers:
        assert name in result.output
    assert "take it over within a second" in " ".join(result.output.split())
    assert "warning" not in result.output
    assert cv2.imread(str(tmp_path / "seen.jpg")) is not None
    report = cv2.imread(str(tmp_path / "report.png"))
    assert report is not None
    assert report.shape[1] == 1280


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--pick", "thumb=12"], "--pick thumb=12: not NAME=U,V"),
        (["--pick", "thumb=1,2@3"], "there is no picture 3; say @1 = hand"),
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


def test_the_colours_before_are_kept_and_markers_without_one_are_named(
    pictured: tuple[Path, Path, list[str]],
) -> None:
    image, rig, picks = pictured
    assert run(image, *picks, "--rig", rig).exit_code == 0
    before = (rig / "colors.json").read_bytes()
    result = run(image, *picks[:4], "--rig", rig)
    assert result.exit_code == 0, result.exception
    said = " ".join(result.output.split())
    shown = {part.partition("=")[0] for part in picks[1:4:2]}
    missing = [name for name in load_config(rig).markers if name not in shown]
    assert f"warning: no colour for {', '.join(missing)}" in said
    assert (rig / "colors.previous.json").read_bytes() == before
    assert set(load_colors(rig / "colors.json").markers) == shown


def test_unreadable_images_are_named(pictured: tuple[Path, Path, list[str]], tmp_path: Path) -> None:
    _, rig, picks = pictured
    (tmp_path / "broken.png").write_bytes(b"nothing")
    for name, words in (("absent.png", "No such file"), ("broken.png", "no picture")):
        result = run(tmp_path / name, *picks, "--rig", rig)
        assert isinstance(result.exception, RhotError)
        assert words in str(result.exception)
        assert name in str(result.exception)


def test_alike_paints_are_warned_about_and_another_is_suggested(
    scene: Any, shape: Any, tmp_path: Path, write_rig: Callable[..., Path]
) -> None:
    shapes = [shape("ring", 100, 100), shape("index", 200, 100, paint=(46, 65, 203)), shape("middle", 300, 100)]
    drawn = scene(shapes, noise=2.0, size=(400, 200))
    cv2.imwrite(str(tmp_path / "hand.png"), drawn.image)
    boxes = [
        part for name, (u, v, _) in drawn.truth.items() for part in ("--box", f"{name}={u - 14:.0f},{v - 17:.0f},29,35")
    ]
    result = run(tmp_path / "hand.png", *boxes, "--rig", write_rig({"left": ""}), "--report", tmp_path / "report.jpg")
    assert result.exit_code == 0, result.exception
    said = " ".join(result.output.split())
    assert "warning: index and ring will be mixed up" in said
    assert "suggestion: paint" in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "no pictures"),
        (["hand.png", "--live"], "pictures and --live exclude each other"),
        (["--import", "a.json", "--pick", "thumb=1,2"], "--import brings finished colours"),
        (["hand.png", "--camera-settings", "a.json"], "goes with --import"),
        (["hand.png", "--save", "x"], "--save goes with --live"),
        (["--live"], "look at the pictures first"),
        (["--import", "absent.json"], "absent.json: cannot be read"),
    ],
)
def test_options_that_contradict_each_other_are_named(
    write_rig: Callable[..., Path], arguments: list[str], words: str
) -> None:
    result = run(*arguments, "--rig", write_rig({"left": ""}))
    assert isinstance(result.exception, RhotError)
    assert words in str(result.exception)


def test_report_goes_to_a_picture_only(pictured: tuple[Path, Path, list[str]], tmp_path: Path) -> None:
    image, rig, picks = pictured
    for name, words in (("report.txt", "written as .png or .jpg or .jpeg"), ("absent/report.png", "cannot be written")):
        result = run(image, *picks, "--rig", rig, "--report", tmp_path / name)
        assert isinstance(result.exception, RhotError)
        assert words in str(result.exception)


def test_files_of_the_2018_tracker_become_colours(thesis_rig: Path, write_rig: Callable[..., Path]) -> None:
    rig = write_rig({"left": "", "right": ""})
    before = (rig / "rig.toml").read_text()
    files = ("--import", thesis_rig / "colorCalibration.json", "--camera-settings", thesis_rig / "cameraCalib.json")
    result = run(*files, "--rig", rig)
    assert result.exit_code == 0, result.exception
    written = load_colors(rig / "colors.json")
    assert list(written.markers) == ["thumb", "index", "middle", "ring", "little", "base"]
    assert (rig / "rig.toml").read_text() == before
    for words in ("[cameras.left]", "[cameras.right]", "exposure_s = 0.0066", "gain = 5.45", "Saturation = 100"):
        assert words in result.output


@pytest.mark.parametrize(
    ("gain", "says"),
    [(0.0, "the picture is black"), (0.15, "the picture is dark"), (8.0, "100 % of the picture is overexposed")],
)
def test_the_light_of_a_picture_is_named(pictured: tuple[Path, Path, list[str]], gain: float, says: str) -> None:
    image, rig, picks = pictured
    picture = cv2.imread(str(image))
    assert picture is not None
    cv2.imwrite(str(image), (picture.astype(float) * gain + 245 * (gain > 1)).clip(0, 255).astype("uint8"))
    result = run(image, *picks, "--rig", rig)
    told = " ".join(f"{result.output} {result.exception}".split())
    assert f"hand: {says}" in told
    assert (rig / "colors.json").exists() is (result.exit_code == 0)
    if not gain:
        assert isinstance(result.exception, RhotError)


def test_a_picture_larger_than_any_camera_takes_is_refused(pictured: tuple[Path, Path, list[str]]) -> None:
    image, rig, picks = pictured
    picture = cv2.imread(str(image))
    assert picture is not None
    cv2.imwrite(str(image), cv2.resize(picture, (6400, 4800)))
    result = run(image, *picks, "--rig", rig)
    assert isinstance(result.exception, RhotError)
    assert "6400x4800 pixels; take pictures with the tracker's own cameras" in str(result.exception)
