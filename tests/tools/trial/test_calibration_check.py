from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from marker_streams import Motion, calibration, make_rig, pinhole_cameras, watch

from rhot.errors import CalibrationError
from rhot.geometry.rotations import rotation_from_vector
from rhot.messages import MarkerFrame
from rhot.quality import epipolar_limit_px, figures_with_units, pair_epipolar_p95_px
from rhot.rig import CameraCalibration, Rig
from rhot.rig.cameras import camera_models
from rhot_sim.rig.calibration import simulated_rig_calibration
from rhot_tools.trial.calibration_check import CalibrationReport, judge_calibration
from rhot_tools.trial.epipolar_residuals import PixelTrack, TrackGatherer, fit_linear, interpolate

Angles = tuple[float, float, float]


def turned(camera: CameraCalibration, degrees: Angles) -> CameraCalibration:
    """Return a camera that was turned by pitch, yaw and roll about its own axes."""
    T = np.array(camera.T_rig_camera)
    T[:3, :3] = T[:3, :3] @ rotation_from_vector(np.radians(np.array(degrees)))
    return calibration(np.array(camera.K), np.array(camera.distortion), T)


def seen_by(cameras: dict[str, CameraCalibration], duration_s: float, noise_px: float = 0.3) -> list[MarkerFrame]:
    """Return frames at 60 Hz, the cameras 7 ms out of step, rows read out over 12 ms."""
    with tempfile.TemporaryDirectory() as folder:
        rig = make_rig(Path(folder), cameras)
    seen = watch(rig, Motion(), duration_s, noise_px=noise_px, readout_s=0.012)
    return [one.frame for one in seen]


def judged(
    frames: list[MarkerFrame], cameras: dict[str, CameraCalibration], quality: object = None
) -> CalibrationReport:
    models = camera_models(cameras)
    gatherer = TrackGatherer(models)
    gatherer.add(frames)
    return judge_calibration(gatherer.tracks(), models, gatherer.periods_s(), quality)


def check(count: int, who: str, degrees: Angles, seed: int = 1, duration_s: float = 3.0) -> CalibrationReport:
    """Judge a simulated rig with a calibration's own errors after one camera was turned."""
    with tempfile.TemporaryDirectory() as folder:
        rig = make_rig(Path(folder), places={f"c{index}": 0.075 * index for index in range(count)})
    simulated = simulated_rig_calibration(rig.config.cameras, seed)
    true = dict(simulated.truth.cameras)
    return judged(seen_by({**true, who: turned(true[who], degrees)}, duration_s), dict(simulated.found.cameras))


@pytest.mark.parametrize("seed", [1, 2])
def test_cameras_that_stood_still_are_good(seed: int) -> None:
    for count in (2, 4):
        report = check(count, "c1", (0.0, 0.0, 0.0), seed)
        assert report.verdict == "good"
        assert report.moved == ""
        # What a calibration's own errors leave: measured 0 to 0.05 px.
        assert max(pair.systematic_px for pair in report.pairs) < 0.15


@pytest.mark.parametrize(
    ("degrees", "verdict"),
    [
        ((0.1, 0.0, 0.0), "drifting"),
        ((0.2, 0.0, 0.0), "bumped"),
        ((-1.0, 0.0, 0.0), "bumped"),
        ((0.0, 0.0, 0.5), "bumped"),
        ((0.0, 0.0, -1.0), "bumped"),
        # Along the epipolar lines: two cameras cannot tell.
        ((0.0, 0.5, 0.0), "good"),
    ],
)
def test_a_rotation_of_one_of_two_cameras_is_measured(degrees: Angles, verdict: str) -> None:
    (pair,) = (report := check(2, "c1", degrees)).pairs
    assert (report.verdict, report.moved) == (verdict, "")
    assert pair.rotation.observed == (True, False, True)
    for axis in (0, 2):
        assert pair.rotation.degrees[axis] == pytest.approx(degrees[axis], abs=2.5 * pair.rotation.sd_degrees[axis])
    assert pair.rotation.sd_degrees[0] < 0.05
    assert pair.rotation.sd_degrees[2] < 0.2


@pytest.mark.parametrize(
    ("who", "degrees"), [("c0", (0.2, 0.0, 0.0)), ("c1", (0.0, 0.2, 0.0)), ("c3", (0.0, 0.0, 0.6))]
)
def test_of_four_cameras_the_one_that_moved_is_named(who: str, degrees: Angles) -> None:
    report = check(4, who, degrees, duration_s=2.5)
    assert report.verdict == "bumped"
    assert report.moved == who
    assert report.moved_rotation is not None
    np.testing.assert_allclose(report.moved_rotation.degrees, degrees, atol=0.15)


def test_two_moved_cameras_of_four_are_not_one() -> None:
    cameras = pinhole_cameras(4)
    moved = {
        **cameras,
        "camera1": turned(cameras["camera1"], (0.3, 0.0, 0.0)),
        "camera2": turned(cameras["camera2"], (-0.3, 0.0, 0.0)),
    }
    report = judged(seen_by(moved, 3.0), cameras)
    assert report.verdict == "bumped"
    assert report.moved == ""


