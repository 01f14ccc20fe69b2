from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from marker_scenes import SIZE_M, depth_camera, tilted
from numpy.typing import NDArray

from rhot.rotations import rotation_from_vector, vector_from_rotation
from rhot_feet.marker_pose import MarkerPose, marker_poses, square_corners, view_square
from rhot_feet.orientation_track import OrientationCandidate, OrientationTrack
from rhot_feet.pose_choice import OrientationPrior, choose_pose

CAMERA = depth_camera()
Float = NDArray[np.float64]


def poses_of(R: Float, t: Float, seed: int, noise_px: float = 0.3) -> tuple[MarkerPose, ...]:
    corners = CAMERA.project(square_corners(SIZE_M) @ R.T + t)
    corners += np.random.default_rng(seed).normal(0.0, noise_px, (4, 2))
    view = view_square(corners, SIZE_M, CAMERA, noise_px)
    assert view is not None
    return marker_poses(view)


def off(R: Float, pose: MarkerPose) -> float:
    return float(np.degrees(np.linalg.norm(vector_from_rotation(pose.R_camera_marker @ R.T))))


def test_an_expected_orientation_decides_what_corners_leave_open() -> None:
    t = np.array([0.1, 0.0, 1.6])
    alone = right = 0
    for seed in range(30):
        R = tilted(25.0, 0.2 * seed)
        poses = poses_of(R, t, seed)
        expected = OrientationPrior(rotation_from_vector(np.array([0.05, -0.08, 0.03])) @ R, 0.01 * np.eye(3))
        best = min(poses, key=lambda pose: off(R, pose))
        first, second = choose_pose(poses), choose_pose(poses, prior=expected)
        assert first is not None
        assert second is not None
        alone += first.pose is best
        right += second.pose is best
    assert right == 30
    assert alone < 30


def test_a_foot_looks_up() -> None:
    R, t = tilted(40.0, 0.0), np.array([0.0, 0.0, 1.5])
    poses = poses_of(R, t, 1)
    flipped = max(poses, key=lambda pose: off(R, pose))
    # Up lies 90 degrees away from the mirrored normal, on the true one's side.
    up = R[:, 2] - float(R[:, 2] @ flipped.normal) * flipped.normal
    choice = choose_pose(poses, up_camera=up / np.linalg.norm(up))
    assert choice is not None
    assert off(R, choice.pose) < 10.0


def test_no_pose_no_choice_and_one_pose_is_clear() -> None:
    assert choose_pose(()) is None
    choice = choose_pose(poses_of(tilted(40.0, 0.0), np.array([0.0, 0.0, 0.5]), 1)[:1])
    assert choice is not None
    assert choice.clear


def test_a_track_finds_the_right_branch_and_stays_on_it() -> None:
    track, rng = OrientationTrack(), np.random.default_rng(3)
    right = 0
    for number in range(240):
        t_s = number / 60.0
        R = tilted(28.0 + 8.0 * np.sin(2.0 * t_s), 0.5 + 0.3 * np.sin(1.3 * t_s))
        t = np.array([0.25 * np.sin(1.1 * t_s), 0.1 * np.cos(0.9 * t_s), 1.5])
        poses = list(poses_of(R, t, int(rng.integers(1 << 30))))
        rng.shuffle(poses)
        candidates = [OrientationCandidate(p.R_camera_marker, p.covariance[:3, :3], p.cost) for p in poses]
        chosen = poses[track.feed(t_s, candidates)]
        right += number >= 60 and off(R, chosen) == min(off(R, pose) for pose in poses)
    assert right >= 0.97 * 180
    assert track.orientation is not None
    assert np.degrees(np.linalg.norm(vector_from_rotation(track.orientation @ R.T))) < 5.0
    track.reset()
    assert track.orientation is None


def test_recorded_detections(shared_data: Path) -> None:
    recorded_markers = pytest.importorskip("rhot_bench.recorded_markers")
    test = recorded_markers.read_marker_test(shared_data / "aruco" / "d435_qualisys" / "test0.csv").first(2000)
    chosen, known = recorded_markers.choose_solutions(test), test.known
    errors = np.stack([recorded_markers.turns_deg(test.R[known, which], test.R_true[known]) for which in (0, 1)])
    own = np.take_along_axis(errors, chosen[known][None], axis=0)[0]
    assert float((own <= errors.min(axis=0)).mean()) > 0.97
    assert float((errors[0] <= errors[1]).mean()) < 0.85
