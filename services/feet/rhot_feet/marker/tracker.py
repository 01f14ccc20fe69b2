"""The marker stage: from a picture to a believed pose per foot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.aruco_dictionary import R_FOOT_MARKER
from rhot.geometry.camera import CameraModel
from rhot.geometry.covariances import squared_distance
from rhot.geometry.hull import Region
from rhot.geometry.rotations import rotation_between
from rhot.types import Side
from rhot_feet.depth.plane import DepthPlane, FloorPlane, fit_depth_plane
from rhot_feet.frames import DepthFrame
from rhot_feet.marker.detection import MarkerDetection, MarkerFinder
from rhot_feet.marker.orientation_track import OrientationTrack
from rhot_feet.marker.pose import MarkerPose, SquareView, marker_poses, pose_covariance, view_square
from rhot_feet.prediction import GATE_SIGMAS, OTHER_FOOT, FootPrediction, innovation_distance, predicted_region

# Choosing between the two poses of a square: by fit to the picture, by expectation and by plausibility.

CLEAR_MARGIN: Final = 6.0
"""Difference of −2·log-likelihood from which the better pose is believed: odds of 20 to 1."""
_UPRIGHT_RAD: Final = float(np.radians(75.0))
_UPRIGHT_SIGMA_RAD: Final = float(np.radians(10.0))
"""Feet tilt up to about 75° when the heel leaves the floor; beyond that a marker's normal is ever less plausible."""


@dataclass(frozen=True, slots=True)
class OrientationPrior:
    """The predicted orientation of a marker.

    Attributes:
        R_camera_marker: (3, 3).
        covariance: (3, 3) of a rotation about the camera's axes, square radians.
    """

    R_camera_marker: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class PoseChoice:
    """The chosen pose.

    Attributes:
        pose: the likeliest.
        margin: difference of −2·log-likelihood to the other one; infinite when there is none.
    """

    pose: MarkerPose
    margin: float

    @property
    def clear(self) -> bool:
        """Whether the orientation may be believed; the position may in any case, both solutions nearly share it."""
        return self.margin >= CLEAR_MARGIN


def choose_pose(
    poses: Sequence[MarkerPose],
    *,
    prior: OrientationPrior | None = None,
    up_camera: FloatArray | None = None,
) -> PoseChoice | None:
    """Return the likeliest of the poses of one marker; None when there are none.

    Args:
        poses: see `marker_poses`; their costs hold the reprojection errors and the depth's normal.
        prior: expected orientation, from a filter or an inertial sensor.
        up_camera: (3,) unit vector against gravity, camera frame; a foot's marker looks up.
    """
    if not poses:
        return None
    ranked = sorted(
        ((pose.cost + _nis(pose, prior) + _implausibility(pose, up_camera), pose) for pose in poses),
        key=lambda scored: scored[0],
    )
    margin = ranked[1][0] - ranked[0][0] if len(ranked) > 1 else float("inf")
    return PoseChoice(ranked[0][1], margin)


def _nis(pose: MarkerPose, prior: OrientationPrior | None) -> float:
    if prior is None:
        return 0.0
    turn = rotation_between(prior.R_camera_marker, pose.R_camera_marker)
    distance = squared_distance(turn, pose.covariance[:3, :3] + prior.covariance)
    # An expectation that is wrong altogether must not outweigh everything that is seen.
    return min(distance, 40.0)


def _implausibility(pose: MarkerPose, up_camera: FloatArray | None) -> float:
    if up_camera is None:
        return 0.0
    tilt = float(np.arccos(np.clip(pose.normal @ up_camera, -1.0, 1.0)))
    return max(0.0, (tilt - _UPRIGHT_RAD) / _UPRIGHT_SIGMA_RAD) ** 2


_BORDER_PX: Final = 3.0
"""Smallest distance of a corner from the image border; closer ones cannot be refined."""

# Gates that a detected marker has to pass before it is used.
#
# A misread square moves a foot by metres; rejecting a marker only loses one frame.

Refusal = Literal["border", "shape", "size", "depth", "tilt", "floor", "other", "motion", "turn"]


