"""The core of the feet service on pictures of a standing person: what comes out, and when it stops coming."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from still_feet import FEET, head, picture, positions, standing_samples

from rhot.messages import FootPose, Side
from rhot_feet.depth.plane import FloorPlane
from rhot_feet.depth.tracker import DepthObservations, FootDepth
from rhot_feet.foot_core import FootCore
from rhot_feet.frames import DepthFrame
from rhot_feet.marker.tracker import MarkerObservations, MarkerTracker
from rhot_feet.prediction import FootPrediction
from rhot_feet.preview import FootDetections

START_NS = 1_700_000_000_000_000_000
FRAME_NS = 33_000_000


def ns(t_s: float) -> int:
    return START_NS + round(1e9 * t_s)


def see(stage: FootCore, first: int, count: int, shift_m: NDArray[np.float64] | None = None) -> int:
    """Show pictures with the head's poses around them; return the time of the last."""
    t_ns = START_NS
    for k in range(first, first + count):
        t_ns = START_NS + k * FRAME_NS
        for late_ns in (-5_000_000, 5_000_000):
            stage.add_head_pose(head(t_ns + late_ns, shift_m))
        stage.process(picture(k, t_ns))
    return t_ns


def poses(stage: FootCore, t_ns: int) -> dict[str, FootPose]:
    return {key: message for key, message in stage.poses(t_ns) if isinstance(message, FootPose)}


def off_mm(pose: FootPose) -> float:
    return 1e3 * float(np.linalg.norm(np.array(pose.position) - positions()[pose.side]))


@pytest.mark.parametrize("method", ["filter", "thesis"])
def test_standing_feet_are_found_where_they_are(method: str) -> None:
    stage = FootCore(FEET.model_copy(update={"method": method}))
    t_ns = see(stage, 0, 20)
    assert stage.due_ns(t_ns + 30_000_000) == t_ns
    found = poses(stage, t_ns)
    assert set(found) == {"rhot/foot/left", "rhot/foot/right"}
    for pose in found.values():
        assert (pose.stage, pose.state, pose.t_ns) == ("marker", "measured", t_ns)
        assert off_mm(pose) < 4.0


def test_pictures_without_a_head_are_counted_and_not_used() -> None:
    stage = FootCore(FEET)
    stage.process(picture(0, START_NS))
    assert (stage.counts["frames"], stage.counts["no_head"]) == (1, 1)
    assert poses(stage, START_NS) == {}


def test_an_unseen_foot_without_a_sensor_is_soon_gone() -> None:
    stage = FootCore(FEET)
    last_ns = see(stage, 0, 12)
    soon = poses(stage, last_ns + 50_000_000)["rhot/foot/right"]
    assert soon.state == "measured"
    assert soon.sigma > 0.01, "it may have set off, and that is said"
    assert poses(stage, last_ns + 150_000_000) == {}
    assert poses(stage, last_ns + 3_100_000_000) == {}


def test_a_sensor_that_feels_its_foot_stand_keeps_it_measured() -> None:
    stage = FootCore(FEET)
    for k in range(30):
        see(stage, k, 1)
        stage.add_imu_samples("left", standing_samples(START_NS + k * FRAME_NS - 30_000_000, 3))
    last_ns = START_NS + 29 * FRAME_NS
    stage.add_imu_samples("left", standing_samples(last_ns, 400))
    late = poses(stage, last_ns + 3_990_000_000)
    assert set(late) == {"rhot/foot/left"}
    pose = late["rhot/foot/left"]
    assert (pose.stage, pose.state, pose.stationary) == ("inertial", "measured", True)
    assert off_mm(pose) < 5.0


def test_a_foot_whose_sensor_is_shaken_is_not_held_where_it_was() -> None:
    stage = FootCore(FEET)
    for k in range(12):
        see(stage, k, 1)
        stage.add_imu_samples("left", standing_samples(START_NS + k * FRAME_NS - 30_000_000, 3))
    last_ns = START_NS + 11 * FRAME_NS
    rest = standing_samples(last_ns, 25)
    stage.add_imu_samples("left", replace(rest, specific_force=rest.specific_force + np.array([30.0, 0.0, 0.0])))
    soon, later = poses(stage, last_ns + 95_000_000), poses(stage, last_ns + 170_000_000)
    assert (soon["rhot/foot/left"].stage, soon["rhot/foot/left"].state) == ("marker", "predicted")
    assert "rhot/foot/left" not in later


def test_markers_are_detected_with_the_floor_known(monkeypatch: pytest.MonkeyPatch) -> None:
    floors: list[FloorPlane | None] = []
    detect = MarkerTracker.detect

    def noted(
        self: MarkerTracker,
        frame: DepthFrame,
        expected: Mapping[Side, FootPrediction],
        up_camera: NDArray[np.float64] | None = None,
        floor: FloorPlane | None = None,
    ) -> MarkerObservations:
        floors.append(floor)
        return detect(self, frame, expected, up_camera, floor)

    monkeypatch.setattr(MarkerTracker, "detect", noted)
    see(FootCore(FEET), 0, 4)
    assert floors and all(floor is not None for floor in floors)


def test_feet_are_found_again_where_nobody_expected_them() -> None:
    stage = FootCore(FEET)
    see(stage, 0, 12)
    shift_m = np.array([0.0, 0.0, 1.0])
    # A gap, as when a headset finds itself elsewhere: between the two positions nothing is known.
    t_ns = see(stage, 20, 45, shift_m)
    for pose in poses(stage, t_ns).values():
        assert 1e3 * np.linalg.norm(np.array(pose.position) - positions()[pose.side] - shift_m) < 10.0
    assert len(poses(stage, t_ns)) == 2


def test_a_foot_found_by_depth_where_the_others_marker_is_seen_is_given_up() -> None:
    """The blob of the right foot was taken for the left one, whose marker is not in sight."""
    stage = FootCore(FEET)
    t_ns = see(stage, 0, 12)
    for k in range(40):
        stage.add_head_pose(head(t_ns + k * FRAME_NS))
        stage.add_head_pose(head(t_ns + k * FRAME_NS + 1))
        view = stage.predict(picture(12 + k, t_ns + k * FRAME_NS))
        assert view is not None
        if "left" not in view.expected:
            break
        position, covariance = view.expected["left"].position, 1e-4 * np.eye(3)
        blobs = DepthObservations({"left": FootDepth(view.frame.t_ns, position, covariance, 300)}, {}, None)
        stage.update(FootDetections(view, MarkerObservations({}, {"right": "other"}), blobs))
    assert 0.7 < 1e-9 * k * FRAME_NS < 0.9


def test_poses_go_on_a_little_behind_now_when_nothing_is_measured() -> None:
    stage = FootCore(FEET.model_copy(update={"predict_s": 0.02}))
    t_ns = see(stage, 0, 12)
    assert stage.due_ns(t_ns) == t_ns + 20_000_000
    assert stage.due_ns(t_ns + 500_000_000) == t_ns + 460_000_000
