from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from marker_streams import EPOCH_NS, MARKERS, Motion, Seen, pinhole_cameras, truth_figures, watch

from rhot.arrays import FloatArray
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import Marker, MarkerFrame, PointSet
from rhot.rig import FusionConfig, Rig
from rhot_fusion.core import FusionCore

STILL = Motion(amplitude_m=(0.0, 0.0, 0.0))
SLOW = Motion(frequency_hz=(0.35, 0.45, 0.25))
DISTORTION = np.array([0.19, -0.48, 0.001, -0.0007, 0.30])

MakeRig = Callable[..., Rig]


def run(core: FusionCore, frames: Iterable[Seen]) -> list[PointSet]:
    sets = []
    for one in frames:
        for key, points in core.feed(one.frame):
            assert key == "rhot/points"
            assert isinstance(points, PointSet)
            sets.append(points)
    return sets


def place(points: PointSet, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    return np.array(points.points[name].position)


def without(seen: Seen, *names: str) -> Seen:
    markers = {name: marker for name, marker in seen.frame.markers.items() if name not in names}
    return replace(seen, frame=seen.frame.model_copy(update={"markers": markers}))


def delayed(seen: Seen, delay_ns: int) -> Seen:
    markers = {
        name: marker.model_copy(update={"t_ns": (marker.t_ns or 0) + delay_ns})
        for name, marker in seen.frame.markers.items()
    }
    frame = seen.frame.model_copy(update={"t_ns": seen.frame.t_ns + delay_ns, "markers": markers})
    return replace(seen, frame=frame)


def moved(seen: Seen, name: str, du: float, dv: float = 0.0) -> Seen:
    marker = seen.frame.markers[name]
    shifted = marker.model_copy(update={"u": marker.u + du, "v": marker.v + dv})
    return replace(seen, frame=seen.frame.model_copy(update={"markers": {**seen.frame.markers, name: shifted}}))


@pytest.mark.parametrize("cameras", [2, 3, 5])
def test_any_number_of_cameras_out_of_step(make_rig: MakeRig, cameras: int) -> None:
    rig = make_rig(pinhole_cameras(cameras, DISTORTION))
    figures = truth_figures(FusionCore(rig), SLOW, watch(rig, SLOW, 2.5, phase_s=0.0041))
    assert figures.median_mm < (3.0 if cameras == 2 else 2.0)
    assert figures.p95_mm < 7.0
    assert figures.measured > 0.99


def test_rolling_shutters_7_ms_out_of_step(make_rig: MakeRig) -> None:
    rig = make_rig()
    motion = Motion()
    figures = truth_figures(FusionCore(rig), motion, watch(rig, motion, 3.0, readout_s=0.012))
    # Speeds up to 0.4 m/s sideways and 0.16 m/s in depth; taking two frames as simultaneous errs by 12 mm.
    assert figures.median_mm < 4.0
    assert figures.p95_mm < 9.0
    assert figures.lateral_mm < 1.5
    assert figures.lag_ms < 2.0
    # A set for every frame of either camera.
    assert figures.sets >= 350


def test_taking_frames_as_simultaneous_would_be_far_worse(make_rig: MakeRig) -> None:
    rig = make_rig()
    motion = Motion()
    honest = watch(rig, motion, 2.0)
    lied = [delayed(one, -7_000_000) if one.frame.camera == "right" else one for one in honest]
    good, bad = (truth_figures(FusionCore(rig), motion, seen) for seen in (honest, lied))
    assert bad.median_mm > 3.0 * good.median_mm


def test_cameras_in_step_give_one_set_a_pair(make_rig: MakeRig) -> None:
    rig = make_rig()
    sets = run(FusionCore(rig), watch(rig, SLOW, 1.0, phase_s=0.0))
    assert 59 <= len(sets) <= 61
    assert [points.seq for points in sets] == list(range(len(sets)))


def test_set_times_increase_and_are_observation_times(make_rig: MakeRig) -> None:
    rig = make_rig()
    sets = run(FusionCore(rig), watch(rig, SLOW, 1.0))
    assert all(before.t_ns < after.t_ns for before, after in pairwise(sets))


def test_still_marker_is_quiet_and_true(make_rig: MakeRig) -> None:
    rig = make_rig()
    sets = run(FusionCore(rig), watch(rig, STILL, 3.0, noise_px=0.15))[120:]
    track = np.array([place(points, "index") for points in sets]) * 1e3
    truth = STILL.at(0.0)[0, MARKERS.index("index")] * 1e3
    assert np.abs(track.mean(axis=0) - truth).max() < 1.0
    assert track.std(axis=0)[:2].max() < 0.3
    assert track.std(axis=0)[2] < 2.0


@pytest.mark.parametrize(("method", "low_m", "high_m"), [("triangulate", 0.004, 0.010), ("filter", 0.003, 0.009)])
def test_sigma_matches_the_error(make_rig: MakeRig, method: str, low_m: float, high_m: float) -> None:
    rig = make_rig(fusion=f'method = "{method}"')
    points = run(FusionCore(rig), watch(rig, STILL, 2.0, noise_px=0.3, phase_s=0.0))[-1].points["index"]
    assert points.views == 2
    # 0.3 px at 530 px of focal length, 75 mm of baseline, 0.8 m: 6.8 mm in depth before filtering. The filter averages
    # over all of the past; what remains is mostly that nobody has calibrated the cameras.
    assert low_m < points.sigma < high_m


@pytest.mark.parametrize(("method", "growth"), [("triangulate", 2.0), ("filter", 1.3)])
def test_marker_lost_by_one_camera_is_bridged_along_its_ray(make_rig: MakeRig, method: str, growth: float) -> None:
    rig = make_rig(fusion=f'method = "{method}"')
    core = FusionCore(rig)
    seen = watch(rig, SLOW, 1.4)
    sets = run(
        core,
        (without(one, "index") if one.frame.camera == "right" and 1.0 < one.arrival_s < 1.15 else one for one in seen),
    )
    bridged = [points for points in sets if 1.03e9 < points.t_ns - EPOCH_NS < 1.15e9]
    assert bridged
    for points in bridged:
        point = points.points["index"]
        assert point.state == ("one_view" if method == "filter" else "predicted")
        assert point.views <= 1
        truth = SLOW.at((points.t_ns - EPOCH_NS) * 1e-9)[0, 1]
        error = (np.array(point.position) - truth) * 1e3
        assert np.hypot(*error[:2]) < 6.0
        assert np.linalg.norm(error) < 20.0
        assert points.points["thumb"].state == "measured"
    sigmas = [points.points["index"].sigma for points in bridged]
    # The filter knows the speed in depth; the shape of the fingertip, 3 mm, is in all of it.
    assert sigmas[-1] > growth * sigmas[0]
    after = [points for points in sets if points.t_ns - EPOCH_NS > 1.25e9]
    assert all(points.points["index"].state == "measured" for points in after)


def test_marker_lost_entirely_is_held_then_absent(make_rig: MakeRig) -> None:
    rig = make_rig(fusion="hold_s = 0.2")
    seen = [without(one, "index") if one.arrival_s > 1.0 else one for one in watch(rig, STILL, 2.0)]
    held = absent = 0
    for points in run(FusionCore(rig), seen):
        t_s = (points.t_ns - EPOCH_NS) * 1e-9
        if 1.03 < t_s < 1.18:
            held += 1
            assert points.points["index"].state == "predicted"
        elif t_s > 1.25:
            absent += 1
            assert "index" not in points.points
            assert "thumb" in points.points
    assert min(held, absent) > 5


def test_glitches_of_hundreds_of_pixels_leave_no_trace(make_rig: MakeRig) -> None:
    rig = make_rig()
    rng = np.random.default_rng(11)
    clean = watch(rig, SLOW, 3.0)
    glitched = [
        moved(one, "index", float(rng.choice([-200, 150])), 60.0)
        if rng.random() < 0.08 and one.arrival_s > 0.5
        else one
        for one in clean
    ]
    figures = truth_figures(FusionCore(rig), SLOW, glitched)
    assert figures.median_mm < 3.0
    assert figures.p95_mm < 12.0


def test_real_jump_is_accepted_once_it_repeats(make_rig: MakeRig) -> None:
    rig = make_rig()
    # 60 px in both pictures: 90 mm to the side within one frame, beyond what the gate lets through.
    seen = [moved(one, "index", 60.0) if one.arrival_s > 1.0 else one for one in watch(rig, STILL, 1.6, phase_s=0.0)]
    sets = run(FusionCore(rig), seen)
    target = STILL.at(0.0)[0, 1] + np.array([60.0 / 530.3 * 0.8, 0.0, 0.0])
    # The marker is absent until it is accepted again.
    at = {round((points.t_ns - EPOCH_NS) * 1e-6): place(points, "index") for points in sets if "index" in points.points}
    times = sorted(at)
    first = next(t for t in times if t > 1000)
    assert np.linalg.norm(at[first] - STILL.at(0.0)[0, 1]) < 0.03
    assert np.linalg.norm(at[times[-1]] - target) < 0.01
    late = [t for t in times if t > 1000 + 200]
    assert np.linalg.norm(at[late[0]] - target) < 0.02
    assert any(b - a > 30 for a, b in pairwise(times))


def test_swapped_cameras_are_rejected_and_named(make_rig: MakeRig) -> None:
    for method in ("triangulate", "disparity"):
        rig = make_rig(fusion=f'method = "{method}"')
        other = {"left": "right", "right": "left"}
        core = FusionCore(rig)
        swapped = [
            replace(one, frame=one.frame.model_copy(update={"camera": other[one.frame.camera]}))
            for one in watch(rig, STILL, 1.0)
        ]
        assert all(not points.points for points in run(core, swapped))
        assert core.counts["behind_cameras"] > 50
        assert "left and right are probably swapped" in core.problem


def test_drift_of_a_mount_is_estimated_and_reported(make_rig: MakeRig) -> None:
    rig = make_rig()
    core = FusionCore(rig)
    seen = watch(rig, SLOW, 4.0)
    for name in MARKERS:
        seen = [moved(one, name, 0.0, 6.0) if one.frame.camera == "right" else one for one in seen]
    figures = truth_figures(core, SLOW, seen)
    assert figures.measured > 0.98
    assert core.epipolar_px[0] < 0.6
    # The uncorrected 6 px would put points 4.5 mm too low.
    assert figures.median_mm < 4.0
    assert core.problem == ""


def test_points_outside_the_volume_are_not_published(make_rig: MakeRig) -> None:
    rig = make_rig(fusion="volume_m = [[-0.8, -0.6, 0.9], [0.8, 0.6, 1.4]]")
    core = FusionCore(rig)
    assert all(not points.points for points in run(core, watch(rig, STILL, 0.5)))
    assert core.counts["gated"] > 100


def test_settings_change_while_running(make_rig: MakeRig) -> None:
    rig = make_rig()
    core = FusionCore(rig)
    seen = watch(rig, STILL, 2.0)
    half = len(seen) // 2
    before = run(core, seen[:half])[-1]
    core.configure(FusionConfig(hold_s=1.0))
    after = run(core, seen[half:])
    assert np.linalg.norm(place(after[0], "index") - place(before, "index")) < 0.005
    core.configure(FusionConfig(method="disparity"))
    again = run(core, [delayed(one, 2_100_000_000) for one in seen[:60]])
    assert again[-1].points["index"].position[2] == pytest.approx(0.8, abs=0.05)


def test_rejected_settings_leave_the_old_ones(make_rig: MakeRig) -> None:
    rig = make_rig(places={"left": 0.0, "right": 0.0})
    core = FusionCore(rig)
    with pytest.raises(ConfigError):
        core.configure(FusionConfig(method="disparity"))
    run(core, watch(make_rig(places={"left": 0.0, "right": 0.0}), STILL, 0.2))


def test_one_camera_is_not_enough(make_rig: MakeRig) -> None:
    with pytest.raises(ConfigError, match="at least two cameras"):
        FusionCore(make_rig(places={"left": 0.0}))


def test_patch_has_corners_in_space(make_rig: MakeRig) -> None:
    rig = make_rig()
    seen = []
    for one in watch(rig, STILL, 1.0, noise_px=0.0):
        base = one.frame.markers["base"]
        half_u, half_v = 0.02 * 530.3 / 0.82, 0.015 * 530.3 / 0.82
        corners = tuple((base.u + a * half_u, base.v + b * half_v) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)))
        markers = {**one.frame.markers, "base": base.model_copy(update={"corners": corners})}
        seen.append(replace(one, frame=one.frame.model_copy(update={"markers": markers})))
    points = run(FusionCore(rig), seen)[-1]
    assert points.points["thumb"].corners is None
    quad = points.points["base"].corners
    assert quad is not None
    sides = np.linalg.norm(np.diff(np.array([*quad, quad[0]]), axis=0), axis=1)
    np.testing.assert_allclose(sides, [0.04, 0.03, 0.04, 0.03], atol=0.002)


