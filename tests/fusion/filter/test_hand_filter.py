"""The filter's parts on synthetic truth with known noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from hands.pinholes import CAMERAS, FOCAL_PX

from rhot.arrays import FloatArray
from rhot_fusion.filter.initialisation import View, from_views, on_ray
from rhot_fusion.filter.joint import JointFilter
from rhot_fusion.filter.motion import motion_of
from rhot_fusion.filter.smoothing.smoother import Event, Node, RecordedFrame, smooth
from rhot_fusion.filter.state import ROUND, Innovation, Views
from rhot_fusion.filter.systematic import CALIBRATION_DOUBT, CameraNoise, Systematic, stated_px
from rhot_fusion.filter.tracks import CALIBRATED, GATE

COUNT = 6
SHAPE = np.random.default_rng(3).uniform(-0.06, 0.06, (COUNT, 3))


def truth(t_s: float) -> FloatArray:
    """A hand that never stops: it swings by 8 cm at 1.2 Hz, 6 m/s² at most, its markers a little on their own."""
    swing = 0.08 * np.sin(2.0 * np.pi * 1.2 * t_s + np.array([0.0, 0.5, 1.0]))
    own = 0.01 * np.sin(2.0 * np.pi * 2.0 * t_s + np.arange(COUNT))[:, None]
    place: FloatArray = np.array([0.04, 0.0, 0.8]) + SHAPE + swing + own
    return place


@dataclass(frozen=True)
class Run:
    """What a filter made of a stream, frame by frame: errors (N, 6, 3), m, their covariances, and frames to smooth."""

    t_s: FloatArray
    error: FloatArray
    covariance: FloatArray
    frames: list[RecordedFrame]


def run(
    noise_px: float,
    rate_hz: float,
    seconds: float = 3.0,
    seed: int = 0,
    path: Callable[[float], FloatArray] = truth,
    far: float = CALIBRATED.inflation_gate,
) -> Run:
    """Two cameras 0.4 of a period out of step, rows 3 ms apart, through a filter that begins at the truth."""
    rng = np.random.default_rng(seed)
    hand = JointFilter(COUNT, GATE)
    start = np.diag([1e-6] * 3 + [0.25] * 3)
    index, delta = np.arange(COUNT), np.linspace(-0.003, 0.003, COUNT)
    variance = np.tile(ROUND * (noise_px / FOCAL_PX) ** 2, (COUNT, 1))
    times, errors, covariances, frames = [], [], [], []
    moments = sorted((n / rate_hz + 0.4 * c / rate_hz, c) for n in range(int(seconds * rate_hz)) for c in (0, 1))
    for number, (t_s, c) in enumerate(moments):
        seen = np.array([path(t_s + d)[k] for k, d in enumerate(delta)])
        local = CAMERAS[c].to_camera(seen)
        xy = local[:, :2] / local[:, 2:] + rng.normal(0.0, noise_px / FOCAL_PX, (COUNT, 2))
        views = Views(CAMERAS[c], index, delta, xy, variance, np.zeros(COUNT), np.full(COUNT, far))
        events = []
        if number == 0:
            for marker in range(COUNT):
                mean = np.concatenate([path(t_s)[marker], np.zeros(3)])
                hand.begin(marker, mean, start, t_s)
                first = from_views([View(CAMERAS[c], t_s, xy[marker], variance[0, 0])] * 1, t_s, np.zeros(3), 0.5)
                assert first is None, "one ray is no place"
                ray = on_ray(View(CAMERAS[c], t_s, xy[marker], variance[0, 0]), mean[:3], 0.0, 0.001, np.zeros(3), 0.5)
                events.append(Event(t_s, marker, ray))
        else:
            hand.step(t_s, views)
        frames.append(RecordedFrame(t_s, c, views, np.ones(COUNT, dtype=bool), events, xy, np.zeros(COUNT)))
        P = hand.state.covariance.reshape(2, COUNT, 3, 2, COUNT, 3)[0][index, :, 0][index, :, index]
        times.append(t_s)
        errors.append(hand.position - path(t_s))
        covariances.append(P)
    return Run(np.array(times), np.array(errors), np.array(covariances), frames)


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    distance2: FloatArray = np.einsum("...i,...ij,...j->...", error, np.linalg.inv(covariance), error)
    return distance2


@pytest.mark.parametrize(("rate_hz", "median_mm", "p95_mm"), [(120.0, 1.2, 3.5), (60.0, 2.0, 5.0), (30.0, 4.5, 12.0)])
def test_a_moving_hand_before_cameras_out_of_step(rate_hz: float, median_mm: float, p95_mm: float) -> None:
    done = run(0.1, rate_hz)
    size = 1e3 * np.linalg.norm(done.error[done.t_s > 0.5], axis=2)
    assert np.median(size) < median_mm
    assert np.percentile(size, 95) < p95_mm
    inside = nees(done.error, done.covariance)[done.t_s > 0.5] < 8.02
    assert 0.88 < inside.mean() <= 1.0, "within two sigma"


def test_looking_back_is_better_than_looking_ahead() -> None:
    done = run(0.1, 30.0)
    nodes: list[Node] = smooth(done.frames, COUNT, CALIBRATED, lambda frames, _: [frame.views for frame in frames])
    late = done.t_s > 0.5
    back = np.array([node.position - truth(node.t_s) for node in nodes])[late]
    assert np.median(np.linalg.norm(back, axis=2)) < 0.7 * np.median(np.linalg.norm(done.error[late], axis=2))
    assert np.percentile(np.linalg.norm(back, axis=2), 95) < 4e-3
    inside = nees(back, np.array([node.covariance[:, :3, :3] for node in nodes])[late]) < 8.02
    assert inside.mean() > 0.85


def test_a_hidden_marker_goes_with_its_hand() -> None:
    hand = JointFilter(COUNT, GATE)
    for marker in range(COUNT):
        mean = np.concatenate([truth(0.0)[marker], [0.5, 0.0, 0.0]])
        hand.begin(marker, mean, np.diag([1e-8] * 3 + [0.01] * 3), 0.0)
    variance = np.tile(ROUND * (0.1 / FOCAL_PX) ** 2, (COUNT - 1, 1))
    index = np.arange(1, COUNT)
    for number in range(1, 25):
        t_s = number / 120.0
        # All stop at once: marker 0 is not seen and stops with the others.
        local = CAMERAS[number % 2].to_camera(truth(0.0)[1:] + np.array([0.5, 0.0, 0.0]) * min(t_s, 0.05))
        views = Views(
            CAMERAS[number % 2], index, np.zeros(5), local[:, :2] / local[:, 2:], variance, np.zeros(COUNT - 1)
        )
        hand.step(t_s, views)
    assert np.linalg.norm(hand.position[0] - truth(0.0)[0] - [0.025, 0.0, 0.0]) < 0.03
    assert np.linalg.norm(hand.velocity[0]) < 0.2


def test_an_outlier_is_rejected_and_does_not_change_the_state() -> None:
    hand = JointFilter(COUNT, GATE)
    for marker in range(COUNT):
        hand.begin(marker, np.concatenate([truth(0.0)[marker], np.zeros(3)]), np.diag([1e-8] * 3 + [1e-4] * 3), 0.0)
    local = CAMERAS[0].to_camera(truth(0.0))
    xy = local[:, :2] / local[:, 2:]
    xy[2] += 30.0 / FOCAL_PX
    variance = np.tile(ROUND * (0.1 / FOCAL_PX) ** 2, (COUNT, 1))
    innovation, _ = hand.step(
        1.0 / 60.0, Views(CAMERAS[0], np.arange(COUNT), np.zeros(COUNT), xy, variance, np.zeros(6))
    )
    assert innovation.accepted.tolist() == [True, True, False, True, True, True]
    assert np.linalg.norm(hand.position - truth(0.0), axis=1).max() < 1e-3


def test_a_covariance_that_rounding_has_eaten_ends_nothing() -> None:
    hand = JointFilter(COUNT, np.inf)
    hand.begin(0, np.array([0.0, 0.0, 0.8, 0.0, 0.0, 0.0]), 1e-6 * np.eye(6), 0.0)
    hand.state = replace(hand.state, P=hand.state.P - 1e-3 * np.eye(len(hand.state.x)))
    before = hand.state.x.copy()
    variance = 1e-9 * ROUND[None]
    hand.step(0.0, Views(CAMERAS[0], np.array([0]), np.zeros(1), np.array([[0.01, 0.0]]), variance, np.zeros(1)))
    np.testing.assert_allclose(hand.state.x, before)


def test_two_views_begin_a_marker_where_it_is() -> None:
    point, velocity = np.array([0.02, -0.03, 0.75]), np.array([0.3, 0.1, 0.0])
    views = []
    for one, t_s in zip(CAMERAS, (0.0, 0.011), strict=True):
        x, y, z = one.to_camera((point + t_s * velocity)[None])[0]
        views.append(View(one, t_s, np.array([x / z, y / z]), (0.1 / FOCAL_PX) ** 2))
    initial = from_views(views, 0.011, np.zeros(3), 0.5)
    assert initial is not None
    error = initial.mean[:3] - point - 0.011 * velocity
    assert float(error @ np.linalg.solve(initial.covariance[:3, :3], error)) < 8.0
    views[1].xy[1] += 5.0 / FOCAL_PX
    off = from_views(views, 0.011, np.zeros(3), 0.01)
    assert off is not None
    assert off.misfit > 16.0


@pytest.mark.parametrize("variance", [1e9, 1e10, 1e11])
def test_an_uninformative_view_does_not_initialise_a_marker(variance: float) -> None:
    views = [
        View(one, 0.002 * k, np.array([0.1 - 0.17 * k, 0.1 + 0.001 * k]), [1e-7, variance][k])
        for k, one in enumerate(CAMERAS)
    ]
    initial = from_views(views, 0.0, np.zeros(3), 0.5)
    assert initial is None or initial.covariance.diagonal().min() > 0.0


def test_noise_and_transition_of_a_motion_compose(monkeypatch: pytest.MonkeyPatch) -> None:
    """Law of every linear motion: two steps are one step of the sum, in mean and in noise."""
    monkeypatch.setattr("rhot_fusion.filter.motion._JOINING_S", np.inf)
    motion = motion_of(SHAPE, np.ones(COUNT, dtype=bool))
    for dt in (0.001, 0.008, 0.05, 0.3):
        F, Q = motion.transition(dt), motion.noise(dt)
        assert np.allclose(F @ F, motion.transition(2.0 * dt), atol=1e-9)
        twice = F @ Q @ F.T + Q
        assert np.allclose(twice, motion.noise(2.0 * dt), rtol=0.05, atol=1e-3 * np.abs(twice).min())


def test_accelerations_are_shared_and_have_a_covariance() -> None:
    Q = motion_of(SHAPE, np.ones(COUNT, dtype=bool)).noise(0.1)
    assert np.allclose(Q, Q.T)
    assert np.linalg.eigvalsh(Q).min() > -1e-12
    velocity = Q[3 * COUNT : 6 * COUNT, 3 * COUNT : 6 * COUNT]
    assert velocity[0, 3] > 0.02 * velocity[0, 0]


def test_a_hand_at_rest_is_averaged_and_a_start_is_followed() -> None:
    rest = run(0.1, 60.0, path=lambda _: truth(0.0))
    late = rest.t_s > 0.8
    assert np.median(np.linalg.norm(rest.error[late], axis=2)) < 1.0e-3
    assert np.sqrt(np.square(np.diff(rest.error[late], axis=0)).sum(axis=2).mean()) < 0.65e-3
    start = run(0.1, 60.0, 1.4, path=lambda t_s: truth(0.0) + _swung(max(t_s - 1.0, 0.0)))
    size = np.linalg.norm(start.error[(start.t_s > 1.0) & (start.t_s < 1.1)], axis=2)
    assert size.max() < 5e-3


def _curled(t_s: float) -> FloatArray:
    """From rest one tip goes by 5 cm in 0.24 s, 4.3 m/s² at most."""
    place = truth(0.0)
    place[2, 1:] += np.array([0.03, 0.04]) * 0.5 * (1.0 - np.cos(np.pi * min(max(t_s - 1.0, 0.0) / 0.24, 1.0)))
    return place


def test_a_finger_that_curls_while_the_others_rest_is_followed() -> None:
    """The hand's scale stays that of rest; a marker that surprises is known to be less certain."""
    errors = []
    for far in (CALIBRATED.inflation_gate, np.inf):
        runs = [run(0.1, 30.0, 1.3, seed, _curled, far) for seed in range(4)]
        during = (runs[0].t_s > 1.0) & (runs[0].t_s < 1.24)
        every = np.stack([np.linalg.norm(one.error[during], axis=2) for one in runs])
        errors.append(np.sqrt(np.square(every[:, :, 2]).mean()))
        assert np.median(np.delete(every, 2, axis=2)) < 1.5e-3, "the others rest"
    assert errors[0] < 5e-3
    assert errors[0] < 0.75 * errors[1]


