"""Explanations of fusion and ik: rejected views with their distances; explaining changes nothing."""

from __future__ import annotations

import pytest

from rhot.core import Explaining, Explanation
from rhot.messages import HandPose, MarkerFrame, PointSet
from rhot.rig import Rig, load_rig, write_json_model
from rhot.rig.template import rig_template
from rhot_bench.speed.simulated import projected_frames, world_of
from rhot_fusion.core import FusionCore
from rhot_ik.hand_core import HandCore
from rhot_sim.rig.calibration import simulated_rig_calibration


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    """Simulated, without colours: no pictures are used."""
    folder = tmp_path_factory.mktemp("rig")
    (folder / "rig.toml").write_text(rig_template(folder="rig", name="test", source="simulated", seed=1))
    write_json_model(folder / "cameras.json", simulated_rig_calibration(load_rig(folder).config.cameras, 1).found)
    return load_rig(folder)


@pytest.fixture(scope="module")
def frames(rig: Rig) -> list[MarkerFrame]:
    return list(projected_frames(rig, world_of(rig), 0.5, 1.2))


def table(tables: list[Explanation], title: str) -> Explanation:
    return next(found for found in tables if found.title.startswith(title))


def moved(frame: MarkerFrame, name: str, by_px: float) -> MarkerFrame:
    marker = frame.markers[name].model_copy(update={"u": frame.markers[name].u + by_px})
    return frame.model_copy(update={"markers": {**frame.markers, name: marker}})


def test_a_wrong_position_is_rejected_with_its_distance(rig: Rig, frames: list[MarkerFrame]) -> None:
    core = FusionCore(rig)
    assert isinstance(core, Explaining)
    for frame in frames[:-1]:
        core.feed(frame)
    last = frames[-1]
    core.feed(moved(last, "index", 40.0))
    rows = {row.cells[:2]: row for row in table(core.explain(), "Gates").rows}
    rejected = rows[last.camera, "index"]
    assert rejected.verdict == "rejected"
    assert 30.0 < abs(float(rejected.cells[2])) < 50.0
    assert rejected.cells[-1] == "rejected"
    others = [row for (_, name), row in rows.items() if name != "index"]
    assert {row.verdict for row in others} == {"accepted"}
    assert all(abs(float(row.cells[2])) < 5.0 * float(row.cells[3]) for row in others)
    states = {row.cells[0]: row.cells for row in table(core.explain(), "Filter").rows}
    assert states["thumb"][1] == "measured"
    assert float(states["thumb"][4]) < 30.0, "last seen, ms ago"


def test_a_marker_that_one_camera_sees_is_on_its_ray(rig: Rig, frames: list[MarkerFrame]) -> None:
    core = FusionCore(rig)
    for frame in frames:
        hidden = {name: marker for name, marker in frame.markers.items() if (name, frame.camera) != ("ring", "left")}
        core.feed(frame.model_copy(update={"markers": hidden}))
    states = {row.cells[0]: row for row in table(core.explain(), "Filter").rows}
    assert states["ring"].cells[1] == "one_view"
    assert states["ring"].cells[-1] == "right"


@pytest.mark.parametrize("method", ["filter", "triangulate", "disparity"])
def test_explaining_changes_nothing(rig: Rig, frames: list[MarkerFrame], method: str) -> None:
    plain, asked = FusionCore(rig), FusionCore(rig)
    config = rig.config.fusion.model_copy(update={"method": method})
    for core in (plain, asked):
        core.configure(config)
    for frame in frames:
        assert asked.feed(frame) == plain.feed(frame)
        assert asked.explain()


def test_hand(rig: Rig, frames: list[MarkerFrame]) -> None:
    fusion, plain, asked = FusionCore(rig), HandCore(rig), HandCore(rig)
    assert asked.explain()[0].rows[0].verdict == "rejected"
    hand = None
    for frame in frames:
        for _, points in fusion.feed(frame):
            assert isinstance(points, PointSet)
            outputs = asked.feed(points)
            assert outputs == plain.feed(points)
            asked.explain()
            hand = outputs[0][1] if outputs else hand
    assert isinstance(hand, HandPose)
    angles = {row.cells[:2]: row.cells for row in table(asked.explain(), "Hand right: angles").rows}
    assert len(angles) == 20
    shown = float(angles["index", "flexion"][2])
    assert shown == pytest.approx(hand.angles["index"].mcp_flexion * 57.2958, abs=0.06)
    fingers = {row.cells[0]: row.cells for row in table(asked.explain(), "Hand right: residual").rows}
    assert float(fingers["index"][2]) == pytest.approx(1e3 * hand.residual["index"], abs=0.006)