def test_restarted_stream_is_followed(make_rig: MakeRig) -> None:
    rig = make_rig()
    core = FusionCore(rig)
    seen = watch(rig, STILL, 0.6)
    later = [delayed(one, 10**13) for one in seen]
    assert run(core, later)[-1].points
    again = run(core, seen)
    assert again[-1].points
    assert again[-1].t_ns < later[0].frame.t_ns
    assert core.counts["restarts"] == 1


numbers = st.one_of(st.floats(-1e5, 1e5, allow_nan=False), st.sampled_from([0.0, 1e5, -1e5, 320.0, 639.49]))
markers = st.builds(
    Marker,
    u=numbers,
    v=numbers,
    area=st.floats(0.0, 1e9),
    score=st.floats(0.0, 1.0),
    t_ns=st.one_of(st.none(), st.integers(0, (1 << 62) - 1)),
    corners=st.one_of(st.none(), st.tuples(*[st.tuples(numbers, numbers)] * 4)),
)
frames = st.builds(
    MarkerFrame,
    t_ns=st.one_of(
        st.integers(0, (1 << 62) - 1), st.integers(EPOCH_NS, EPOCH_NS + 10**9), st.sampled_from([0, 1, (1 << 62) - 1])
    ),
    camera=st.sampled_from(["left", "right", "middle"]),
    width=st.sampled_from([640, 1, 65536]),
    height=st.just(480),
    markers=st.dictionaries(st.sampled_from([*MARKERS, "nose"]), markers, max_size=7),
)


@settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(frames, max_size=20))
def test_valid_but_absurd_frames_never_break_the_stage(make_rig: MakeRig, absurd: list[MarkerFrame]) -> None:
    core = FusionCore(make_rig())
    for frame in absurd:
        for _, points in core.feed(frame):
            assert isinstance(points, PointSet)
            assert all(np.isfinite(point.position).all() for point in points.points.values())


def test_absurd_frames_leave_the_points_untouched(make_rig: MakeRig) -> None:
    rig = make_rig()
    seen = watch(rig, SLOW, 1.5)
    clean = run(FusionCore(rig), seen)
    rng = np.random.default_rng(12)
    core = FusionCore(rig)
    mixed = []
    for one in seen:
        mixed.append(one)
        frame = one.frame
        bad = [
            frame.model_copy(update={"t_ns": frame.t_ns + 3600 * 10**9}),
            frame.model_copy(update={"t_ns": 5}),
            frame.model_copy(update={"camera": "nobody"}),
            frame.model_copy(update={"width": 1280}),
            frame,
        ]
        mixed.append(Seen(one.arrival_s, bad[int(rng.integers(len(bad)))]))
    dirty = run(core, mixed)
    assert len(dirty) == len(clean)
    for a, b in zip(clean, dirty, strict=True):
        assert a.points == b.points
    refused = sum(core.counts[reason] for reason in ("wrong_time", "unknown_camera", "wrong_size", "duplicate"))
    assert refused == len(seen)


