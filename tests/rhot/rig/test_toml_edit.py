"""Values changed in a rig.toml that somebody has written by hand."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from rhot.errors import ConfigError
from rhot.rig.folder import load_config
from rhot.rig.toml_edit import change_rig_file, with_values

TEXT = """\
# my rig
[cameras.left]   # the one with the scratch
gain = 4.0  # was 6
white_balance = [ 1.6, 1.5 ]
source = 'picamera2'

# the other one
[cameras."right"]
gain = 4

[sim]
"""


def test_only_the_values_change() -> None:
    changed = with_values(TEXT, ("cameras", "left"), {"gain": 2.5, "white_balance": (1.0, 2.0), "exposure_s": 0.002})
    assert changed == TEXT.replace("gain = 4.0  # was 6", "gain = 2.5  # was 6").replace(
        "[ 1.6, 1.5 ]\nsource = 'picamera2'\n", "[1.0, 2.0]\nsource = 'picamera2'\nexposure_s = 0.002\n"
    )
    again = with_values(changed, ("sim",), {"motion": "board"})
    assert again == changed + 'motion = "board"\n'
    assert tomllib.loads(with_values(again, ("cameras", "right"), {"gain": 1.5}))["cameras"]["right"] == {"gain": 1.5}


def test_what_is_added_stands_before_the_comment_of_the_next_table() -> None:
    changed = with_values(TEXT, ("cameras", "left"), {"exposure_s": 0.002})
    assert changed == TEXT.replace("source = 'picamera2'\n", "source = 'picamera2'\nexposure_s = 0.002\n")


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_line_endings_stay(ending: str) -> None:
    changed = with_values(f"[a]{ending}b = 1{ending}", ("a",), {"b": 2, "c": 3})
    assert changed == f"[a]{ending}b = 2{ending}c = 3{ending}"


@pytest.mark.parametrize(
    "text",
    [
        "cameras = {left = {gain = 4.0}}\n",
        "cameras.left.gain = 4.0\n",
        "[cameras]\nleft.gain = 4.0\n",
        "[cameras.left]\nwhite_balance = [\n1.0,\n2.0]\ngain = 1\n",
        '[cameras.left]\ngain = """\n4"""\n',
        "[cameras.left]\ngain = 1 # one\n[sim]\n[cameras.right]\ngain = 1\n",
    ],
)
def test_every_form_of_a_table_is_changed_and_nothing_else(text: str) -> None:
    expected = tomllib.loads(text)
    expected["cameras"]["left"] |= {"gain": 2.0, "rate_hz": 30}
    changed = with_values(text, ("cameras", "left"), {"gain": 2.0, "rate_hz": 30})
    assert tomllib.loads(changed) == expected
    assert changed.count("#") == text.count("#")


def test_a_heading_within_a_text_is_no_heading() -> None:
    text = '[a]\nnote = """\n[b]\n"""\nc = 1\n[b]\nc = 2\n'
    assert with_values(text, ("b",), {"c": 3}) == text.replace("c = 2", "c = 3")


def test_what_is_not_there_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"\[cameras.third\] is not there"):
        with_values(TEXT, ("cameras", "third"), {"gain": 2.0})
    with pytest.raises(ConfigError, match="line 1"):
        with_values("[", ("cameras",), {"gain": 2.0})


def test_a_rig_file_is_changed_as_a_whole_or_not_at_all(rig_folder: Path) -> None:
    file = rig_folder / "rig.toml"
    before = file.read_text()
    change_rig_file(rig_folder, {("cameras", "left"): {"gain": 8.0}, ("cameras", "right"): {"gain": 7.0}})
    assert {name: camera.gain for name, camera in load_config(rig_folder).cameras.items()} == {
        "left": 8.0,
        "right": 7.0,
    }
    assert len(file.read_text().splitlines()) == len(before.splitlines())
    kept = file.read_text()
    with pytest.raises(ConfigError, match=r"rig\.toml: stays as it is: .*gain"):
        change_rig_file(rig_folder, {("cameras", "left"): {"exposure_s": 0.001}, ("cameras", "right"): {"gain": 0.0}})
    with pytest.raises(ConfigError, match=r"\[sim\] is not there"):
        change_rig_file(rig_folder, {("cameras", "left"): {"exposure_s": 0.001}, ("sim",): {"motion": "board"}})
    assert file.read_text() == kept
    file.write_bytes(b"\xff")
    with pytest.raises(ConfigError, match="cannot be read"):
        change_rig_file(rig_folder, {("sim",): {"motion": "board"}})