def refuse_detection(detection: MarkerDetection, camera: CameraModel) -> Refusal | None:
    """Return why a detection is rejected by its corners alone; None if it is not."""
    corners = detection.corners
    highest = np.array([camera.width, camera.height]) - 1.0 - _BORDER_PX
    if (corners < _BORDER_PX).any() or (corners > highest).any():
        return "border"
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    # Largest ratio of the longest to the shortest side.
    return "shape" if sides.max() > 5.0 * sides.min() else None


def refuse_pose(
    pose: MarkerPose,
    view: SquareView,
    detection: MarkerDetection,
    plane: DepthPlane | None,
    depth_range_m: tuple[float, float],
    up_camera: FloatArray | None,
    floor: FloorPlane | None,
    expected: FootPrediction | None,
    other: FootPrediction | None,
    prior: OrientationPrior | None,
) -> Refusal | None:
    """Return why a marker is rejected; None if it is accepted.

    Args:
        pose: the chosen pose.
        view: the poses from the corners alone, for comparison with the depth.
        detection: the detected marker.
        plane: fitted to the depths inside the marker, if there are any.
        depth_range_m: smallest and largest plausible distance.
        up_camera: (3,) unit vector against gravity, camera frame, if known.
        floor: the floor, if known.
        expected: the filter's prediction, if there is one.
        other: prediction of the other foot, if there is one.
        prior: the predicted orientation, if known.
    """
    position = pose.t_camera_marker
    wrong: dict[Refusal, bool] = {
        "size": not depth_range_m[0] <= float(position[2]) <= depth_range_m[1],
        # Largest reprojection error of the corners, as a share of the side.
        "shape": view.reprojection_px > max(1.0, 0.04 * detection.side_px),
        "depth": plane is not None and not _depth_agrees(view, plane),
        # Largest angle between its normal and up.
        "tilt": up_camera is not None and float(pose.normal @ up_camera) < np.cos(float(np.radians(100.0))),
        # Smallest height above the floor; excludes printed markers that lie on the floor.
        "floor": floor is not None and float(floor.heights_m(position)) < 0.025,
        "other": other is not None and _is_nearer(position, other, expected),
        "motion": expected is not None
        and innovation_distance(position, pose.covariance[3:, 3:], expected) > GATE_SIGMAS,
        "turn": prior is not None and _is_rotated(pose, prior),
    }
    return next((reason for reason, holds in wrong.items() if holds), None)


def _is_rotated(pose: MarkerPose, prior: OrientationPrior) -> bool:
    turn = rotation_between(prior.R_camera_marker, pose.R_camera_marker)
    sigmas = math.sqrt(squared_distance(turn, pose.covariance[:3, :3] + prior.covariance))
    # A marker is rejected if its orientation differs from the foot's by more
    # than both of these.
    return float(np.linalg.norm(turn)) > (float(np.radians(45.0))) and sigmas > 5.0


def _is_nearer(position: FloatArray, other: FootPrediction, own: FootPrediction | None) -> bool:
    """Return whether a position (3,) coincides with the other foot, and is closer to it than to the own foot."""
    to_other = float(np.linalg.norm(position - other.position))
    # Smallest distance from the other foot's marker; a closer one is misread, or is on the other foot.
    return to_other < 0.06 and (own is None or to_other < float(np.linalg.norm(position - own.position)))


def _depth_agrees(view: SquareView, plane: DepthPlane) -> bool:
    x, y, z = view.t[0]
    xy = np.array([x / z, y / z])
    sigma = float(np.hypot(np.sqrt(pose_covariance(view)[0, 5, 5]), plane.depth_sigma_m(xy)))
    # Largest difference between the depth image and the distance from the marker's
    # size, as a share of the distance plus a number of standard deviations; a printout at 97 % differs by as
    # much.
    return abs(plane.depth_m(xy) - float(z)) <= 4.0 * sigma + 0.04 * float(z)


_CONFIRM_GAP_S: Final = 0.15
_CONFIRM_STEP_M: Final = 0.03
_CONFIRM_SPEED_M_S: Final = 6.0
"""Between two of these pictures: the longest time, and the longest way, which grows with the time at the speed of a
swinging foot. Chosen."""
_FORGET_S: Final = 0.5
"""After so long without its marker a foot's own orientation track starts over."""


