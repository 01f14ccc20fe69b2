"""The filter method: what it does better than the paired methods, and what it must not do worse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from marker_streams import EPOCH_NS, MARKERS, Motion, Seen, pinhole_cameras, truth_figures, watch

from rhot.anatomy.hand import HandModel
from rhot.messages import PointSet
from rhot.rig import Rig
from rhot.rig.cameras import camera_rig
from rhot_fusion.core import FusionCore
from rhot_fusion.filter.acquisition import hands_of
from rhot_fusion.filter.tracker import FilterTracker
from rhot_fusion.filter.tracks import LOST_M
from rhot_fusion.views.sightings import vector

MakeRig = Callable[..., Rig]

STILL = Motion(amplitude_m=(0.0, 0.0, 0.0))
SLOW = Motion(frequency_hz=(0.35, 0.45, 0.25))
FILTER = 'method = "filter"'


def run(core: FusionCore, frames: list[Seen]) -> list[PointSet]:
    sets = []
    for one in frames:
        for _, points in core.feed(one.frame):
            assert isinstance(points, PointSet)
            sets.append(points)
    return sets


def without(seen: Seen, *names: str) -> Seen:
    markers = {name: marker for name, marker in seen.frame.markers.items() if name not in names}
    return replace(seen, frame=seen.frame.model_copy(update={"markers": markers}))


@pytest.mark.parametrize("motion", [SLOW, Motion()])
def test_nearer_to_the_truth_than_triangulation(make_rig: MakeRig, motion: Motion) -> None:
    figures = {}
    for method in ("filter", "triangulate"):
        rig = make_rig(fusion=f'method = "{method}"')
        figures[method] = truth_figures(FusionCore(rig), motion, watch(rig, motion, 3.0, readout_s=0.012))
    ours, theirs = figures["filter"], figures["triangulate"]
    assert ours.median_mm < 0.8 * theirs.median_mm
    assert ours.p95_mm < theirs.p95_mm
    assert ours.lateral_mm < 0.5
    assert ours.measured > 0.99
    # A set for each frame, at the frame's own time.
    assert ours.sets >= 355
    assert ours.lag_ms < 1.0


def test_still_markers_freeze(make_rig: MakeRig) -> None:
    rig = make_rig(pinhole_cameras(2), fusion=FILTER)
    sets = run(FusionCore(rig), watch(rig, STILL, 4.0, noise_px=0.08))[200:]
    track = np.array([points.points["index"].position for points in sets]) * 1e3
    truth = STILL.at(0.0)[0, MARKERS.index("index")] * 1e3
    assert np.abs(track.mean(axis=0) - truth).max() < 0.8
    assert track.std(axis=0)[:2].max() < 0.15
    assert track.std(axis=0)[2] < 1.0


def test_stated_sigma_covers_the_error(make_rig: MakeRig) -> None:
    rig = make_rig(pinhole_cameras(2), fusion=FILTER)
    relative = []
    for points in run(FusionCore(rig), watch(rig, SLOW, 3.0))[120:]:
        truth = SLOW.at((points.t_ns - EPOCH_NS) * 1e-9)[0]
        # A patch; caps of unknown direction have larger standard deviations.
        point = points.points["base"]
        relative.append(np.linalg.norm(np.array(point.position) - truth[-1]) / point.sigma)
        assert points.points["index"].sigma > 0.003
    assert 0.3 < np.median(relative) < 1.5
    assert np.percentile(relative, 95) < 3.0


def test_late_frames_change_little(make_rig: MakeRig) -> None:
    rig = make_rig(fusion=FILTER)
    seen = watch(rig, SLOW, 2.0)
    # Every frame of the second camera comes 20 ms late: after one newer frame of the first or two.
    late = sorted(
        (replace(one, arrival_s=one.arrival_s + 0.02 * (one.frame.camera == "right")) for one in seen),
        key=lambda one: one.arrival_s,
    )
    core = FusionCore(rig)
    figures = truth_figures(core, SLOW, late)
    assert core.counts["late_frames"] > 100
    assert figures.median_mm < 3.0
    assert figures.measured > 0.98


def test_frames_in_another_order_leave_the_same_paint(make_rig: MakeRig) -> None:
    """A fingertip vanishes within 0.2 s while one camera's frames come late: replayed frames change nothing twice."""
    rig = make_rig(fusion=FILTER)
    fading = []
    for one in watch(rig, SLOW, 2.0):
        left = max(1.0 - max(one.arrival_s - 1.0, 0.0) / 0.2, 0.02)
        markers = dict(one.frame.markers)
        tip = markers["index"]
        markers["index"] = tip.model_copy(update={"area": (150.0 if tip.area == 0.0 else tip.area) * left**2})
        fading.append(replace(one, frame=one.frame.model_copy(update={"markers": markers})))

    def paint_of(delay_s: float) -> list[tuple[float, float]]:
        in_order = sorted(
            (replace(one, arrival_s=one.arrival_s + delay_s * (one.frame.camera == "right")) for one in fading),
            key=lambda one: one.arrival_s,
        )
        core = FusionCore(rig)
        for one in in_order:
            core.feed(one.frame)
        assert (core.counts["late_frames"] > 50) is (delay_s > 0.0)
        tracker = core._tracker
        assert isinstance(tracker, FilterTracker)
        return [(shown.shrinking, shown.width_m) for cameras in tracker._paint._shown for shown in cameras]

    np.testing.assert_allclose(paint_of(0.02), paint_of(0.0), rtol=0.02, atol=1e-5)


