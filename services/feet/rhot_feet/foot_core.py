"""The core of the feet service: computes poses of the feet from images, inertial samples and poses of the head.

It reads no clock. `process` does all work of an image at once. A service that must not block calls its three parts:
`predict` and `update` access the filters and are fast; `detect` accesses only the image and may run on another thread.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_dictionary
from rhot.core import Output
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot.messages import FootPose, HeadPose, Side
from rhot.messages.base import wire_position, wire_quaternion
from rhot.plugins import load_plugin
from rhot.rig.feet_config import FeetConfig
from rhot_feet.depth.tracker import DepthObservations, DepthTracker
from rhot_feet.filter.foot_filter import FootFilter
from rhot_feet.filter.kinematic import unseen_error_m
from rhot_feet.filter.model import FootFilterSettings, FootState
from rhot_feet.frames import DepthFrame
from rhot_feet.head_track import HeadTrack
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.marker.tracker import FootMarker, MarkerTracker
from rhot_feet.prediction import OTHER_FOOT, FootPrediction
from rhot_feet.preview import HEAD_ROTATION_RAD, FootDetections, View

_MEASURED_M: Final = 0.06
"""Largest sigma of a position in state `measured`."""
_MODEL_ERROR_M: Final = 0.01
"""Error of the inertial filter beyond its covariance, and its growth per second unseen, because tilt and bias are not
white noise; added to the gates.
"""

RIG_FRAME: Final = "rig"


class _Filter(Protocol):
    def add_imu_samples(self, samples: ImuSamples) -> None: ...

    def update_marker(
        self,
        t_ns: int,
        position: FloatArray,
        covariance: FloatArray,
        orientation_xyzw: FloatArray | None = None,
        orientation_covariance: FloatArray | None = None,
    ) -> bool: ...

    def update_depth(self, t_ns: int, position: FloatArray, covariance: FloatArray) -> bool: ...

    def state(self, t_ns: int) -> FootState | None: ...


@dataclass(slots=True)
class _Foot:
    filter: _Filter
    imu_ns: int = 0
    confirmed_ns: int = 0
    contradicted_ns: int | None = None
    lost: bool = True


class FootCore:
    """Follows all feet of a rig."""

    def __init__(self, config: FeetConfig, T_head_camera: FloatArray | None = None) -> None:
        """Prepare.

        Args:
            config: `[feet]` of the rig.
            T_head_camera: (4, 4), see `rhot.rig.Rig.T_head_camera`; as `config` says when not given.

        Raises:
            ConfigError: the dictionary is unknown, or has no such marker.
        """
        camera = config.camera
        depth_range_m = (camera.min_depth_m, camera.max_depth_m)
        up = np.array(config.up) / np.linalg.norm(config.up)
        self._up = up
        self._T_head_camera = camera.T_head_camera if T_head_camera is None else T_head_camera
        self._hold_ns = round(1e9 * config.hold_s)
        self._predict_ns = round(1e9 * config.predict_s)
        self._heads = HeadTrack()
        ids: dict[Side, int] = {side: foot.marker_id for side, foot in config.feet.items()}
        self._markers = MarkerTracker(marker_dictionary(config.dictionary), ids, config.marker_size_m, depth_range_m)
        self._blobs = DepthTracker(depth_range_m)
        self._feet: dict[Side, _Foot] = {
            side: _Foot(_filter(config, foot.ankle_m)) for side, foot in config.feet.items()
        }
        self._newest_ns = 0
        self._pictures = 0
        self._counts: Counter[str] = Counter(frames=0, no_head=0)

    @property
    def counts(self) -> Mapping[str, int]:
        """What happened to pictures: `frames`, those without a head's pose, refusals by foot, stage and reason."""
        return self._counts

    def add_head_pose(self, pose: HeadPose) -> None:
        """Add a pose of the head."""
        self._heads.add(pose)

    def awaits_head(self, t_ns: int) -> bool:
        """Return whether a picture of a moment had better wait for the head's pose, which is still on its way."""
        return self._heads.awaits(t_ns)

    def add_imu_samples(self, side: Side, samples: ImuSamples) -> None:
        """Add inertial samples of a foot, later than those before."""
        if not len(samples):
            return
        foot = self._feet[side]
        foot.filter.add_imu_samples(samples)
        foot.imu_ns = int(samples.t_ns[-1])
        self._newest_ns = max(self._newest_ns, foot.imu_ns)

    def process(self, frame: DepthFrame) -> FootDetections | None:
        """Detect the feet in a picture and update them; None when it is not known where the head was."""
        view = self.predict(frame)
        if view is None:
            return None
        detections = self.detect(view)
        self.update(detections)
        return detections

    def predict(self, frame: DepthFrame) -> View | None:
        """Predict where the feet are in a picture; None when it is not known where the head was."""
        self._counts["frames"] += 1
        T_rig_head = self._heads.at(frame.t_ns)
        if T_rig_head is None:
            self._counts["no_head"] += 1
            return None
        T_rig_camera = T_rig_head @ self._T_head_camera
        predicted = {side: self._prediction(foot, frame.t_ns, T_rig_camera) for side, foot in self._feet.items()}
        return View(frame, T_rig_camera, {side: foot for side, foot in predicted.items() if foot is not None})

    def detect(self, view: View) -> FootDetections:
        """Find the feet in a picture; pictures come here one after the other, in order of time."""
        up_camera = view.T_rig_camera[:3, :3].T @ self._up
        floor = self._blobs.find_floor(view.frame, up_camera, view.T_rig_camera)
        markers = self._markers.detect(view.frame, view.expected, up_camera, floor)
        seen: dict[Side, FootPrediction] = {}
        for side, marker in markers.markers.items():
            known = view.expected.get(side)
            # The offset to the blob is kept in the foot's axes, which the filter knows better than one picture.
            R = known.R_camera_foot if known is not None else None
            if R is None and marker.orientation_known:
                R = marker.R_camera_foot
            if R is not None:
                seen[side] = FootPrediction(marker.position, marker.covariance[3:, 3:], R)
        hidden = {side: foot for side, foot in view.expected.items() if side not in markers.markers}
        self._pictures += 1
        # The blob models are updated in one of this many images that show a marker.
        update_models = self._pictures % 4 == 0
        if not (hidden or update_models):
            return FootDetections(view, markers, DepthObservations({}, {}, None))
        return FootDetections(
            view, markers, self._blobs.detect(view.frame, hidden, seen, up_camera, update_models=update_models)
        )

    def update(self, detections: FootDetections) -> None:
        """Update the filters with what was detected in a picture."""
        view, t_ns = detections.view, detections.view.frame.t_ns
        self._newest_ns = max(self._newest_ns, t_ns)
        for side, foot in self._feet.items():
            accepted = False
            marker, blob = detections.markers.markers.get(side), detections.blobs.feet.get(side)
            if marker is not None:
                accepted = _update_marker(foot.filter, marker, view)
                self._count(side, "marker", "" if accepted else "gate")
            elif blob is not None:
                position = view.in_rig(blob.position)
                accepted = foot.filter.update_depth(
                    t_ns, position, view.covariance_in_rig(blob.position, blob.covariance)
                )
                self._count(side, "depth", "" if accepted else "gate")
            for stage, refused in (("marker", detections.markers.refused), ("depth", detections.blobs.refused)):
                if side in refused:
                    self._count(side, stage, refused[side])
            # The other one's marker where this foot is expected, again and again: its blob was taken for this one's.
            swapped = marker is None and detections.markers.refused.get(OTHER_FOOT[side]) == "other"
            elsewhere = detections.markers.refused.get(side) == "motion"
            self._note_contradiction(foot, t_ns, accepted=accepted and not swapped, contradicted=elsewhere or swapped)

    def due_ns(self, now_ns: int) -> int:
        """Return the time for which poses are due: of the newest measurement, plus the configured prediction."""
        # Without new measurements, poses are published for the present time minus this.
        return max(self._newest_ns, now_ns - 60_000_000) + self._predict_ns

    def poses(self, t_ns: int) -> list[Output]:
        """Return every foot that is known at a moment, with its key."""
        outputs: list[Output] = []
        for side, foot in self._feet.items():
            state = foot.filter.state(t_ns)
            if state is None:
                continue
            confirmed = state.stage in ("marker", "depth") or (state.stage == "inertial" and state.stationary)
            confirmed &= state.sigma_m <= _MEASURED_M
            if confirmed:
                foot.confirmed_ns = max(foot.confirmed_ns, t_ns)
            # Time after its last sample for which a sensor counts as working.
            has_sensor = t_ns - foot.imu_ns <= 250_000_000
            # A foot with a larger sigma is searched in the whole image and not
            # published; the second applies while its sensor works.
            lost_m = 0.2 if has_sensor else 0.5
            foot.lost = t_ns - max(foot.confirmed_ns, state.measured_ns) > self._hold_ns or state.sigma_m > lost_m
            # Largest sigma at which it is published while its sensor works; without one, as for `measured`.
            published_m = 0.1 if has_sensor else _MEASURED_M
            if not (foot.lost or state.sigma_m > published_m):
                outputs.append((f"rhot/foot/{side}", _message(side, state, confirmed=confirmed)))
        return outputs

    def _prediction(self, foot: _Foot, t_ns: int, T_rig_camera: FloatArray) -> FootPrediction | None:
        state = None if foot.lost or self._is_contradicted(foot, t_ns) else foot.filter.state(t_ns)
        if state is None:
            return None
        R = T_rig_camera[:3, :3].T
        position = R @ (state.position - T_rig_camera[:3, 3])
        unseen_s = max(0.0, 1e-9 * (t_ns - state.measured_ns))
        if isinstance(foot.filter, FootFilter) and foot.filter.aligned:
            error_m = _MODEL_ERROR_M + 0.1 * min(unseen_s, 1.0)
        elif state.followed:
            # Its covariance allows for the drift.
            error_m = _MODEL_ERROR_M
        else:
            error_m = unseen_error_m(unseen_s)
        covariance = R @ state.covariance @ R.T + error_m**2 * np.eye(3)
        rotation_covariance = R @ state.orientation_covariance @ R.T
        # Largest sigma of an orientation that counts as observed.
        if np.trace(rotation_covariance) > math.radians(120.0) ** 2:
            return FootPrediction(position, covariance)
        return FootPrediction(
            position, covariance, R @ rotation_from_quaternion(state.orientation_xyzw), rotation_covariance
        )

    def _is_contradicted(self, foot: _Foot, t_ns: int) -> bool:
        # If markers are rejected by the prediction for this long, the prediction is discarded.
        return foot.contradicted_ns is not None and t_ns - foot.contradicted_ns > 0.75 * 1e9

    def _note_contradiction(self, foot: _Foot, t_ns: int, *, accepted: bool, contradicted: bool) -> None:
        """Note since when a foot's marker is seen where it is not expected, and nothing confirms the prediction."""
        if accepted:
            foot.contradicted_ns, foot.lost = None, False
        elif contradicted and foot.contradicted_ns is None:
            foot.contradicted_ns = t_ns

    def _count(self, side: Side, stage: str, refusal: str) -> None:
        self._counts[f"{side}_{stage}" + (f"_{refusal}" if refusal else "")] += 1