@dataclass(frozen=True, slots=True)
class FootMarker:
    """A foot's marker in one picture, believed.

    Attributes:
        t_ns: middle of the picture's exposure, rig clock.
        position: (3,) centre of the marker, the foot's origin, metres, camera frame.
        R_camera_foot: (3, 3), see `rhot.messages.FootPose`.
        covariance: (6, 6) of (δ, τ): a rotation about the camera's axes, radians, then the position, metres.
        orientation_known: the two poses of the square could be told apart; else only the position is worth anything.
        corners: (4, 2) pixels.
        with_depth: the depth image took part.
    """

    t_ns: int
    position: FloatArray
    R_camera_foot: FloatArray
    covariance: FloatArray
    orientation_known: bool
    corners: FloatArray
    with_depth: bool


@dataclass(frozen=True, slots=True)
class MarkerObservations:
    """What the marker stage made of one picture.

    Attributes:
        markers: foot to its believed marker.
        refused: foot to the reason why a detection was not believed.
        found: all detections, believed or not.
    """

    markers: dict[Side, FootMarker]
    refused: dict[Side, Refusal]
    found: tuple[MarkerDetection, ...] = ()


@dataclass(frozen=True, slots=True)
class _Candidate:
    choice: PoseChoice
    poses: tuple[MarkerPose, ...]
    detection: MarkerDetection
    plane: DepthPlane | None


@dataclass(slots=True)
class _Memory:
    """What is remembered of one foot between pictures: its orientation track, and sightings on the way to belief."""

    track: OrientationTrack
    seen_ns: int = -(1 << 62)
    streak: int = 0
    streak_ns: int = 0
    streak_position: FloatArray | None = None