def test_views_nanoseconds_apart_are_taken(make_rig: MakeRig) -> None:
    """As of a program that counts milliseconds: another camera's newest view is near, this camera's own is not."""
    rig = make_rig(fusion=FILTER)
    core = FusionCore(rig)
    for one in watch(rig, SLOW, 1.0):
        t_ns = EPOCH_NS + round((one.frame.t_ns - EPOCH_NS) / 1e6)
        markers = {name: marker.model_copy(update={"t_ns": None}) for name, marker in one.frame.markers.items()}
        core.feed(one.frame.model_copy(update={"t_ns": t_ns, "markers": markers}))
    assert core.counts["published"] > 0


def test_looking_back_stays_on_the_path_where_nothing_is_calibrated(make_rig: MakeRig) -> None:
    """Whole pixels, stamps that err by 6 ms and a wrong blob in twenty: the smoothed path holds, and says how well."""
    rig, motion, rng = make_rig(fusion=FILTER, rate_hz=30.0), Motion(), np.random.default_rng(3)
    core = FusionCore(rig, record=True)
    for one in watch(rig, motion, 3.0, rate_hz=30.0, noise_px=0.5):
        late_ns, markers = round(rng.normal(0.0, 6e6)), {}
        for name, marker in one.frame.markers.items():
            assert marker.t_ns is not None
            wrong = float(rng.choice([-25.0, -12.0, 12.0, 25.0])) if rng.random() < 0.05 else 0.0
            moved = {"u": round(marker.u) + wrong, "v": round(marker.v) + wrong / 3.0, "t_ns": marker.t_ns + late_ns}
            markers[name] = marker.model_copy(update=moved)
        core.feed(one.frame.model_copy(update={"t_ns": one.frame.t_ns + late_ns, "markers": markers}))
    error, ratio, seen = [], [], []
    for points in core.smoothed():
        t_s = (points.t_ns - EPOCH_NS) * 1e-9
        truth = motion.at(t_s)[0]
        for index, name in enumerate(MARKERS):
            if t_s > 0.5 and name in points.points:
                point = points.points[name]
                error.append(1e3 * float(np.linalg.norm(np.array(point.position) - truth[index])))
                ratio.append(1e-3 * error[-1] / point.sigma)
                seen.append(point.state != "predicted")
    assert len(error) > 700
    assert np.median(error) < 11.0
    assert np.percentile(error, 95) < 40.0
    assert np.array(error)[seen].max() < 200.0
    assert np.mean(np.array(ratio) < 2.0) > 0.9


