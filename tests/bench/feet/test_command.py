"""The foot tracker's evaluation: a short run from picture to table, and figures of made-up runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot_bench.feet.command import RUNS, feet, feet_sections, key_of, load_played, make_folder, save_played
from rhot_bench.feet.runs import SIDES, STAGES, FootTrajectory, Played, Run, play
from rhot_bench.feet.stages import CELLS, PRINTED_M, TASKS, cell_plots, table_5_1
from rhot_sim.walker.folder import write_walker_rig
from rhot_tools.measures.provenance import provenance


def made_up(run: Run, error_m: NDArray[np.float64], *, measured: NDArray[np.bool_]) -> Played:
    count = len(error_m)
    stage = np.where(measured, STAGES.index("marker"), STAGES.index("lost"))
    truth, off = np.zeros((count, 3)), np.outer(error_m, [0.0, 0.6, 0.8])
    track = FootTrajectory(off, truth, measured, stage, np.zeros(count, np.bool_), np.ones(count))
    thesis = FootTrajectory(10.0 * off, truth, measured, stage, np.zeros(count, np.bool_), np.ones(count))
    t_s = np.linspace(0.0, 0.01 * (count - 1), count)
    return Played(
        run,
        1,
        t_s,
        np.full(count, 0.01),
        dict.fromkeys(SIDES, track),
        dict.fromkeys(SIDES, thesis),
        np.empty((0, 2)),
        [],
        np.full(10, 0.005),
        np.full(count, 0.001),
        np.full(4, 0.03),
        0,
        {},
    )


def test_a_short_run_from_picture_to_knee(tmp_path: Path) -> None:
    rig = write_walker_rig(tmp_path / "rig", endpoint="tcp/127.0.0.1:1")
    played = play(RUNS["still"], rig, 1, 0.5)
    assert len(played.picture_s) >= 25
    for side in SIDES:
        track = played.ours[side]
        assert track.measured[-10:].all()
        assert np.max(1e3 * track.error_m[-10:]) < 5.0
        assert np.isfinite(played.thesis[side].error_m[-10:]).all()
    assert 0.005 < played.late_s[-10:].mean() < 0.02
    assert played.knees_backwards == 0
    assert len(played.knee_error_m) > 20


def test_averages_leave_out_what_is_not_measured() -> None:
    error_m = np.full(400, 0.004)
    measured = np.ones(400, np.bool_)
    error_m[300:], measured[300:] = 0.5, False
    run = RUNS["marker_moving"]
    rows = {row.name: row for section in feet_sections({run.name: [made_up(run, error_m, measured=measured)]})
            for row in section.rows}  # fmt: skip
    average = rows["marker moving, average"]
    assert average.value == pytest.approx(4.0)
    assert average.verdict == "met"
    assert rows["marker moving, worst"].value == pytest.approx(4.0)
    assert rows["    the thesis's tracker on the same data"].value == pytest.approx(40.0)
    assert rows["marker_moving: measured"].value == pytest.approx(75.0)
    assert rows["one core at 60 pictures and 2x100 samples a second"].value == pytest.approx(40.0)


def test_seeds_are_told_apart() -> None:
    run, measured = RUNS["marker_moving"], np.ones(400, np.bool_)
    played = [made_up(run, np.full(400, error_m), measured=measured) for error_m in (0.001, 0.002, 0.009)]
    (section, *_) = feet_sections({run.name: played})
    values = [row.value for row in section.rows[:4]]
    assert values == pytest.approx([4.0, 40.0, 2.0, 9.0])


def test_a_foot_is_back_when_its_marker_is() -> None:
    """Pictures come back at 1.0 s, the marker at 1.3 s, and the position is right from 1.35 s on."""
    run, error_m, measured = RUNS["inertial"], np.full(400, 0.2), np.ones(400, np.bool_)
    track = made_up(run, error_m, measured=measured).ours["left"]
    stage = track.stage.copy()
    stage[:130] = STAGES.index("inertial")
    error_m[135:] = 0.001
    played = made_up(run, error_m, measured=measured)
    hidden = replace(
        played,
        ours={"left": replace(played.ours["left"], stage=stage), "right": played.ours["right"]},
        blackouts=np.array([[0.0, 1.0]]),
        blackout_sides=["left"],
    )
    rows = {row.name: row.value for section in feet_sections({run.name: [hidden]}) for row in section.rows}
    assert rows["by inertial, 1 s after it was hidden in a step, average"] == pytest.approx(200.0)
    assert rows["within 20 mm, 0.1 s after its marker is believed again"] == pytest.approx(100.0)


def test_the_worst_of_a_task_shows_both_measured_and_predicted() -> None:
    error_m, measured = np.full(400, 0.002), np.ones(400, np.bool_)
    error_m[10] = 0.2
    error_m[20], measured[20] = 0.4, False
    run = RUNS["task_walk"]
    rows = {row.name: row for section in feet_sections({run.name: [made_up(run, error_m, measured=measured)]})
            for row in section.rows}  # fmt: skip
    assert rows["walk, worst"].value == pytest.approx(200.0)
    assert rows["walk, worst"].verdict == "missed"
    assert rows["    worst while only predicted"].value == pytest.approx(400.0)
    assert rows["    worst while only predicted"].verdict == "missed"


def test_a_squat_has_targets_of_its_own() -> None:
    error_m, measured = np.full(400, 0.002), np.ones(400, np.bool_)
    played = made_up(RUNS["task_squat"], error_m, measured=measured)
    stage = np.where(np.arange(400) < 60, STAGES.index("none"), STAGES.index("marker"))
    sides = {side: replace(track, stage=stage) for side, track in played.ours.items()}
    sections = feet_sections({"task_squat": [replace(played, ours=sides)]})
    rows = {row.name: row for section in sections for row in section.rows}
    assert rows["squats and kneels, mean error"].value == pytest.approx(30.0)
    assert rows["squats and kneels: not published"].value == pytest.approx(15.0)
    assert rows["squats and kneels: not published"].verdict == "missed"


def rows_of(played: Played) -> dict[str, float]:
    return {row.name: row.value for section in feet_sections({played.run.name: [played]}) for row in section.rows}


def test_all_twelve_cells_of_the_thesis_are_runs() -> None:
    assert len(CELLS) == len({cell.run.name for cell in CELLS}) == 12
    assert all(RUNS[cell.run.name] == cell.run for cell in CELLS)


def test_a_cell_counts_what_its_stage_is_about() -> None:
    """Markers are covered from 4 s on: only the errors from then on are those of the depth stage."""
    error_m, measured = np.full(800, 0.001), np.ones(800, np.bool_)
    error_m[401:] = 0.009
    run = RUNS["still_depth"]
    rows = rows_of(made_up(run, error_m, measured=measured))
    assert rows["standing still, by depth, average"] == pytest.approx(9.0)
    error_m[:], error_m[500:600] = 0.001, 0.02
    dark = replace(
        made_up(RUNS["still_inertial"], error_m, measured=measured),
        blackouts=np.array([[5.0, 6.0]]),
        blackout_sides=["left"],
    )
    rows = rows_of(dark)
    assert rows["standing still, by inertial, average"] == pytest.approx(20.0)
    assert rows["cells of 1 in which ours errs less than the thesis's tracker, average"] == 1.0
    (plot,) = cell_plots({dark.run.name: [dark]})
    assert "standing still, by inertial" in plot
    assert plot.count("<polyline") == 3


def test_table_5_1_stands_beside_what_was_printed() -> None:
    error_m, measured = np.full(400, 0.002), np.ones(400, np.bool_)
    error_m[50], error_m[60:80] = 0.4, np.nan
    run = replace(RUNS["task_line"], without_imu=("left",))
    done = {run.name: [made_up(run, error_m, measured=measured)]}
    left, right = table_5_1(done).rows
    assert left == (
        "straight line of 2 m",
        "left, without sensor",
        "3 / 2 / 400",
        "30 / 20 / 4000",
        "85 / 25 / 630",
        "95 %",
    )
    assert right[1] == "right, with sensor"
    assert right[4] == "62 / 25 / 390"
    assert rows_of(done[run.name][0])["straight line of 2 m, left, without sensor, worst"] == pytest.approx(400.0)
    text = "columns of 2 in which ours errs less than the thesis's tracker: average, median and worst"
    assert rows_of(done[run.name][0])[text] == 2.0
    worse = replace(done[run.name][0], thesis=done[run.name][0].ours)
    assert rows_of(worse)[text] == 0.0
    assert set(PRINTED_M) == set(TASKS)
    assert "<table>" in table_5_1(done).html()


def test_a_foot_without_sensor_is_sent_no_samples(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rhot_bench.feet.runs.LEARN_S", 1.0)
    rig = write_walker_rig(tmp_path / "rig", endpoint="tcp/127.0.0.1:1", rate_hz=30.0)
    played = play(replace(RUNS["marker_moving_inertial"], without_imu=("left",)), rig, 1, 3.0)
    begun_s, ended_s = played.blackouts[0]
    dark = (played.t_s > begun_s + 0.4) & (played.t_s < ended_s - 0.1)
    assert dark.any()
    inertial, lost = STAGES.index("inertial"), STAGES.index("lost")
    assert (played.ours["right"].stage[dark] == inertial).all()
    assert not (played.ours["left"].stage[dark] == inertial).any()
    assert (played.thesis["left"].stage[dark] == lost).all()


def test_a_finished_run_is_kept_for_the_same_run_alone(tmp_path: Path) -> None:
    rig = write_walker_rig(tmp_path / "rig", endpoint="tcp/127.0.0.1:1")
    run, file = replace(RUNS["task_line"], without_imu=("left",)), tmp_path / "task_line-1.npz"
    error_m = np.linspace(0.0, 0.2, 400)
    error_m[7] = np.nan
    dark = np.array([[0.0, 1.0]])
    played = replace(
        made_up(run, error_m, measured=error_m < 0.1), blackouts=dark, blackout_sides=["left"], counts={"pictures": 3}
    )
    key = key_of(run, rig, 1, 8.0, "abc")
    assert load_played(file, key, run, 1) is None
    save_played(file, key, played)
    again = load_played(file, key, run, 1)
    assert again is not None
    before, after = (table_5_1({run.name: [each]}).rows for each in (played, again))
    assert before == after
    assert rows_of(again) == pytest.approx(rows_of(played), nan_ok=True)
    assert (again.blackout_sides, again.counts, again.run) == (["left"], {"pictures": 3}, run)
    for other in (
        key_of(run, rig, 1, 9.0, "abc"),
        key_of(run, rig, 1, 8.0, "abd"),
        key_of(RUNS["still"], rig, 1, 8.0, "abc"),
    ):
        assert load_played(file, other, run, 1) is None
    file.write_bytes(file.read_bytes()[:100])
    assert load_played(file, key, run, 1) is None


def test_an_interrupted_evaluation_goes_on_where_it_was(tmp_path: Path) -> None:
    command = ["--runs", "still", "--seeds", "1", "--duration", "5", "--jobs", "1", "--keep", str(tmp_path / "kept")]
    # The command's own rig is a temporary one, in another folder each time.
    rig = write_walker_rig(tmp_path / "rig", endpoint="tcp/127.0.0.1:7447")
    key = key_of(RUNS["still"], rig, 1, 5.0, provenance()["commit"])
    make_folder(tmp_path / "kept")
    save_played(
        tmp_path / "kept" / "still-1.npz",
        key,
        made_up(RUNS["still"], np.full(500, 0.0125), measured=np.ones(500, np.bool_)),
    )
    result = CliRunner().invoke(feet, command, catch_exceptions=False)
    assert "12.5 mm" in result.output


def test_an_unknown_run_is_named() -> None:
    result = CliRunner().invoke(feet, ["--runs", "still,flying"])
    assert isinstance(result.exception, ConfigError)
    assert "flying" in str(result.exception)
