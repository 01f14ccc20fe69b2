from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner, Result

from rhot.anatomy.hand import HandModel
from rhot.anatomy.hand_proportions import width_across_knuckles
from rhot.errors import RhotError
from rhot.messages.codec import encode
from rhot.recording.mcap.writer import McapWriter
from rhot.rig import HandFile, load_rig, read_json_model
from rhot_calibration.hand.command import hand
from rhot_calibration.hand.samples import stored_points


def run(*arguments: object) -> Result:
    return CliRunner().invoke(hand, [str(argument) for argument in arguments])


def stored(file: Path, points: list[Any]) -> Path:
    lines = [f'{{"key": "rhot/points", "value": {one.model_dump_json(exclude_none=True)}}}' for one in points]
    file.write_text("\n".join(['{"key": "rhot/markers/left", "value": {}}', *lines]) + "\n", encoding="utf-8")
    return file


def test_points_of_a_file_become_a_hand(person: Callable[..., Any], rig_folder: Path, tmp_path: Path) -> None:
    one = person(3, 0.172)
    result = run(stored(tmp_path / "points.jsonl", one.points), "--rig", rig_folder)
    assert result.exit_code == 0, result.exception
    found = load_rig(rig_folder).hand
    assert abs(found.length_m - one.hand.length_m) <= 3e-3 * found.quality["length"]["sd_mm"]
    assert found.date
    assert "from proportions" in result.output
    assert "bone before index_intermediate" in result.output
    assert "index: patch to tip marker, straight" in result.output
    assert "straight fingers bent at the knuckles" in result.output


def test_an_mcap_file_gives_the_same_points(person: Callable[..., Any], tmp_path: Path) -> None:
    points = person(3, 0.172).points[:20]
    with McapWriter(tmp_path / "take.mcap", now_ns=points[0].t_ns) as writer:
        for key, model in (("rhot/control", "Control"), ("rhot/points", "PointSet")):
            for one in points:
                writer.write(key, f"application/msgpack;{model}", encode(one), one.t_ns, one.seq, one.t_ns)
    assert list(stored_points(tmp_path / "take.mcap")) == points


def test_the_hand_before_is_kept(rig_folder: Path) -> None:
    for length_mm in (180, 190):
        assert run("--length-mm", length_mm, "--width-mm", 82, "--rig", rig_folder).exit_code == 0
    before = read_json_model(rig_folder / "hand.previous.json", HandFile)
    assert (before.length_m, load_rig(rig_folder).hand.length_m) == pytest.approx((0.180, 0.190))


def test_two_typed_measures_make_a_hand(rig_folder: Path) -> None:
    result = run("--length-mm", 180, "--width-mm", 82, "--rig", rig_folder)
    assert result.exit_code == 0, result.exception
    found = load_rig(rig_folder).hand
    assert found.length_m == pytest.approx(0.180)
    assert found.width_m == pytest.approx(0.082)
    model = HandModel.from_file(found, "right")
    apart = model.knuckles[4, 0] - model.knuckles[1, 0]
    assert apart == pytest.approx(0.653 * 0.082)
    natural = HandModel.from_file(HandFile(length_m=0.180), "right")
    narrower = natural.knuckles[4, 0] - natural.knuckles[1, 0]
    assert narrower == pytest.approx(0.653 * width_across_knuckles(HandFile(length_m=0.180)))
    assert "from proportions" in result.output


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "give one of"),
        (["--live", "nowhere"], "give one of"),
        (["--width-mm", "80"], "--width-mm 80 alone says too little"),
        (["nowhere", "--length-mm", "180", "--width-mm", "80"], "--width-mm serves only without a recording"),
        (["--live", "--flat", "1-4"], "--flat and --knuckles are seconds of a RECORDING"),
        (["--length-mm", "18"], "--length-mm 18: human hands are 140 to 240 mm"),
        (["--length-mm", "180", "--width-mm", "180"], "--width-mm 180: a hand of 180 mm"),
        (["nowhere"], "nowhere"),
        (["nowhere", "--side", "left"], "--side left: rig.toml has markers of the right hand only"),
    ],
)
def test_wrong_calls_are_one_clear_error(rig_folder: Path, arguments: list[str], words: str) -> None:
    result = run(*arguments, "--rig", rig_folder)
    assert isinstance(result.exception, RhotError)
    assert words in str(result.exception)
    assert not (rig_folder / "hand.json").exists()


@pytest.mark.parametrize("value", ["4", "x-y", "4-1", "-1-3", "1-inf"])
def test_a_wrong_stretch_is_explained(rig_folder: Path, value: str) -> None:
    result = run("nowhere", f"--flat={value}", "--rig", rig_folder)
    assert result.exit_code != 0
    assert "START" in result.output
    assert "Traceback" not in result.output


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("nonsense", "points.jsonl:2: not JSON"),
        ("[1]", "points.jsonl:2: not"),
        (json.dumps({"key": "rhot/points", "value": {"t_ns": 1}}), "points.jsonl:2: not a valid PointSet: frame"),
    ],
)
def test_a_broken_line_is_named(rig_folder: Path, tmp_path: Path, line: str, words: str) -> None:
    file = tmp_path / "points.jsonl"
    file.write_text(f'{{"key": "rhot/markers/left", "value": {{}}}}\n{line}\n', encoding="utf-8")
    result = run(file, "--rig", rig_folder)
    assert isinstance(result.exception, RhotError)
    assert words in str(result.exception)
