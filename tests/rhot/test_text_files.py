"""Text files as editors and other programs save them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rhot.errors import CalibrationError, ConfigError
from rhot.recording import load_recording
from rhot.rig import CamerasFile, load_rig, read_json_model
from rhot.text import parse_json, parse_toml, read_text


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_every_byte_order_mark_is_read(tmp_path: Path, encoding: str) -> None:
    (tmp_path / "a.txt").write_text("größe = 1\n", encoding=encoding)
    assert read_text(tmp_path / "a.txt") == "größe = 1\n"


def test_a_key_that_is_there_twice_is_named() -> None:
    assert parse_json('{"a": {"x": 1}, "b": {"x": 2}}') == {"a": {"x": 1}, "b": {"x": 2}}
    with pytest.raises(ValueError, match="'left' is there twice"):
        parse_json('{"cameras": {"left": 1, "right": 2, "left": 3}}')


@pytest.mark.parametrize("text", ["a = " + "[" * 100_000, "a = " + "[" * 100_000 + "]" * 100_000])
def test_deep_nesting_is_no_traceback(text: str) -> None:
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_toml(text)
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json(text.removeprefix("a = "))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_rig_saved_on_windows_opens(rig_folder: Path, tmp_path: Path, encoding: str) -> None:
    for file in [*rig_folder.glob("*.toml"), *rig_folder.glob("*.json")]:
        file.write_text(file.read_text(), encoding=encoding)
    load_rig(rig_folder)
    take = tmp_path / "take"
    (take / "left").mkdir(parents=True)
    (take / "recording.toml").write_text('version = 1\nnotes = "Tisch"\n', encoding=encoding)
    (take / "left" / "markers.csv").write_text("frame,t_ns,marker,u,v\n1,33000000,index,1,2\n", encoding=encoding)
    assert load_recording(take).notes == "Tisch"


def test_twice_the_same_camera_in_cameras_json_is_refused(rig_folder: Path) -> None:
    file = rig_folder / "cameras.json"
    file.write_text('{"cameras": {"left": {}, "left": {}}}')
    with pytest.raises(CalibrationError, match=r"cameras\.json.*'left' is there twice"):
        read_json_model(file, CamerasFile)


def test_a_transform_that_lost_a_part_is_no_identity(rig_folder: Path) -> None:
    for content in (
        '{"T_rig_tracker": {"position": [1, 2, 3]}}',
        '{"T_rig_tracker": {"orientation": [0, 0, 0, 1]}}',
        '{"T_rig_tracker": {}}',
        "{}",
    ):
        (rig_folder / "registration.json").write_text(content)
        with pytest.raises(CalibrationError, match=r"registration\.json: T_rig_tracker.*is missing"):
            load_rig(rig_folder)


def test_a_skew_is_refused(rig_folder: Path) -> None:
    camera = (
        '{"width": 640, "height": 480, "K": [[500, 50, 320], [0, 500, 240], [0, 0, 1]], '
        '"T_rig_camera": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}'
    )
    (rig_folder / "cameras.json").write_text(f'{{"cameras": {{"left": {camera}, "right": {camera}}}}}')
    with pytest.raises(CalibrationError, match="skew of 50 px"):
        load_rig(rig_folder)


def test_deep_toml_names_the_file(rig_folder: Path) -> None:
    (rig_folder / "rig.toml").write_text("a = " + "[" * 50_000)
    with pytest.raises(ConfigError, match=r"rig\.toml: not TOML: nested too deeply"):
        load_rig(rig_folder)
