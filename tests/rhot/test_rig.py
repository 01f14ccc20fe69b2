"""Rig folders: what is written is read again, and every mistake is named with file and field."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from rhot.errors import CalibrationError, ConfigError
from rhot.rig import HandFile, RigConfig, load_rig, write_json_model
from rhot.rig.folder import RIG_FILE, load_config, nominal_camera
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file

CAMERA = {
    "width": 640,
    "height": 480,
    "K": [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]],
    "distortion": [0.1, -0.2, 0.0, 0.0, 0.0],
    "T_rig_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]],
}


def test_the_template_is_a_valid_rig_of_two_cameras_and_six_markers(rig_folder: Path) -> None:
    rig = load_rig(rig_folder)
    assert list(rig.config.cameras) == ["left", "right"]
    assert list(rig.config.markers) == ["thumb", "index", "middle", "ring", "little", "base"]
    assert rig.config.markers["base"].size_m == (0.04, 0.03)
    assert not rig.calibrated
    assert rig.cameras["right"].T_rig_camera[0][3] == 0.075
    assert rig.hand.length_m == 0.189


def test_the_template_holds_two_hands_too() -> None:
    text = rig_template(folder="x", name="two", sides=("right", "left"))
    config = RigConfig.model_validate(tomllib.loads(text))
    assert config.sides == ("right", "left")
    assert config.markers["left_thumb"].hand == "left"


def test_the_field_of_view_gives_the_nominal_focal_length(rig_folder: Path) -> None:
    camera = nominal_camera(load_rig(rig_folder).config.cameras["left"])
    assert camera.K[0][0] == pytest.approx(530.5, abs=0.5)
    assert camera.K[0][2] == 319.5


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ('source = "picamera2"', 'source = "telescope"', "cameras.left.source"),
        ("width = 640", "width = 1e9", "cameras.left.width"),
        ("rate_hz = 60", "rate_hz = -1", "cameras.left.rate_hz"),
        ("gain = 4.0", "gian = 4.0", "cameras.left.gian: no such field; did you mean gain?"),
        ('joint = "thumb_tip"', 'joint = "toe_tip"', "toe_tip"),
        ('joint = "thumb_tip"', 'joint = "index_tip"', "both mark index_tip"),
        ('kind = "patch"\nsize_m = [0.04, 0.03]', 'kind = "patch"', "size_m"),
        ('method = "filter"', 'method = "two words"', "fusion.method"),
        ("volume_m = [[-0.8,", "volume_m = [[0.9,", "lower bound"),
        ("version = 1", "version = 2", "version"),
        ("[bus]", "[bus", "not TOML"),
        ('connect = ["tcp/127.0.0.1:7447"]', "connect = []", "needs `connect`"),
        ("length_m = 0.189", "length_m = nan", "hand.length_m"),
    ],
)
def test_mistakes_in_rig_toml_are_named(rig_folder: Path, old: str, new: str, names: str) -> None:
    file = rig_folder / "rig.toml"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    with pytest.raises(ConfigError) as caught:
        load_rig(rig_folder)
    assert names in str(caught.value)
    assert str(file) in str(caught.value)


def test_a_folder_that_is_none_says_how_to_make_one(tmp_path: Path) -> None:
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(ConfigError, match="rhot init"):
            load_rig(path)


def _cameras(**changes: Any) -> dict[str, Any]:
    return {"version": 1, "cameras": {"left": CAMERA | changes, "right": CAMERA}}


def test_calibrated_cameras_are_used(rig_folder: Path) -> None:
    (rig_folder / "cameras.json").write_text(json.dumps(_cameras() | {"quality": {"rms_px": 0.2}}))
    rig = load_rig(rig_folder)
    assert rig.calibrated
    assert rig.cameras["left"].distortion == (0.1, -0.2, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("content", "names"),
    [
        ("{", "not JSON, perhaps cut off"),
        ("{", "make it again with `rhot calibrate cameras`"),
        (json.dumps({"camera": {}}), "cameras: is missing"),
        (json.dumps(_cameras(distorsion=[])), "cameras.left.distorsion: no such field; did you mean distortion?"),
        (json.dumps({"cameras": {"left": CAMERA}}), "no calibration of camera right"),
        (json.dumps(_cameras(width=1280)), "1280x480"),
        (json.dumps(_cameras(distortion=[1.0, 2.0])), "distortion"),
        (json.dumps(_cameras(K=[[0, 0, 0], [0, 1, 0], [0, 0, 1]])), "K"),
        (json.dumps(_cameras(T_rig_camera=[[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])), "rotation"),
        (json.dumps(_cameras() | {"extra": 1}), "extra"),
    ],
)
def test_mistakes_in_cameras_json_are_named(rig_folder: Path, content: str, names: str) -> None:
    (rig_folder / "cameras.json").write_text(content)
    with pytest.raises(CalibrationError) as caught:
        load_rig(rig_folder)
    assert names in str(caught.value)
    assert "cameras.json" in str(caught.value)


def test_calibration_files_are_written_whole(rig_folder: Path) -> None:
    file = rig_folder / "hand.json"
    write_json_model(file, HandFile(date="2026-01-01", length_m=0.2, bones_m={"index_proximal": 0.045}))
    assert load_rig(rig_folder).hand.bones_m == {"index_proximal": 0.045}
    assert [path.name for path in rig_folder.iterdir() if path.name.startswith(".")] == []
    with pytest.raises(ConfigError, match="cannot be written"):
        write_json_model(rig_folder / "no" / "hand.json", HandFile())


def test_a_damaged_file_is_offered_its_predecessor(rig_folder: Path) -> None:
    (rig_folder / "cameras.json").write_text("{")
    (rig_folder / "cameras.previous.json").write_text("{}")
    with pytest.raises(CalibrationError, match=r"copy cameras\.previous\.json over it"):
        load_rig(rig_folder)


def test_a_byte_order_mark_is_no_mistake(rig_folder: Path) -> None:
    file = rig_folder / RIG_FILE
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert load_config(rig_folder).name == "test"
    change_rig_file(rig_folder, {("bus",): {"namespace": "lab"}})
    assert load_config(rig_folder).bus.namespace == "lab"


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('[cameras."a b"]', "cameras.a b: a name is made of letters, digits, _, . and -, 64 at most"),
        (f"x = {'[' * 3000}", "not TOML"),
    ],
)
def test_what_people_type_is_refused_in_their_words(rig_folder: Path, line: str, says: str) -> None:
    with (rig_folder / RIG_FILE).open("a") as file:
        file.write(f"\n{line}\n")
    with pytest.raises(ConfigError, match=re.escape(says)):
        load_config(rig_folder)