def test_the_moment_of_a_bump_is_found() -> None:
    cameras = pinhole_cameras(2)
    before = seen_by(cameras, 9.0)
    after = seen_by({**cameras, "camera1": turned(cameras["camera1"], (0.2, 0.0, 0.0))}, 9.0)
    moment_ns = before[0].t_ns + 5_500_000_000
    frames = [f for f in before if f.t_ns < moment_ns] + [f for f in after if f.t_ns >= moment_ns]
    (pair,) = (report := judged(frames, cameras)).pairs
    assert report.verdict == "bumped"
    assert pair.change is not None
    assert pair.change.sudden
    assert pair.change.t_s == pytest.approx(5.5, abs=1.0)
    assert pair.change.step_px == pytest.approx(1.85, abs=0.2)
    assert pair.thirds_px[1] - pair.thirds_px[0] == pytest.approx(1.85, abs=0.3)
    (still,) = judged(before, cameras).pairs
    assert still.change is not None
    assert still.change.step_px < 0.15


def test_wrong_markers_do_not_make_a_bump() -> None:
    cameras = pinhole_cameras(2)
    rng = np.random.default_rng(1)
    frames = []
    for frame in seen_by(cameras, 4.0):
        markers = dict(frame.markers)
        if rng.random() < 0.2 and "thumb" in markers:
            markers["thumb"] = markers["thumb"].model_copy(update={"v": float(rng.uniform(0, 479))})
        frames.append(frame.model_copy(update={"markers": markers}))
    (pair,) = (report := judged(frames, cameras)).pairs
    assert report.verdict == "good"
    assert pair.rms_px > 5.0


def test_a_poor_calibration_is_held_to_its_own_figure() -> None:
    cameras = pinhole_cameras(2)
    frames = seen_by({**cameras, "camera1": turned(cameras["camera1"], (0.15, 0.0, 0.0))}, 3.0)
    assert judged(frames, cameras).verdict == "bumped"
    quality = {"pairs": {"camera0-camera1": {"epipolar_p95_px": 2.0}}}
    report = judged(frames, cameras, quality)
    assert report.verdict == "good"
    assert report.pairs[0].limit_px == pytest.approx(6.0)


def test_cameras_without_common_views_are_rejected() -> None:
    cameras = pinhole_cameras(2)
    frames = [frame for frame in seen_by(cameras, 2.0) if frame.camera == "camera0"]
    with pytest.raises(CalibrationError, match="no two cameras saw the same markers"):
        judged(frames, cameras)


def test_interpolation_leaves_out_gaps_and_bends() -> None:
    t = np.linspace(0.0, 0.9, 10)
    track = PixelTrack(np.delete(t, 5), np.column_stack([np.delete(2.0 * t, 5), np.zeros(9)]))
    moments = np.array([-0.01, 0.25, 0.45, 0.6, 0.95])
    xy, valid = interpolate(track, moments, 0.15, 1e-3)
    np.testing.assert_array_equal(valid, [False, True, False, True, False])
    np.testing.assert_allclose(xy[valid, 0], 2.0 * moments[valid])
    bent = PixelTrack(t, np.column_stack([np.where(t > 0.45, 1.0, 0.0), np.zeros(10)]))
    assert interpolate(bent, np.array([0.15, 0.45]), 0.15, 1e-3)[1].tolist() == [True, False]


def test_a_fit_knows_that_residuals_of_one_second_are_alike() -> None:
    rng = np.random.default_rng(3)
    t = np.arange(3000) / 60.0
    errors = []
    for _ in range(60):
        bias = np.repeat(rng.normal(0.0, 0.5, 50), 60)
        fit = fit_linear(np.ones((3000, 1)), bias + rng.normal(0.0, 0.2, 3000), t, np.array([10.0]))
        errors.append(fit.values[0] / fit.sd[0])
    assert np.mean(np.abs(errors) < 2.0) > 0.85


def test_half_a_second_of_data_is_not_significant() -> None:
    rng = np.random.default_rng(4)
    t = np.linspace(0.0, 0.5, 60)
    fit = fit_linear(np.ones((60, 1)), rng.normal(0.0, 0.5, 60), t, np.array([10.0]))
    assert fit.sd[0] == pytest.approx(0.5 / np.sqrt(60), rel=0.4)


@pytest.mark.parametrize("quality", [None, 3, {}, {"pairs": 1}, {"pairs": {"a-b": 2}}, {"pairs": {"a-b": {}}}])
def test_a_quality_record_without_pairs_says_nothing(quality: object) -> None:
    assert pair_epipolar_p95_px(quality, "a", "b") is None
    assert epipolar_limit_px(None) == 1.0


def test_figures_of_a_record() -> None:
    quality = {"pairs": {"b-a": {"epipolar_p95_px": 0.5}}, "rms_px": 0.2, "board": "9x6", "used": 3, "ok_px": True}
    assert pair_epipolar_p95_px(quality, "a", "b") == 0.5
    assert epipolar_limit_px(0.5) == 1.5
    assert figures_with_units(quality) == {"rms_px": 0.2}


def test_fusion_reports_its_correction(make_rig: Callable[..., Rig]) -> None:
    from rhot_fusion.core import FusionCore

    cameras = pinhole_cameras(2)
    for degrees, low, high in (((0.0, 0.0, 0.0), 0.0, 0.2), ((0.2, 0.0, 0.0), 1.5, 2.1)):
        core = FusionCore(make_rig(cameras))
        assert core.figures["epipolar_correction_px"] == 0.0
        for frame in seen_by({**cameras, "camera1": turned(cameras["camera1"], degrees)}, 2.5):
            core.feed(frame)
        assert low <= core.figures["epipolar_correction_px"] <= high