def test_what_a_lens_cannot_have_shown_counts_for_nothing(make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = make_rig()
    seen = watch(rig, SLOW, 1.5)
    wrong = seen[40::10]
    without_it = run(FusionCore(rig), [without(one, "index") if one in wrong else one for one in seen])
    core, undistort = FusionCore(rig), CameraModel.undistort
    published = []
    for one in seen:
        place_of_index = [name for name in MARKERS if name in one.frame.markers].index("index")

        def outside(model: CameraModel, pixels: FloatArray, row: int = place_of_index) -> FloatArray:
            xy = undistort(model, pixels)
            xy[row] = np.nan
            return xy

        monkeypatch.setattr(CameraModel, "undistort", outside if one in wrong else undistort)
        published += run(core, [one])
    assert core.counts["outside"] == len(wrong)
    assert [points.points for points in published] == [points.points for points in without_it]


def test_a_method_that_nobody_brings_is_named_with_what_to_do(make_rig: MakeRig) -> None:
    with pytest.raises(ConfigError, match=r'\[fusion\] method = "magic".*pip install ./bench'):
        FusionCore(make_rig(fusion='method = "magic"'))


def test_options_of_older_rig_files_reach_the_method(make_rig: MakeRig) -> None:
    rig = make_rig(fusion='method = "triangulate"\none_euro = "pixels"\nbeta = 3.0')
    assert rig.config.fusion.options == {"one_euro": "pixels", "beta": 3.0}
    FusionCore(rig)
    with pytest.raises(ConfigError, match=r"\[fusion.options\]: extrapolation"):
        FusionCore(make_rig(fusion='method = "triangulate"\n[fusion.options]\nextrapolation = 7.0'))
