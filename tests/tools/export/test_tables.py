"""Tables of a recording agree with its messages, from MCAP and from JSON Lines, as CSV and as Parquet."""

from __future__ import annotations

import csv
import json
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from exported import person
from hand_messages import hand_pose, marker_frame, object_pose, point_set

from rhot.anatomy.skeleton import JOINTS
from rhot.errors import ConfigError
from rhot.messages import Control, HandPose, Message, Point, PointSet, encode, encoding_of
from rhot.recording.mcap.writer import McapWriter
from rhot.recording.messages import RecordedMessages
from rhot_tools.export.columns import row_of, tables
from rhot_tools.export.table_files import write_csv
from rhot_tools.recordings.export import export

BEGIN_NS = 1_800_000_000_000_000_000


def messages() -> list[tuple[str, Message]]:
    made: list[tuple[str, Message]] = [("rhot/control", Control(t_ns=BEGIN_NS - 10**9, action="stop"))]
    for frame in range(5):
        t_ns = BEGIN_NS + frame * 10_000_000
        made += [
            ("rhot/markers/left", marker_frame("left", t_ns)),
            ("rhot/points", point_set(t_ns, "index") if frame == 0 else point_set(t_ns, "index", "thumb")),
            ("rhot/hand/right", hand_pose(0.01 * frame, t_ns)),
            ("rhot/object/cube", object_pose(t_ns, float(frame))),
        ]
    # Two things that a live rig does: a late message, and a better one of the same moment.
    made += [("rhot/object/cube", object_pose(BEGIN_NS + 5_000_000, 77.0))]
    made += [("rhot/object/cube", object_pose(BEGIN_NS + 40_000_000, 99.0))]
    return made


def as_mcap(file: Path) -> Path:
    with McapWriter(file, now_ns=BEGIN_NS) as writer:
        for key, message in messages():
            writer.write(key, encoding_of(type(message)), encode(message), message.t_ns, message.seq, message.t_ns)
        writer.write("rhot/hand/left", "application/msgpack;HandPose", b"garbage", None, None, BEGIN_NS)
    return file


def as_lines(file: Path) -> Path:
    lines = [
        f'{{"key": "{key}", "value": {message.model_dump_json(exclude_none=True)}}}\n' for key, message in messages()
    ]
    file.write_text("".join(lines))
    return file


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(newline="") as stream:
        return list(csv.DictReader(stream))