def test_looking_back_follows_a_finger_that_curls_while_the_others_rest() -> None:
    errors = []
    for far in (CALIBRATED.inflation_gate, np.inf):
        settings = replace(CALIBRATED, inflation_gate=far)
        off = []
        for seed in range(4):
            frames = run(0.1, 30.0, 1.6, seed, _curled).frames
            nodes = smooth(frames, COUNT, settings, lambda same, _: [frame.views for frame in same])
            off += [node.position[2] - _curled(node.t_s)[2] for node in nodes if 1.0 < node.t_s < 1.24]
        errors.append(np.sqrt(np.square(off).sum(axis=1).mean()))
    assert errors[0] < 0.75 * errors[1]


def _swung(t_s: float) -> FloatArray:
    """From rest by 10 cm and back in 0.67 s: 4.4 m/s² within one frame."""
    moved: FloatArray = np.array([0.1, 0.0, 0.05]) * 0.5 * (1.0 - np.cos(3.0 * np.pi * t_s))
    return moved


def test_noise_is_estimated_from_innovations() -> None:
    noise = CameraNoise(CAMERAS, np.zeros(2), calibrated=True)
    rng = np.random.default_rng(1)
    for _ in range(400):
        known = (0.1 / FOCAL_PX) ** 2
        S = np.tile(ROUND * (known + noise.variance(0)), (COUNT, 1))
        y = rng.normal(0.0, np.hypot(0.1, 0.2) / FOCAL_PX, (COUNT, 2))
        nis = (y * y).sum(axis=1) / S[:, 0]
        noise.learn(0, Innovation(y, S, nis, np.ones(COUNT, dtype=bool), np.zeros(6)))
    assert noise.sigma_px[0] == pytest.approx(0.2, abs=0.03)
    assert noise.sigma_px[1] == pytest.approx(0.3)
    quality = {"pairs": {"right-left": {"epipolar_rms_px": 0.2}}}
    assert stated_px(["left", "right"], quality) == pytest.approx([0.1414, 0.1414], abs=1e-3)


