from __future__ import annotations

import json
import tomllib
from pathlib import Path

import pytest

from rhot.errors import ConfigError
from rhot.rig.colors import RgbBoxColor
from rhot.rig.config import CameraConfig
from rhot_calibration.colors.import_2018 import load_box_calibration, load_camera_settings, rig_lines

GOOD = {
    "Exposure": "2", "Gain": "25", "awb red": "1.5", "awb blue": "1.2",
    "Brightness": "50", "Contrast": "50", "Saturation": "50",
}  # fmt: skip


def test_settings_of_the_2018_tracker(thesis_rig: Path) -> None:
    settings = load_camera_settings(thesis_rig / "cameraCalib.json")
    # 2 % of 330 ms; 37 % of ISO 800, at a gain of 1.84 per ISO 100.
    assert settings.lines == ("exposure_s = 0.0066", "gain = 5.45")
    said = "\n".join(settings.remarks)
    for words in ("automatic white balance", "Brightness = 47", "Contrast = 59", "Saturation = 100"):
        assert words in said


def test_lines_are_valid_in_rig_toml(tmp_path: Path) -> None:
    file = tmp_path / "cameraCalib.json"
    file.write_text(json.dumps(GOOD))
    settings = load_camera_settings(file)
    cameras = tomllib.loads(rig_lines(settings, ["left", "right"]))["cameras"]
    assert set(cameras) == {"left", "right"}
    camera = CameraConfig.model_validate(cameras["left"])
    assert camera.exposure_s == pytest.approx(0.0066)
    assert camera.gain == pytest.approx(3.68)
    assert camera.white_balance == (1.5, 1.2)
    assert not any("equivalent" in remark for remark in settings.remarks)


def test_automatic_settings_are_left_to_the_reader(tmp_path: Path) -> None:
    file = tmp_path / "cameraCalib.json"
    file.write_text(json.dumps({**GOOD, "Exposure": "0", "Gain": "0", "awb blue": "0"}))
    settings = load_camera_settings(file)
    assert settings.lines == ()
    assert len(settings.remarks) == 3


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("{", "not JSON"),
        ("[]", "holds a list"),
        (json.dumps({**GOOD, "Gain": "much"}), "Gain = 'much' is not a number"),
        (json.dumps({**GOOD, "Contrast": "101"}), "Contrast = 101 is out of bounds"),
        (json.dumps({**GOOD, "Exposure": None}), "Exposure = None is not a number"),
        (json.dumps({"Exposure": "1"}), "Gain is missing"),
    ],
)
def test_wrong_settings_name_the_field(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "cameraCalib.json"
    file.write_text(text)
    with pytest.raises(ConfigError, match=words):
        load_camera_settings(file)


def _entry(low: int, high: int) -> dict[str, str]:
    return {f"{channel}{end}": str(value) for channel in "rgb" for end, value in (("Lower", low), ("Upper", high))}


def test_box_calibration_of_the_2018_tracker(tmp_path: Path) -> None:
    file = tmp_path / "colorCalibration.json"
    file.write_text(json.dumps({"colors": [_entry(0, 60), _entry(61, 255)]}))
    colors = load_box_calibration(file, ["thumb", "index"])
    assert colors.markers["index"] == RgbBoxColor(low=(61, 61, 61), high=(255, 255, 255))
    with pytest.raises(ConfigError, match="2 colours, too few"):
        load_box_calibration(file, ["thumb", "index", "ring"])


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ("[", "not JSON"),
        ("[]", "no list `colors`"),
        ('{"colors": 3}', "no list `colors`"),
        ('{"colors": [], "colorMode": "hsv"}', "colorMode = 'hsv'"),
        ('{"colors": [7]}', r"colors\[0\] is not a set"),
        ('{"colors": [{"rLower": "x"}]}', r"colors\[0\]\.rLower = 'x' is not a number"),
        ('{"colors": [{"rLower": "1"}]}', r"colors\[0\]\.rUpper is missing"),
        ('{"colors": [{"rLower": "1", "rUpper": "256"}]}', r"rUpper = 256 is out of bounds"),
        ('{"colors": [{"rLower": "9", "rUpper": "8"}]}', r"rLower = 9 is above rUpper = 8"),
    ],
)
def test_wrong_box_calibration_names_the_field(tmp_path: Path, data: str, words: str) -> None:
    file = tmp_path / "colorCalibration.json"
    file.write_text(data)
    with pytest.raises(ConfigError, match=words):
        load_box_calibration(file, ["thumb"] if data != '{"colors": [], "colorMode": "hsv"}' else [])


def test_real_box_calibration_loads(thesis_rig: Path) -> None:
    colors = load_box_calibration(thesis_rig / "colorCalibration.json", ["a", "b", "c", "d", "e", "f"])
    assert colors.markers["a"] == RgbBoxColor(low=(0, 61, 0), high=(60, 255, 32))
