from __future__ import annotations

import numpy as np
from marker_scenes import SIZE_M, depth_camera, tilted
from numpy.typing import NDArray

from rhot.geometry.rotations import rotation_from_vector, vector_from_rotation
from rhot_feet.marker.orientation_track import OrientationTrack
from rhot_feet.marker.pose import MarkerPose, marker_poses, square_corners, view_square
from rhot_feet.marker.tracker import OrientationPrior, choose_pose

CAMERA = depth_camera()
Float = NDArray[np.float64]


def poses_of(R: Float, t: Float, seed: int, noise_px: float = 0.3) -> tuple[MarkerPose, ...]:
    corners = CAMERA.project(square_corners(SIZE_M) @ R.T + t)
    corners += np.random.default_rng(seed).normal(0.0, noise_px, (4, 2))
    view = view_square(corners, SIZE_M, CAMERA, noise_px)
    assert view is not None
    return marker_poses(view)


def off(R: Float, pose: MarkerPose) -> float:
    return off_deg(R, pose.R_camera_marker)


def off_deg(R: Float, other: Float) -> float:
    return float(np.degrees(np.linalg.norm(vector_from_rotation(other @ R.T))))


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
        chosen = poses[track.update(t_s, poses)]
        right += number >= 60 and off(R, chosen) == min(off(R, pose) for pose in poses)
    assert right >= 0.97 * 180
    assert track.orientation is not None
    assert off_deg(R, track.orientation) < 5.0
    track.reset()
    assert track.orientation is None


def test_several_hypotheses_outvote_the_likeliest() -> None:
    t, near = np.array([0.0, 0.0, 1.5]), 1e-4 * np.eye(6)
    alone, first, second = tilted(30.0, 0.0), tilted(-30.0, 0.2), tilted(-30.0, -0.2)
    track = OrientationTrack()
    believed = track.update(
        0.0, [MarkerPose(R, t, near, cost) for R, cost in ((alone, 0.0), (first, 0.4), (second, 0.4))]
    )
    assert believed == 0
    assert track.orientation is not None
    assert off_deg(track.orientation, alone) < 1e-6
    assert track.nearest(np.stack([alone, tilted(-30.0, 0.0)])) == 1
    track.reset()
    assert track.nearest(np.stack([first, alone])) == 0
