"""The evaluation tells known errors exactly: whoever quotes a figure leans on it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import FINGERS
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion, rotation_z
from rhot.messages import ServiceStatus
from rhot.rig import HandFile, MarkerConfig
from rhot_sim.comparison.accuracy import coverage, object_errors, point_errors
from rhot_sim.comparison.collect import Collected, HandSample, ObjectSample, PointsSample
from rhot_sim.comparison.figures import service_figures, spread, tracking_figures, window
from rhot_sim.rendering.coverage import MarkerView
from rhot_sim.world.world import World

START_NS = 1_790_000_000_000_000_000
TIMES_S = np.arange(0.0, 4.0, 1.0 / 60.0)


@pytest.fixture(scope="module")
def world() -> World:
    markers = {finger: MarkerConfig(joint=f"{finger}_tip") for finger in FINGERS}
    return World(3, {"right": HandModel.from_file(HandFile(), "right")}, markers, ("cube",))


def t_ns(t_s: float) -> int:
    return START_NS + round(t_s * 1e9)


def collected(world: World, shift_m: tuple[float, float, float], age_s: float) -> Collected:
    """A run in which everything is off by the same vector and equally old on arrival."""
    truth, shift = world.sample(TIMES_S), np.array(shift_m)
    run = Collected()
    for row, t in enumerate(TIMES_S.tolist()):
        joints = (truth.joints["right"].positions[row] + shift).astype(np.float32)
        run.hands.setdefault("right", []).append(HandSample(t_ns(t), age_s, "right", joints, (True,) * 5))
        x, y, z = (truth.markers["index"][row] + shift).tolist()
        run.points.append(PointsSample(t_ns(t), age_s, {"index": (x, y, z)}, ("thumb",)))
        T = truth.objects["cube"][row]
        px, py, pz = (T[:3, 3] + shift).tolist()
        qx, qy, qz, qw = quaternion_from_rotation(T[:3, :3] @ rotation_z(np.radians(2.0))).tolist()
        run.objects.setdefault("cube", []).append(ObjectSample(t_ns(t), age_s, (px, py, pz), (qx, qy, qz, qw), True))
    return run


def test_known_errors_come_out_as_they_are(world: World) -> None:
    figures = tracking_figures(world, START_NS, collected(world, (0.003, 0.0, 0.004), 0.017), 1.0, 3.0)
    for name in ("fingertip_error_mm", "joint_error_mm", "point_error_mm", "object_error_mm"):
        assert figures[name]["median"] == pytest.approx(5.0, abs=1e-3), name
        assert figures[name]["p95"] == pytest.approx(5.0, abs=1e-3), name
    assert figures["point_error_mm"]["per_marker"]["index"]["bias_xyz"] == pytest.approx([3.0, 0.0, 4.0], abs=1e-3)
    assert figures["object_error_deg"]["median"] == pytest.approx(2.0, abs=1e-3)
    assert figures["latency_ms"]["p50"] == pytest.approx(17.0)
    assert figures["latency_ms"]["p99"] == pytest.approx(17.0)
    assert figures["rate_hz"] == pytest.approx(60.0, rel=0.02)
    assert figures["fingers_measured"] == 1.0
    assert figures["largest_gap_ms"] == pytest.approx(1e3 / 60.0, abs=0.01)


def test_without_a_hand_there_are_no_figures_rather_than_good_ones(world: World) -> None:
    figures = tracking_figures(world, START_NS, Collected(), 1.0, 3.0)
    assert figures["fingertip_error_mm"].get("median") is None
    assert figures["rate_hz"] == 0.0
    assert "latency_ms" not in figures


def test_predicted_points_and_objects_do_not_count_as_measured(world: World) -> None:
    run = collected(world, (0.0, 0.0, 0.0), 0.0)
    assert set(point_errors(world, START_NS, run.points)) == {"index"}
    held = [
        ObjectSample(sample.t_ns, 0.0, (9.0, 9.0, 9.0), sample.orientation, False) for sample in run.objects["cube"]
    ]
    assert object_errors(world, START_NS, {"cube": held}) == {}


class Camera:
    """Sees the index always, the thumb never, the ring only now and then."""

    def at(self, t_s: float) -> dict[str, MarkerView]:
        def view(share: float) -> MarkerView:
            return MarkerView(1.0, 1.0, 50.0, share, inside=True)

        return {"index": view(0.5), "thumb": view(0.1), "ring": view(0.5 if t_s < 2.0 else 0.0)}


def test_coverage_counts_what_two_cameras_see_and_what_was_measured_of_it(world: World) -> None:
    run = collected(world, (0.0, 0.0, 0.0), 0.0)
    times = np.arange(1.0, 3.0, 0.1)
    cameras = {"left": Camera(), "right": Camera()}
    found = coverage(cameras, times, run.points, TIMES_S, 60.0)  # type: ignore[arg-type]
    assert found.samples == 20 + 10, "the index in all moments, the ring in half of them, the thumb never"
    assert found.by_marker == {"index": 1.0, "ring": 0.0}
    assert found.measured == pytest.approx(20 / 30)
    late = coverage(cameras, times, run.points, TIMES_S + 10.0, 60.0)  # type: ignore[arg-type]
    assert late.measured == 0.0


@given(st.floats(0.0, 3.5), st.floats(0.0, 1.0))
def test_a_window_holds_what_lies_in_it(from_s: float, length_s: float) -> None:
    samples = [PointsSample(t_ns(t), 0.0, {}, ()) for t in TIMES_S.tolist()]
    low, high = t_ns(from_s), t_ns(from_s + length_s)
    chosen = window(samples, START_NS, from_s, from_s + length_s)
    assert [sample.t_ns for sample in chosen] == [sample.t_ns for sample in samples if low <= sample.t_ns < high]


def test_spread_ignores_what_is_not_there() -> None:
    assert spread(np.array([np.nan, 1.0, 3.0]), 1e3) == {"median": 2000.0, "p95": 2900.0, "max": 3000.0}
    assert spread(np.array([np.nan]), 1.0) == {}


def test_counts_are_those_since_the_steady_state_began() -> None:
    def status(late: int) -> dict[str, ServiceStatus]:
        counts = {"dropped_late": late, "missed": 3}
        return {
            "capture/left": ServiceStatus(t_ns=1, service="capture", instance="left", state="running", counts=counts)
        }

    figures = service_figures(status(4), status(6))
    assert figures["dropped_late"] == 2
    assert figures["services"]["capture/left"]["counts"]["missed"] == 0


@given(st.integers(0, 2**32 - 1))
def test_quaternions_and_rotations_invert_each_other(seed: int) -> None:
    xyzw = np.random.default_rng(seed).normal(size=(5, 4))
    xyzw /= np.linalg.norm(xyzw, axis=1, keepdims=True)
    R = rotation_from_quaternion(xyzw)
    again = quaternion_from_rotation(R)
    assert np.allclose(np.abs((xyzw * again).sum(axis=1)), 1.0)
    assert np.allclose(R @ np.swapaxes(R, -1, -2), np.eye(3))