def _filter(config: FeetConfig, ankle_m: tuple[float, float, float]) -> _Filter:
    settings = FootFilterSettings(up=config.up, sensor_m=ankle_m)
    if config.method == "filter":
        return FootFilter(settings)
    other: _Filter = load_plugin("rhot.foot_filters", config.method, f"[feet] method = {config.method!r}", "bench")(
        settings
    )
    return other


def _update_marker(target: _Filter, marker: FootMarker, view: View) -> bool:
    """Update a filter with a marker, with its orientation where that is known."""
    T = view.T_rig_camera
    position, covariance = (
        view.in_rig(marker.position),
        view.covariance_in_rig(marker.position, marker.covariance[3:, 3:]),
    )
    if not marker.orientation_known:
        return target.update_marker(marker.t_ns, position, covariance)
    R = T[:3, :3]
    rotation_covariance = R @ marker.covariance[:3, :3] @ R.T + HEAD_ROTATION_RAD**2 * np.eye(3)
    orientation = quaternion_from_rotation(R @ marker.R_camera_foot)
    return target.update_marker(marker.t_ns, position, covariance, orientation, rotation_covariance)


def _message(side: Side, state: FootState, *, confirmed: bool) -> FootPose:
    return FootPose(
        t_ns=state.t_ns,
        side=side,
        frame=RIG_FRAME,
        position=wire_position(state.position),
        orientation=wire_quaternion(state.orientation_xyzw),
        velocity=wire_position(state.velocity),
        sigma=state.sigma_m,
        stage=state.stage,
        stationary=state.stationary,
        state="measured" if confirmed else "predicted",
    )
