"""The foot tracker's evaluation: a short run from picture to table, and figures of made-up runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot_bench.feet.command import RUNS, feet
from rhot_bench.feet.runs import SIDES, STAGES, Played, Run, Track, play
from rhot_bench.feet.sections import feet_sections
from rhot_sim.walker.folder import write_walker_rig


def made_up(run: Run, error_m: NDArray[np.float64], *, measured: NDArray[np.bool_]) -> Played:
    count = len(error_m)
    stage = np.where(measured, STAGES.index("marker"), STAGES.index("lost"))
    track = Track(error_m, measured, stage, np.zeros(count, np.bool_), np.ones(count))
    thesis = Track(10.0 * error_m, measured, stage, np.zeros(count, np.bool_), np.ones(count))
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
    played = made_up(run, error_m, measured=measured)
    track = played.ours["left"]
    stage = track.stage.copy()
    stage[:130] = STAGES.index("inertial")
    error_m[135:] = 0.001
    hidden = replace(
        played,
        ours={"left": replace(track, stage=stage), "right": track},
        blackouts=np.array([[0.0, 1.0]]),
        blackout_sides=["left"],
    )
    rows = {row.name: row.value for section in feet_sections({run.name: [hidden]}) for row in section.rows}
    assert rows["inertial stage, 1 s after it was hidden in a step, average"] == pytest.approx(200.0)
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


def test_an_unknown_run_is_named() -> None:
    result = CliRunner().invoke(feet, ["--runs", "still,flying"])
    assert isinstance(result.exception, ConfigError)
    assert "flying" in str(result.exception)