class MarkerTracker:
    """Finds both feet's markers, near the expected positions first, and believes what passes the gates."""

    def __init__(
        self,
        dictionary: cv2.aruco.Dictionary,
        marker_ids: Mapping[Side, int],
        size_m: float,
        depth_range_m: tuple[float, float],
    ) -> None:
        """Prepare.

        Args:
            dictionary: see `rhot.aruco_dictionary.marker_dictionary`.
            marker_ids: foot to the number of its marker.
            size_m: side of a marker's black square.
            depth_range_m: nearest and farthest believable depth.
        """
        self._finder = MarkerFinder(dictionary, list(marker_ids.values()))
        self._ids = dict(marker_ids)
        self._size_m = size_m
        self._depth_range_m = depth_range_m
        self._whole_ns = -(1 << 62)
        self._memory: dict[Side, _Memory] = {side: _Memory(OrientationTrack()) for side in marker_ids}

    def detect(
        self,
        frame: DepthFrame,
        expected: Mapping[Side, FootPrediction],
        up_camera: FloatArray | None = None,
        floor: FloorPlane | None = None,
    ) -> MarkerObservations:
        """Take one picture.

        Args:
            frame: the picture with its depth; later than the one before.
            expected: foot to what the filter predicts for the picture's time; a foot that is absent is searched
                everywhere and believed only after several sightings.
            up_camera: (3,) unit vector against gravity, camera frame, where the head's pose is known.
            floor: in this picture, see `DepthTracker.find_floor`; a marker that lies on it is nobody's.
        """
        found = self._search(frame, expected)
        markers: dict[Side, FootMarker] = {}
        refused: dict[Side, Refusal] = {}
        for side, marker_id in self._ids.items():
            memory = self._memory[side]
            if 1e-9 * (frame.t_ns - memory.seen_ns) > _FORGET_S:
                memory.track.reset()
            best: _Candidate | None = None
            for detection in found:
                if detection.marker_id != marker_id:
                    continue
                outcome = self._examine(frame, detection, side, expected, up_camera, floor)
                if isinstance(outcome, str):
                    refused[side] = outcome
                elif best is None or self._closer(outcome, best, expected.get(side)):
                    best = outcome
            if best is None or not self._confirmed(frame.t_ns, best, memory, side in expected):
                continue
            refused.pop(side, None)
            markers[side] = self._marker(frame.t_ns, best, memory, expected.get(side))
            memory.seen_ns = frame.t_ns
        return MarkerObservations(markers, refused, tuple(found))

    def _search(self, frame: DepthFrame, expected: Mapping[Side, FootPrediction]) -> list[MarkerDetection]:
        """Return the markers near the expected positions; everywhere, now and then, for a foot that is not expected."""
        regions: list[Region] = []
        # While one foot is expected and the other is not, the whole picture is searched this often.
        if not expected or (len(expected) < len(self._ids) and frame.t_ns - self._whole_ns >= 40_000_000):
            self._whole_ns = frame.t_ns
            return self._finder.find(frame.color)
        for side in expected:
            region = predicted_region(expected[side], self._size_m, frame.camera)
            if region is not None:
                regions.append(region)
        if len(regions) == 2 and regions[0].overlaps(regions[1]):
            regions = [regions[0].joined(regions[1])]
        # A region that covers more of the picture than this is no quicker to search than the whole.
        if sum(region.area for region in regions) > 0.5 * frame.camera.width * frame.camera.height:
            return self._finder.find(frame.color)
        return [detection for region in regions for detection in self._finder.find(frame.color, region)]

    def _examine(
        self,
        frame: DepthFrame,
        detection: MarkerDetection,
        side: Side,
        expected: Mapping[Side, FootPrediction],
        up_camera: FloatArray | None,
        floor: FloorPlane | None,
    ) -> _Candidate | Refusal:
        reason = refuse_detection(detection, frame.camera)
        if reason is not None:
            return reason
        plane = None
        if frame.depth_mm is not None:
            plane = fit_depth_plane(frame.depth_mm, detection.corners, frame.camera, self._depth_range_m)
        view = view_square(detection.corners, self._size_m, frame.camera, detection.corner_sigma_px)
        if view is None:
            return "shape"
        poses = marker_poses(view, plane)
        prior = _prior(expected.get(side))
        choice = choose_pose(poses, prior=prior, up_camera=up_camera)
        if choice is None:
            return "shape"
        reason = refuse_pose(
            choice.pose,
            view,
            detection,
            plane,
            self._depth_range_m,
            up_camera,
            floor,
            expected.get(side),
            expected.get(OTHER_FOOT[side]),
            prior,
        )
        return reason or _Candidate(choice, poses, detection, plane)

    def _closer(self, candidate: _Candidate, other: _Candidate, expected: FootPrediction | None) -> bool:
        if expected is None:
            return candidate.detection.likeness > other.detection.likeness
        distances = [
            float(np.linalg.norm(each.choice.pose.t_camera_marker - expected.position)) for each in (candidate, other)
        ]
        return distances[0] < distances[1]

    def _confirmed(self, t_ns: int, candidate: _Candidate, memory: _Memory, is_expected: bool) -> bool:
        """Return whether a marker was seen often enough to be believed: at once where it was expected."""
        position = candidate.choice.pose.t_camera_marker
        gap_s = 1e-9 * (t_ns - memory.streak_ns)
        previous = memory.streak_position
        continues = (
            previous is not None
            and gap_s <= _CONFIRM_GAP_S
            and float(np.linalg.norm(position - previous)) <= _CONFIRM_STEP_M + _CONFIRM_SPEED_M_S * gap_s
        )
        memory.streak = memory.streak + 1 if continues else 1
        memory.streak_ns, memory.streak_position = t_ns, position
        # Pictures in which a marker that nobody expects has to be seen before it is believed.
        return is_expected or memory.streak >= 3

    def _marker(self, t_ns: int, candidate: _Candidate, memory: _Memory, expected: FootPrediction | None) -> FootMarker:
        pose, clear = candidate.choice.pose, candidate.choice.clear
        if _prior(expected) is None:
            # The filter does not know the orientation: the marker's own past decides.
            pose = candidate.poses[memory.track.update(1e-9 * t_ns, candidate.poses)]
            clear = memory.track.is_clear(pose.t_camera_marker)
        return FootMarker(
            t_ns,
            pose.t_camera_marker,
            pose.R_camera_marker @ R_FOOT_MARKER.T,
            pose.covariance,
            clear,
            candidate.detection.corners,
            candidate.plane is not None,
        )


def _prior(expected: FootPrediction | None) -> OrientationPrior | None:
    if expected is None or expected.R_camera_foot is None or expected.orientation_covariance is None:
        return None
    return OrientationPrior(expected.R_camera_foot @ R_FOOT_MARKER, expected.orientation_covariance)