@pytest.mark.parametrize("written_as", [as_mcap, as_lines])
def test_csv_tables_hold_every_number_in_full(tmp_path: Path, written_as: object) -> None:
    source = written_as(tmp_path / "recording")  # type: ignore[operator]
    result = CliRunner().invoke(export, [str(source), "--csv", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert {file.name for file in (tmp_path / "out").iterdir()} == {
        "hand_right.csv",
        "markers_left.csv",
        "object_cube.csv",
        "points.csv",
    }
    hands = rows(tmp_path / "out" / "hand_right.csv")
    assert [float(row["t_s"]) for row in hands] == pytest.approx([0.0, 0.01, 0.02, 0.03, 0.04], abs=1e-9)
    wanted = hand_pose(0.03, BEGIN_NS + 30_000_000)
    row = hands[3]
    assert int(row["t_ns"]) == wanted.t_ns
    for name in JOINTS:
        joint = wanted.joints[name]
        assert tuple(float(row[f"{name}_{axis}"]) for axis in "xyz") == joint.position
        assert tuple(float(row[f"{name}_q{axis}"]) for axis in "xyzw") == joint.orientation
    assert float(row["index_pip_flexion"]) == wanted.angles["index"].pip_flexion
    assert (row["index_residual"], row["thumb_residual"]) == ("0.0012", "")
    points = rows(tmp_path / "out" / "points.csv")
    assert (points[0]["thumb_x"], points[0]["thumb_state"]) == ("", "")
    assert (points[1]["thumb_x"], points[1]["thumb_state"]) == ("0.01", "measured")
    cubes = rows(tmp_path / "out" / "object_cube.csv")
    assert [float(row["x"]) for row in cubes] == [0.0, 77.0, 1.0, 2.0, 3.0, 99.0], "by time, the last of a moment"


def test_what_is_counted_has_no_decimals_and_points_their_covariance(tmp_path: Path) -> None:
    covariance = (1e-6, 0.0, -2e-7, 1e-6, 0.0, 9e-6)
    point = Point(position=(0.0, 0.0, 0.8), sigma=0.003, views=2, state="measured", covariance=covariance)
    first = PointSet(t_ns=1, frame="rig", points={"index": point.model_copy(update={"covariance": None})})
    second = PointSet(t_ns=2, frame="rig", points={"index": point, "thumb": point})
    write_csv(tmp_path, tables([("rhot/points", first), ("rhot/points", second)]))
    before, after = rows(tmp_path / "points.csv")
    assert (before["index_views"], before["thumb_views"], after["thumb_views"]) == ("2", "", "2")
    assert before["index_cov_zz"] == ""
    assert tuple(float(after[f"thumb_cov_{part}"]) for part in ("xx", "xy", "xz", "yy", "yz", "zz")) == covariance


def test_a_body_tells_how_its_arms_are_known_as_it_does_of_its_legs() -> None:
    body = person.body_message(1, np.eye(4)).model_copy(update={"arms": {"right": "predicted"}})
    row = row_of(body)
    assert row is not None
    assert (row["left_state"], row["right_arm_state"]) == ("measured", "predicted")
    assert "left_arm_state" not in row


def test_parquet_holds_what_csv_holds(tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    source = as_mcap(tmp_path / "a.mcap")
    result = CliRunner().invoke(
        export, [str(source), "--csv", str(tmp_path / "csv"), "--parquet", str(tmp_path / "parquet")]
    )
    assert result.exit_code == 0, result.output
    assert "1 messages are not valid" in result.output
    for file in (tmp_path / "csv").iterdir():
        table = parquet.read_table(tmp_path / "parquet" / f"{file.stem}.parquet").to_pylist()
        text = rows(file)
        assert len(table) == len(text) > 0
        for entry, row in zip(table, text, strict=True):
            assert list(entry) == list(row)
            for name, value in entry.items():
                if value is None or isinstance(value, str):
                    assert row[name] == (value or "")
                else:
                    assert float(row[name]) == pytest.approx(value, abs=1e-9, rel=1e-15)


def test_parts_of_a_recording_are_joined(tmp_path: Path) -> None:
    whole = as_lines(tmp_path / "whole").read_text().splitlines(keepends=True)
    for number, lines in enumerate((whole[:9], whole[9:])):
        (tmp_path / str(number)).write_text("".join(lines))
    parts = [str(tmp_path / "1"), str(tmp_path / "0"), "--csv", str(tmp_path / "parts")]
    assert CliRunner().invoke(export, parts).exit_code == 2, "several files need --join"
    result = CliRunner().invoke(export, [*parts, "--join"])
    assert result.exit_code == 0, result.output
    CliRunner().invoke(export, [str(tmp_path / "whole"), "--csv", str(tmp_path / "one")])
    for file in (tmp_path / "one").iterdir():
        assert (tmp_path / "parts" / file.name).read_bytes() == file.read_bytes()


@pytest.mark.parametrize(("shift_s", "says"), [(3600.0, "begins 3"), (0.0, "begins 1.0 s before the end")])
def test_what_is_not_parts_of_one_recording_is_not_joined(tmp_path: Path, shift_s: float, says: str) -> None:
    first = as_lines(tmp_path / "first.jsonl")
    entries = [json.loads(line) for line in first.read_text().splitlines()]
    for entry in entries:
        entry["value"]["t_ns"] += round(shift_s * 1e9)
    (tmp_path / "second.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in entries))
    words = [str(first), str(tmp_path / "second.jsonl"), "--csv", str(tmp_path / "csv"), "--join"]
    with pytest.raises(ConfigError, match=f"{says}.*not parts of one recording"):
        CliRunner().invoke(export, words, catch_exceptions=False)
    assert not (tmp_path / "csv").exists()


def test_a_second_reading_gives_the_same(tmp_path: Path) -> None:
    source = RecordedMessages(as_mcap(tmp_path / "a.mcap"))
    assert [table.name for table in tables(source)] == [table.name for table in tables(source)]
    assert source.invalid == 1


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"hello\n", "line 1: neither an MCAP file"),
        (b"\xff\xfe\x00", "neither an MCAP file"),
        (b'{"key": "rhot/points"}\n', "line 1: neither"),
        (b'{"key": "rhot/points", "value": {"t_ns": -1}}\n', r"line 1: rhot/points: .*t_ns"),
        (b"", "holds no hand"),
        (json.dumps({"key": "rhot/else", "value": 1}).encode(), "holds no hand"),
    ],
)
def test_wrong_files_end_in_one_error(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "x").write_bytes(content)
    result = CliRunner().invoke(export, [str(tmp_path / "x"), "--csv", str(tmp_path / "out")])
    assert isinstance(result.exception, ConfigError)
    with pytest.raises(ConfigError, match=says):
        raise result.exception


def test_it_asks_for_something_to_write(tmp_path: Path) -> None:
    result = CliRunner().invoke(export, [str(as_lines(tmp_path / "x"))])
    assert result.exit_code == 2
    assert "--csv" in result.output


def test_a_gltf_file_is_one_of_two_kinds(tmp_path: Path) -> None:
    recording = as_lines(tmp_path / "x")
    for name, begins in (("x.GLB", b"glTF"), ("x.gltf", b"{")):
        done = CliRunner().invoke(export, [str(recording), "--gltf", str(tmp_path / name)])
        assert done.exit_code == 0, done.output
        assert (tmp_path / name).read_bytes().startswith(begins)
    wrong = CliRunner().invoke(export, [str(recording), "--gltf", str(tmp_path / "x.obj")])
    assert "its name ends in .glb (binary) or .gltf (text)" in str(wrong.exception)


HOSTILE = (
    "rhot/hand/\0",
    "rhot/hand/\x1b[2J",
    "rhot/hand/../../x",
    "rhot/hand/" + "x" * 300,
    "rhot/hand/a b",
)


@pytest.mark.parametrize("lines", [True, False])
def test_keys_that_could_act_on_a_terminal_or_a_disk_are_left_out(tmp_path: Path, lines: bool) -> None:
    file = tmp_path / "take"
    keys = (*HOSTILE, "rhot/hand/right")
    pose = hand_pose(0.0, 5)
    if lines:
        rows = [json.dumps({"key": key, "value": json.loads(pose.model_dump_json())}) for key in keys]
        file.write_text("\n".join(rows))
    else:
        with McapWriter(file, now_ns=0) as writer:
            for key in keys:
                writer.write(key, encoding_of(HandPose), encode(pose), 5, 0, 5)
    result = CliRunner().invoke(export, [str(file), "--csv", str(tmp_path / "csv")])
    assert result.exit_code == 0, result.output
    assert [entry.name for entry in (tmp_path / "csv").iterdir()] == ["hand_right.csv"]
    assert f"{len(HOSTILE)} messages are not valid" in result.output
    assert "\x1b" not in result.output


def test_thousands_of_keys_cost_neither_minutes_nor_gigabytes(tmp_path: Path) -> None:
    file = tmp_path / "take.mcap"
    with McapWriter(file, now_ns=0) as writer:
        payload = encode(hand_pose(0.0, 5))
        for number in range(5_000):
            writer.write(f"rhot/hand/h{number}", encoding_of(HandPose), payload, 5, 0, 5 + number)
    begun = time.process_time()
    tracemalloc.start()
    found = tables(RecordedMessages(file))
    assert tracemalloc.get_traced_memory()[1] < 200e6
    tracemalloc.stop()
    assert len(found) <= 256
    assert time.process_time() - begun < 15.0


def test_a_rig_inside_a_recording_that_is_damaged_is_named_by_its_recording(tmp_path: Path) -> None:
    file = tmp_path / "take.mcap"
    with McapWriter(file, now_ns=0, attachments={"rig/rig.toml": b"nonsense = ["}) as writer:
        writer.write("rhot/hand/right", encoding_of(HandPose), encode(hand_pose(0.0, 5)), 5, 0, 5)
    with pytest.raises(ConfigError, match=r"take\.mcap: its rig/rig\.toml: not TOML"):
        CliRunner().invoke(export, [str(file), "--csv", str(tmp_path / "csv")], catch_exceptions=False)
