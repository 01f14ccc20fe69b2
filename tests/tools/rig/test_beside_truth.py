"""Every figure of a report about a simulated rig agrees with the truth within the uncertainty that it states."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from simulated_session import LATE_S, simulated_session

from rhot.rig import Rig
from rhot_sim.rig import folder
from rhot_tools.grasp.figures import grasp_figures
from rhot_tools.grasp.session import grasp_session
from rhot_tools.measures.rows import Row, Section
from rhot_tools.rig.command import simulated_truth
from rhot_tools.rig.depth import depth_sections, rows_by_truth
from rhot_tools.rig.grasps import drift_figure, grasps, hand_deviations
from rhot_tools.rig.heard import Heard
from rhot_tools.rig.jitter import jitter_sections, still_jitter
from rhot_tools.rig.latency import latencies_of, latency_sections
from rhot_tools.rig.statistics import Figure

# In one worker: what they share takes seconds.
pytestmark = pytest.mark.xdist_group("beside truth")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    with pytest.MonkeyPatch.context() as patch:
        # Blobs without pictures need no colours, and learning them takes five seconds.
        patch.setattr(folder, "calibrate_colors", lambda _: None)
        return folder.write_simulated_rig(tmp_path_factory.mktemp("beside") / "rig", rate_hz=30.0)


@pytest.fixture(scope="module")
def moving(rig: Rig) -> Heard:
    """A gesture, and a grasp from 6 to 12 s."""
    return simulated_session(rig, 14.0)


def checks(sections: list[Section]) -> list[Row]:
    return [row for section in sections if "simulator's truth" in section.title for row in section.rows]


def wrong(rows: list[Row]) -> list[str]:
    return [f"{row.name}: {row.note}" for row in rows if row.value != 1.0]


def test_depths_and_the_laws_through_them(rig: Rig, moving: Heard) -> None:
    truth = simulated_truth(rig, moving)
    assert truth is not None
    rows = checks(depth_sections(rows_by_truth(rig, moving.frames, moving.truth, "index"), truth.fb))
    assert {"k", "z", "a", "o"} < {row.name for row in rows}
    assert len(rows) >= 10
    assert wrong(rows) == []


def test_grasps(rig: Rig, moving: Heard) -> None:
    rows = checks(grasps(rig, moving))
    assert [row.name for row in rows][1:] == [
        "gap, reach",
        "gap, close",
        "gap, carry",
        "gap, release",
        "drift, worst pick-up",
    ]
    assert wrong(rows) == []


def test_a_drift_may_be_error_alone_but_not_one_that_is_larger_than_that(rig: Rig, moving: Heard) -> None:
    session = grasp_session(moving.poses)
    found = grasp_figures(session)
    value_m = float(found.drift_m.max())

    def judged(doubt_m: float, known: float = 1.0) -> Figure:
        said = np.full(len(session.t_ns), doubt_m)
        said[round(known * len(said)) :] = np.nan
        return drift_figure(session, found, (session.t_ns, said))

    assert judged(value_m).value == pytest.approx(value_m)
    assert judged(value_m).holds(0.0)
    assert judged(value_m).holds(2.9 * value_m)
    assert not judged(0.2 * value_m).holds(0.4 * value_m)
    assert not judged(0.2 * value_m).holds(1.6 * value_m)
    # Where the hand was mostly hidden nobody knows.
    assert math.isnan(judged(value_m, known=0.1).high)
    _, doubt_m = hand_deviations(moving.points, rig, "right")
    assert 1e-3 < np.nanmedian(doubt_m) < 15e-3


def test_latencies_and_clocks(rig: Rig, moving: Heard) -> None:
    truth = simulated_truth(rig, moving)
    assert truth is not None
    rows = checks(latency_sections(moving, latencies_of(moving, truth.exposed_ns)))
    assert len(rows) == 6
    assert wrong(rows) == []
    # A clock that is further off than it says is told.
    for name, status in list(moving.statuses.items()):
        moving.statuses[name] = status.model_copy(update={"clock_uncertainty_s": 0.5 * abs(LATE_S["right"])})
    rows = checks(latency_sections(moving, latencies_of(moving, truth.exposed_ns)))
    assert wrong(rows)


def test_a_still_hand_and_one_that_is_not(rig: Rig, moving: Heard) -> None:
    sim = rig.config.sim.model_copy(update={"motion": "still"})
    still = dataclasses.replace(rig, config=rig.config.model_copy(update={"sim": sim}))
    heard = simulated_session(still, 6.0)
    truth = simulated_truth(still, heard)
    assert truth is not None
    jitter = still_jitter(heard, truth.cameras)
    rows = [row for row in checks(jitter_sections(jitter)) if not math.isnan(row.value)]
    assert sum("pictures" in row.name for row in rows) >= 10
    assert wrong(rows) == []
    assert min(jitter.rested.values()) > 0.7
    # What a moving hand tells of its jitter is right too, or nothing.
    rows = [row for row in checks(jitter_sections(still_jitter(moving, truth.cameras))) if not math.isnan(row.value)]
    assert wrong(rows) == []