def test_views_of_a_reappearing_marker_outweigh_its_prediction() -> None:
    """A marker is 15 px, three sigma, from where it was expected after it had been hidden: its prediction was wrong."""
    errors = []
    for back in (False, True):
        hand = JointFilter(COUNT, GATE)
        for marker in range(COUNT):
            sigma = 0.008 if marker == 0 else 0.0005
            covariance = np.diag([sigma**2] * 3 + [0.01] * 3)
            hand.begin(marker, np.concatenate([truth(0.0)[marker], np.zeros(3)]), covariance, 0.0)
        place = truth(0.0)
        place[0] += [0.0228, 0.0, 0.0]
        variance = np.tile(ROUND * (2.0 / FOCAL_PX) ** 2, (COUNT, 1))
        for number in range(2):
            one = CAMERAS[number % 2]
            local = one.to_camera(place)
            marks = np.full(COUNT, 6.0 if back else np.inf)
            xy = local[:, :2] / local[:, 2:]
            hand.step(
                number / 120.0, Views(one, np.arange(COUNT), np.zeros(COUNT), xy, variance, np.zeros(COUNT), marks)
            )
        errors.append(float(np.linalg.norm(hand.position[0] - place[0])))
    assert errors[1] < 0.6 * errors[0]


def test_the_calibration_s_own_error_is_in_the_covariance() -> None:
    quality = {"expected_error_mm": {"50 cm": {"calibration": 0.5}, "100 cm": {"calibration": 2.0}}}
    stated = Systematic(CAMERAS, quality, 0.1, np.zeros(1))
    sigma_m = np.sqrt(sum(stated.covariance(0, (0.045, 0.0, 1.0))[k] for k in (0, 3, 5)))
    assert sigma_m == pytest.approx(CALIBRATION_DOUBT * 2e-3, rel=0.01)
    derived = Systematic(CAMERAS, None, 0.1, np.zeros(1))
    assert derived.covariance(0, (0.045, 0.0, 1.0))[0] > 0.0
