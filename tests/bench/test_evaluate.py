from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.errors import ConfigError
from rhot.rig import HandFile
from rhot_bench.hands.command import hands
from rhot_bench.hands.recorded_joints import PREFIXES
from rhot_bench.steps.command import steps
from rhot_bench.streams import streams
from rhot_bench.thesis.command import thesis
from rhot_bench.tracking.command import tracking

Invoke = Callable[..., str]


def rows_of(file: Path) -> dict[str, Any]:
    document = json.loads(file.read_text())
    return {row["name"]: row for section in document["sections"] for row in section["rows"]}


def test_tracking_measures_every_figure(
    invoke: Invoke, rig_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rhot_bench.tracking.tracking.SETTLE_S", 0.4)
    monkeypatch.setattr("rhot_bench.tracking.command._FAST_S", 6.0)
    file, report = tmp_path / "t.json", tmp_path / "t.html"
    options = ("--quick", "--duration", 6, "--speed", 4, "--json", file, "--report", report, "--rig", rig_path)
    text = invoke(tracking, *options)
    rows = rows_of(file)
    for name in (
        "fingertip position, median",
        "fingertip position, p95",
        "thumb, p99",
        "identity swaps",
        "false points",
        "coverage",
        "26 joints, all tips measured, mean",
        "pip flexion, RMS",
        "largest step beyond true motion",
        "largest excess over a joint limit",
        "sideways, worst marker",
        "in depth, worst marker",
    ):
        assert name in text
        assert rows[name]["value"] is not None, name
    for name in ("short occlusions survived", "26 joints, one or two tips hidden, mean", "lag at 1 m/s"):
        assert name in rows
    assert 0.05 < rows["fingertip position, median"]["value"] < 10.0
    assert rows["coverage"]["value"] > 80.0
    page = report.read_text()
    body = page[page.index("<body>") : page.index("</body>") + 7]
    root = ElementTree.fromstring(body)
    plots = root.findall("{http://www.w3.org/2000/svg}svg")
    assert len(plots) == 6
    assert all(len(plot) > 10 for plot in plots)
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")


def test_thesis_tables(invoke: Invoke, rig_path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rhot_bench.thesis.command.DISTANCES_CM", (30, 80))
    text = invoke(thesis, "--quick", "--json", tmp_path / "t.json", "--rig", rig_path)
    rows = rows_of(tmp_path / "t.json")
    assert rows["distances at which the marker is tracked"]["value"] == 2
    assert rows["all distances, largest error"]["value"] < 1.0
    assert rows["ours, standard deviation, worst marker"]["value"] < 0.3
    assert rows["thesis's recording, rectified, standard deviation, worst marker"]["value"] is None
    assert "ours / thesis" in text


def write_hand(file: Path) -> None:
    """Write a model's own hand, curling and turning, as a recording."""
    model = HandModel.from_file(HandFile(), "right")
    t = np.linspace(0.0, 4.0, 60)
    curl = 0.5 - 0.5 * np.cos(2.0 * t[:, None] + np.arange(5))
    angles = np.stack([0.6 * curl, 0.0 * curl, 1.0 * curl, model.coupling * curl], axis=-1)
    chains = model.finger_chains(model.clamp(angles))[0] * 1000.0 + np.array([10.0, 20.0, 700.0])
    names = [f"{f}_{joint}" for f in PREFIXES for joint in ("mcp", "pip", "dip", "tip")]
    head = ["frame", *(f"wrist_{a}" for a in "xyz"), *(f"{name}_{a}" for name in names for a in "xyz")]
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(head)
        for k, row in enumerate(chains):
            writer.writerow([k, 10.0, 20.0, 700.0, *row.ravel().round(4).tolist()])


def test_hands_of_the_model_itself_are_solved(invoke: Invoke, tmp_path: Path) -> None:
    write_hand(tmp_path / "msra14_dev.csv")
    invoke(hands, tmp_path, "--quick", "--json", tmp_path / "h.json")
    rows = rows_of(tmp_path / "h.json")
    assert rows["PIP and DIP, palm given, mean"]["value"] < 2.0
    assert rows["PIP and DIP, palm given, mean"]["verdict"] == "met"
    assert rows["PIP and DIP, from wrist and tips alone, mean"]["value"] is not None


def test_broken_hand_data_names_file_and_column(invoke: Invoke, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="holds none of"):
        invoke(hands, tmp_path)
    file = tmp_path / "msra14_dev.csv"
    file.write_text("frame,wrist_x\n1,2\n")
    with pytest.raises(ConfigError, match=r"msra14_dev.csv: has no column wrist_y"):
        invoke(hands, tmp_path)
    file.write_text("frame,wrist_x\n1,two\n")
    with pytest.raises(ConfigError, match="is not a table of numbers"):
        invoke(hands, tmp_path)


def test_streams_of_a_hand_that_rests_and_moves(invoke: Invoke, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    t = np.arange(240) / 30.0
    x = np.where(t > 4.0, 0.06 * np.sin(3.0 * (t - 4.0)), 0.0)
    recording = tmp_path / "moves"
    for camera, shift in (("left", 0.0), ("right", 0.075)):
        (recording / camera).mkdir(parents=True)
        u = 319.5 + 530.3 * (x - shift) / 0.8 + rng.normal(0.0, 0.15, len(t))
        lines = [
            f"{k},{10**18 + round(s * 1e9)},index,{a:.3f},240.0" for k, (s, a) in enumerate(zip(t, u, strict=True))
        ]
        (recording / camera / "markers.csv").write_text("\n".join(["frame,t_ns,marker,u,v", *lines]) + "\n")
    mask = ["frame,index", *(f"{k},{2 * (k == 100)}" for k in range(240))]
    (recording / "masks.csv").write_text("\n".join(mask) + "\n")
    invoke(streams, tmp_path, "--json", tmp_path / "s.json")
    rows = rows_of(tmp_path / "s.json")
    assert 2.0 < rows["step from frame to frame, p99"]["value"] < 30.0
    assert rows["sideways delay behind the picture"]["value"] < 0.5
    assert 0.0 < rows["noise at rest, sideways, median"]["value"] < 1.0
    assert rows["points that are measured"]["value"] > 10.0
    assert rows["glitches published as measured"]["value"] is not None


def test_no_recording_is_an_error(invoke: Invoke, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no recording with marker tracks"):
        invoke(streams, tmp_path)
    with pytest.raises(ConfigError, match=r"depth_table\.csv"):
        invoke(thesis, tmp_path)


def test_steps_of_real_feet(invoke: Invoke, tmp_path: Path, shared_data: Path) -> None:
    data = tmp_path / "data"
    (data / "foot_imu").mkdir(parents=True)
    name = "2017-11-22-11-28-39"
    for form, seconds in (("raw200", 6.0), ("bno100", 6.0)):
        header, *lines = (shared_data / "foot_imu" / f"{name}_{form}.csv").read_text().splitlines()
        some = [line for line in lines if float(line.split(",")[0]) < seconds]
        (data / "foot_imu" / f"{name}_{form}.csv").write_text("\n".join([header, *some]))
    trials = data / "foot_imu" / "trials.json"
    trials.write_text(json.dumps({name: {"author_ins_rmse_m": 0.0125, "motion_guess": "small steps"}}))
    (data / "aruco").mkdir()
    (data / "aruco" / "d435_qualisys").symlink_to(shared_data / "aruco" / "d435_qualisys")
    (data / "realsense").symlink_to(shared_data / "realsense")
    text = invoke(steps, data, "--quick", "--json", tmp_path / "s.json")
    rows = rows_of(tmp_path / "s.json")
    assert 0.1 < rows[f"{name}, mean"]["value"] < 20.0
    assert "small steps; " in text
    assert "aligned after" in text
    assert rows["published: the best detector, tuned to each trial"]["value"] == pytest.approx(12.5)
    assert 0.1 < rows["off on average, 1 trials"]["value"] < 30.0
    assert rows["test0: the right one of two orientations"]["verdict"] == "met"
    assert rows["ours: toes within 15 px"]["value"] > rows["the 2021 thesis's: toes within 15 px"]["value"]
    trials.write_text('{"a": 1}')
    with pytest.raises(ConfigError, match=r"trials\.json: tells no author_ins_rmse_m"):
        invoke(steps, data)


def test_steps_need_recordings(invoke: Invoke, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"holds none of foot_imu/\*_raw200\.csv"):
        invoke(steps, tmp_path / "nowhere")