def test_slow_cameras_out_of_step_begin_a_hand(make_rig: MakeRig) -> None:
    """At 15 frames per second and out of step by half a period, the first two views leave decimetres of depth open."""
    rig = make_rig(pinhole_cameras(2), fusion=FILTER, rate_hz=15.0)
    sets = run(FusionCore(rig), watch(rig, SLOW, 2.0, rate_hz=15.0, phase_s=0.033))
    late = [points for points in sets if points.t_ns - EPOCH_NS > 1.0e9]
    assert all(points.points[name].state == "measured" for points in late for name in MARKERS)
    sigma_m = [point.sigma for points in sets for point in points.points.values()]
    assert max(sigma_m) <= LOST_M, "what may be anywhere is not published"


def test_a_marker_seen_by_one_camera_grows_less_sure(make_rig: MakeRig) -> None:
    rig = make_rig(fusion=FILTER)
    seen = watch(rig, Motion(), 1.4)
    sets = run(
        FusionCore(rig),
        [without(one, "index") if one.frame.camera == "right" and 1.0 < one.arrival_s < 1.2 else one for one in seen],
    )
    bridged = [points for points in sets if 1.03e9 < points.t_ns - EPOCH_NS < 1.2e9]
    assert bridged
    for points in bridged:
        point = points.points["index"]
        assert (point.state, point.views) == ("one_view", 1)
        truth = Motion().at((points.t_ns - EPOCH_NS) * 1e-9)[0, 1]
        error = np.array(point.position) - truth
        assert np.hypot(error[0], error[1]) < 0.006
        assert np.linalg.norm(error) < 0.03
    # Less than the filter's own sigma, which doubles: the depth of the rest of the hand bounds what is published.
    assert bridged[-1].points["index"].sigma > 1.8 * bridged[0].points["index"].sigma


@pytest.mark.xfail(strict=True, reason="0.1 s after, the gate has grown to the neighbour's place: 31 mm off, measured")
def test_exchanged_labels_do_not_exchange_markers(make_rig: MakeRig) -> None:
    """Two neighbours take each other's colour for half a second; both stay where they are."""
    rig = make_rig(fusion=FILTER)

    def exchanged(one: Seen) -> Seen:
        if not 1.0 < one.arrival_s < 1.2:
            return one
        markers = dict(one.frame.markers)
        markers["ring"], markers["middle"] = markers["middle"], markers["ring"]
        return replace(one, frame=one.frame.model_copy(update={"markers": markers}))

    sets = run(FusionCore(rig), [exchanged(one) for one in watch(rig, SLOW, 1.6)])
    assert {"middle", "ring"} <= sets[-1].points.keys(), "both are back"
    for points in sets:
        t_s = (points.t_ns - EPOCH_NS) * 1e-9
        if t_s < 0.5:
            continue
        truth = SLOW.at(t_s)[0]
        for place, name in ((2, "middle"), (3, "ring")):
            if name in points.points:
                assert np.linalg.norm(np.array(points.points[name].position) - truth[place]) < 0.02, t_s


def test_glitches_are_never_measured(make_rig: MakeRig) -> None:
    rig = make_rig(fusion=FILTER)
    rng = np.random.default_rng(7)
    wrong = set()
    frames = []
    for one in watch(rig, SLOW, 3.0):
        if rng.random() < 0.1 and one.arrival_s > 0.5:
            index = one.frame.markers["index"]
            off = index.model_copy(update={"u": index.u + float(rng.choice([-60, 45])), "v": index.v + 20.0})
            frame = one.frame.model_copy(update={"markers": {**one.frame.markers, "index": off}})
            wrong.add((frame.camera, frame.frame))
            frames.append(replace(one, frame=frame))
        else:
            frames.append(one)
    core = FusionCore(rig)
    for one in frames:
        for _, points in core.feed(one.frame):
            assert isinstance(points, PointSet)
            if (one.frame.camera, one.frame.frame) in wrong:
                assert points.points["index"].state != "measured"
                truth = SLOW.at((points.t_ns - EPOCH_NS) * 1e-9)[0, 1]
                assert np.linalg.norm(np.array(points.points["index"].position) - truth) < 0.012


