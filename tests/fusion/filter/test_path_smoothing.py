"""Looking back: the paths that later observations show, against those of the filter."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from marker_streams import EPOCH_NS, MARKERS, Motion, Seen, watch
from numpy.typing import NDArray

from rhot.messages import PointSet
from rhot.rig import Rig
from rhot_fusion.filter.motion_bank import MotionBank
from rhot_fusion.filter.path_smoothing import PathRecord
from rhot_fusion.stage import FusionStage

MakeRig = Callable[..., Rig]
FloatArray = NDArray[np.float64]

ONE = np.zeros(1, dtype=np.intp)


def both(rig: Rig, frames: list[Seen]) -> tuple[list[PointSet], list[PointSet]]:
    """Return what a stage publishes and what it says looking back."""
    stage = FusionStage(rig, record=True)
    published = []
    for one in frames:
        for _, points in stage.feed(one.frame):
            assert isinstance(points, PointSet)
            published.append(points)
    return published, stage.smoothed()


def without_index(one: Seen) -> Seen:
    markers = {name: marker for name, marker in one.frame.markers.items() if name != "index"}
    return Seen(one.arrival_s, one.frame.model_copy(update={"markers": markers}))


def errors_mm(sets: list[PointSet], motion: Motion, *, names: tuple[str, ...] = MARKERS) -> FloatArray:
    """Return the distances from the truth after the first half second."""
    errors = []
    for points in sets:
        t_s = (points.t_ns - EPOCH_NS) * 1e-9
        if t_s > 0.5:
            truth = motion.at(t_s)[0]
            errors += [
                np.linalg.norm(np.array(points.points[name].position) - truth[MARKERS.index(name)])
                for name in names
                if name in points.points
            ]
    return np.array(errors) * 1e3


def test_nearer_to_the_truth_than_the_filter(make_rig: MakeRig) -> None:
    motion = Motion()
    published, smoothed = both(make_rig(), watch(make_rig(), motion, 4.0, readout_s=0.012))
    assert [points.t_ns for points in smoothed] == [points.t_ns for points in published]
    live, later = errors_mm(published, motion), errors_mm(smoothed, motion)
    assert len(later) == len(live) > 2000
    assert np.median(later) < 0.75 * np.median(live)
    assert np.percentile(later, 95) < 0.8 * np.percentile(live, 95)


def test_a_gap_is_bridged_from_both_ends(make_rig: MakeRig) -> None:
    motion = Motion()
    rig = make_rig()
    published, smoothed = both(
        rig, [without_index(one) if 1.5 < one.arrival_s < 1.65 else one for one in watch(rig, motion, 3.0)]
    )
    gap = [row for row, points in enumerate(published) if 1.52e9 < points.t_ns - EPOCH_NS < 1.64e9]
    live = errors_mm([published[row] for row in gap], motion, names=("index",))
    later = errors_mm([smoothed[row] for row in gap], motion, names=("index",))
    assert len(later) == len(gap) > 10
    assert later.max() < 0.5 * live.max()
    assert all(smoothed[row].points["index"].state == "predicted" for row in gap)


def test_a_stream_that_begins_again_keeps_both_parts(make_rig: MakeRig) -> None:
    motion = Motion()
    rig = make_rig()
    frames = watch(rig, motion, 1.0)
    later = [
        Seen(one.arrival_s, one.frame.model_copy(update={"t_ns": one.frame.t_ns - 3_600_000_000_000, "markers": {}}))
        for one in frames
    ]
    published, smoothed = both(rig, frames + later)
    assert [points.t_ns for points in smoothed] == [points.t_ns for points in published]
    assert errors_mm(smoothed, motion).max() < 15.0


def test_nothing_is_kept_unless_asked_for(make_rig: MakeRig) -> None:
    rig = make_rig()
    stage = FusionStage(rig)
    for one in watch(rig, Motion(), 0.5):
        stage.feed(one.frame)
    assert stage.smoothed() == []


def test_the_last_node_is_the_filters_own() -> None:
    record = PathRecord(1)
    bank = MotionBank(np.zeros((1, 1)), record)
    bank.start(ONE, np.array([[0.0, 0.0, 0.8]]), np.eye(3)[None] * 1e-6, 0.0)
    bank.carry(0, np.array([0.01, 0.0, 0.0]), np.array([1.0, 0.0, 0.0]), 0.002, 0.01)
    path = record.smooth()[0]
    position, variance = path.at(np.array([-0.1, 0.01, 0.03]))
    assert np.isnan(position[0]).all()
    np.testing.assert_allclose(position[1:], [[0.01, 0.0, 0.8], [0.03, 0.0, 0.8]], atol=1e-9)
    np.testing.assert_allclose(variance[1:], 3.0 * (1e-6 + 4e-6), rtol=1e-6)


def test_what_is_taken_back_is_forgotten() -> None:
    record = PathRecord(1)
    bank = MotionBank(np.zeros((1, 1)), record)
    bank.start(ONE, np.array([[0.0, 0.0, 0.8]]), np.eye(3)[None] * 1e-6, 0.0)
    saved = bank.save()
    bank.carry(0, np.ones(3), np.zeros(3), 0.002, 0.01)
    bank.restore(saved)
    assert record.smooth()[0].t_s.tolist() == [0.0]