def test_a_marker_found_where_it_was_expected_is_measured_at_once(make_rig: MakeRig) -> None:
    rig = make_rig(fusion=FILTER)
    seen = watch(rig, SLOW, 1.5, phase_s=0.0)
    sets = run(
        FusionCore(rig),
        [without(one, "index") if (one.frame.camera, one.frame.frame) == ("right", 60) else one for one in seen],
    )
    states = {round((points.t_ns - EPOCH_NS) * 60e-9): points.points["index"].state for points in sets if points.points}
    assert [states[number] for number in (59, 60, 61, 62)] == ["measured", "one_view", "measured", "measured"]


def test_positions_that_a_camera_repeats_are_not_measured(make_rig: MakeRig) -> None:
    """Some capture programs repeat the last place of a marker that they lost."""
    rig = make_rig(fusion=FILTER)
    frames = []
    held = None
    for one in watch(rig, Motion(), 1.5):
        frame = one.frame
        if frame.camera == "right":
            if held is None or not 1.0 < one.arrival_s < 1.1:
                held = frame.markers["index"]
            else:
                again = held.model_copy(update={"t_ns": frame.markers["index"].t_ns})
                frame = frame.model_copy(update={"markers": {**frame.markers, "index": again}})
        frames.append(replace(one, frame=frame))
    meanwhile = [points for points in run(FusionCore(rig), frames) if 1.03e9 < points.t_ns - EPOCH_NS < 1.1e9]
    assert len(meanwhile) > 2
    assert all(points.points["index"].state != "measured" for points in meanwhile)


def test_prediction_is_stamped_and_placed_ahead(make_rig: MakeRig) -> None:
    rig = make_rig(fusion=FILTER + "\npredict_s = 0.02")
    motion = Motion()
    seen = watch(rig, motion, 3.0)
    figures = truth_figures(FusionCore(rig), motion, seen)
    assert figures.lag_ms == pytest.approx(-20.0, abs=1.0)
    # 20 ms at 0.4 m/s would be 8 mm.
    assert figures.lateral_mm < 2.0


def flashing(seen: Seen, name: str, frames: range, number: int) -> Seen:
    """Hide a marker from frame 60 on but for some frames, in which both cameras see it 40 px further down."""
    if number < 60:
        return seen
    if number not in frames:
        return without(seen, name)
    markers = dict(seen.frame.markers)
    markers[name] = markers[name].model_copy(update={"v": markers[name].v + 40.0})
    return replace(seen, frame=seen.frame.model_copy(update={"markers": markers}))


@pytest.mark.parametrize(("length", "measured"), [(6, False), (12, True)])
def test_what_is_found_is_measured_once_it_stays(make_rig: MakeRig, length: int, measured: bool) -> None:
    rig = make_rig(fusion=FILTER)
    frames = watch(rig, STILL, 2.0)
    shown = range(150, 150 + length)
    sets = run(FusionCore(rig), [flashing(one, "index", shown, number) for number, one in enumerate(frames)])
    after = [points for points in sets if points.t_ns >= frames[150].frame.t_ns]
    found = [points.points["index"] for points in after if "index" in points.points]
    assert found or not measured
    assert any(point.state == "measured" for point in found) == measured


def test_a_straight_finger_reaches_as_far_as_its_model(make_rig: MakeRig) -> None:
    """A flat hand's fingertip is one reach from where its finger begins beside the patch; the thumb has none."""
    rig = make_rig(pinhole_cameras(2), fusion=FILTER)
    side = rig.config.markers["base"].hand
    model = HandModel.from_file(rig.hand, side)
    places = model.marker_positions(model.forward(np.eye(4), np.zeros((5, 4))), rig.config.markers)
    (hand,) = hands_of(rig.config.markers, rig.hand, camera_rig(rig).models, record=False)
    for k, marker in enumerate(hand.markers):
        name = list(rig.config.markers)[marker]
        hand.filter.begin(k, np.concatenate([places[name], np.zeros(3)]), np.eye(6), 0.0)
    everywhere = [vector(place) for place in hand.filter.position]
    roots = hand.roots(everywhere, [True] * len(everywhere))
    for marker, tip, root, reach_m in zip(hand.markers, everywhere, roots, hand.reach_m, strict=True):
        name = list(rig.config.markers)[marker]
        if name in ("thumb", "base"):
            assert reach_m == 0.0
        else:
            assert np.linalg.norm(np.subtract(tip, root)) == pytest.approx(reach_m)
