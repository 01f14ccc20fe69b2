"""The core of the feet service: pictures, inertial samples and the head's poses in, poses of the feet out.

It reads no clock. `frame` does everything with a picture at once; a service that must not stand still meanwhile takes
its three parts apart: `expect` and `take` touch the filters and are quick, `look` touches the picture alone and may run
on a thread of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rhot.aruco_dictionary import marker_dictionary
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot.messages import FootPose, HeadPose, Side
from rhot.messages.vectors import wire_position, wire_quaternion
from rhot.plugins import load_plugin
from rhot.rig.feet_config import FeetConfig
from rhot.stage import Output
from rhot_feet.depth.tracker import DepthSightings, DepthTracker
from rhot_feet.expectation import OTHER_FOOT, FootExpectation
from rhot_feet.filter.filter import FootFilter
from rhot_feet.filter.kinematic import room_m
from rhot_feet.filter.model import FootFilterSettings, FootState
from rhot_feet.frames import DepthFrame
from rhot_feet.head_track import HeadTrack
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.marker.tracker import FootMarker, MarkerTracker
from rhot_feet.view import HEAD_TURN_RAD, Seen, View

FloatArray = NDArray[np.float64]

RIG_FRAME: Final = "rig"
_KNOWN_TURN_RAD: Final = float(np.radians(120.0))
"""A foot whose orientation is worse known than this, root of the sum of variances, was never seen turned any way."""
_VAGUE_M: Final = 0.06
"""A foot whose place is worse known than this is not called measured any more."""
_ASTRAY_M: Final = 0.5
_ASTRAY_FELT_M: Final = 0.2
"""A foot whose place is worse known than this is looked for everywhere, and not published; less is borne with when its
sensor feels it move, for then it cannot have stayed where it was."""
_SHOWN_FELT_M: Final = 0.1
"""Then it is no longer published from here on, though still looked for where it should be."""
_FELT_NS: Final = 250_000_000
"""For so long after its last sample a sensor counts."""
_DOUBT_S: Final = 0.75
"""For so long are markers refused for not being where they are expected before the expectation itself is dropped."""
_ROOM_M: Final = 0.01
_STRAYS: Final = 0.1
"""By how much, and by how much more a second, a foot carried by its sensor is farther off than its filter thinks: tilt
and bias of a sensor are no white noise. The gates leave it that much room."""
_LEARN_EVERY: Final = 4
"""The depth stage need not learn from every picture in which a marker is seen."""
_SILENT_NS: Final = 60_000_000
"""Poses go on as of so long ago when nothing is measured any more."""


class _Filter(Protocol):
    def imu(self, samples: ImuSamples) -> None: ...

    def marker(
        self,
        t_ns: int,
        position: FloatArray,
        covariance: FloatArray,
        orientation_xyzw: FloatArray | None = None,
        orientation_covariance: FloatArray | None = None,
    ) -> bool: ...

    def depth(self, t_ns: int, position: FloatArray, covariance: FloatArray) -> bool: ...

    def state(self, t_ns: int) -> FootState | None: ...


@dataclass(slots=True)
class _Foot:
    filter: _Filter
    felt_ns: int = 0
    backed_ns: int = 0
    doubted_ns: int | None = None
    lost: bool = True


class FootStage:
    """Follows all feet of a rig."""

    def __init__(self, config: FeetConfig) -> None:
        """Prepare.

        Args:
            config: `[feet]` of the rig.

        Raises:
            ConfigError: the dictionary is not known, or has no such marker.
        """
        camera = config.camera
        depth_range_m = (camera.min_depth_m, camera.max_depth_m)
        up = np.array(config.up) / np.linalg.norm(config.up)
        self._up = up
        self._T_head_camera = camera.T_head_camera
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
        self._looks = 0
        self._counts: Counter[str] = Counter(frames=0, no_head=0)

    @property
    def counts(self) -> Mapping[str, int]:
        """What happened to pictures: `frames`, those without a head's pose, refusals by foot, stage and reason."""
        return self._counts

    def head(self, pose: HeadPose) -> None:
        """Take a pose of the head."""
        self._heads.add(pose)

    def awaits_head(self, t_ns: int) -> bool:
        """Tell whether a picture of a moment had better wait for the head's pose, which is still on its way."""
        return self._heads.awaits(t_ns)

    def imu(self, side: Side, samples: ImuSamples) -> None:
        """Take inertial samples of a foot, later than those before."""
        if not len(samples):
            return
        foot = self._feet[side]
        foot.filter.imu(samples)
        foot.felt_ns = int(samples.t_ns[-1])
        self._newest_ns = max(self._newest_ns, foot.felt_ns)

    def frame(self, frame: DepthFrame) -> Seen | None:
        """Take a picture; None when it is not known where the head was."""
        view = self.expect(frame)
        if view is None:
            return None
        seen = self.look(view)
        self.take(seen)
        return seen

    def expect(self, frame: DepthFrame) -> View | None:
        """Return where the feet are expected in a picture; None when it is not known where the head was."""
        self._counts["frames"] += 1
        T_rig_head = self._heads.at(frame.t_ns)
        if T_rig_head is None:
            self._counts["no_head"] += 1
            return None
        T_rig_camera = T_rig_head @ self._T_head_camera
        expected = {}
        for side, foot in self._feet.items():
            expectation = self._expectation(foot, frame.t_ns, T_rig_camera)
            if expectation is not None:
                expected[side] = expectation
        return View(frame, T_rig_camera, expected)

    def look(self, view: View) -> Seen:
        """Find the feet in a picture; pictures come here one after the other, in order of time."""
        up_camera = view.T_rig_camera[:3, :3].T @ self._up
        floor = self._blobs.find_floor(view.frame, up_camera, view.T_rig_camera)
        markers = self._markers.feed(view.frame, view.expected, up_camera, floor)
        seen: dict[Side, FootExpectation] = {}
        for side, marker in markers.markers.items():
            known = view.expected.get(side)
            # The offset to the blob is kept in the foot's axes, which the filter knows better than one picture.
            R = known.R_camera_foot if known is not None else None
            if R is None and marker.orientation_clear:
                R = marker.R_camera_foot
            if R is not None:
                seen[side] = FootExpectation(marker.place, marker.covariance[3:, 3:], R)
        hidden = {side: foot for side, foot in view.expected.items() if side not in markers.markers}
        self._looks += 1
        learns = self._looks % _LEARN_EVERY == 0
        if not (hidden or learns):
            return Seen(view, markers, DepthSightings({}, {}, None))
        return Seen(view, markers, self._blobs.feed(view.frame, hidden, seen, up_camera, learns=learns))

    def take(self, seen: Seen) -> None:
        """Put into the filters what a picture showed."""
        view, t_ns = seen.view, seen.view.frame.t_ns
        self._newest_ns = max(self._newest_ns, t_ns)
        for side, foot in self._feet.items():
            believed = False
            marker, blob = seen.markers.markers.get(side), seen.blobs.feet.get(side)
            if marker is not None:
                believed = _put_marker(foot.filter, marker, view)
                self._count(side, "marker", "" if believed else "gate")
            elif blob is not None:
                position = view.in_rig(blob.place)
                believed = foot.filter.depth(t_ns, position, view.covariance_in_rig(blob.place, blob.covariance))
                self._count(side, "depth", "" if believed else "gate")
            for stage, refused in (("marker", seen.markers.refused), ("depth", seen.blobs.refused)):
                if side in refused:
                    self._count(side, stage, refused[side])
            # The other one's marker where this foot is expected, again and again: its blob was taken for this one's.
            swapped = marker is None and seen.markers.refused.get(OTHER_FOOT[side]) == "other"
            elsewhere = seen.markers.refused.get(side) == "motion"
            self._doubt(foot, t_ns, believed=believed and not swapped, contradicted=elsewhere or swapped)

    def due_ns(self, now_ns: int) -> int:
        """Return the time for which poses are due: of the newest measurement, plus the configured prediction."""
        return max(self._newest_ns, now_ns - _SILENT_NS) + self._predict_ns

    def poses(self, t_ns: int) -> list[Output]:
        """Return every foot that is known at a moment, with its key."""
        outputs: list[Output] = []
        for side, foot in self._feet.items():
            state = foot.filter.state(t_ns)
            if state is None:
                continue
            backed = state.stage in ("marker", "depth") or (state.stage == "inertial" and state.stationary)
            backed &= state.sigma_m <= _VAGUE_M
            if backed:
                foot.backed_ns = max(foot.backed_ns, t_ns)
            feels = t_ns - foot.felt_ns <= _FELT_NS
            astray_m = _ASTRAY_FELT_M if feels else _ASTRAY_M
            foot.lost = t_ns - max(foot.backed_ns, state.measured_ns) > self._hold_ns or state.sigma_m > astray_m
            if not (foot.lost or (feels and state.sigma_m > _SHOWN_FELT_M)):
                outputs.append((f"rhot/foot/{side}", _message(side, state, backed=backed)))
        return outputs

    def _expectation(self, foot: _Foot, t_ns: int, T_rig_camera: FloatArray) -> FootExpectation | None:
        state = None if foot.lost or self._is_doubted(foot, t_ns) else foot.filter.state(t_ns)
        if state is None:
            return None
        R = T_rig_camera[:3, :3].T
        place = R @ (state.position - T_rig_camera[:3, 3])
        unseen_s = max(0.0, 1e-9 * (t_ns - state.measured_ns))
        room = _ROOM_M + _STRAYS * min(unseen_s, 1.0) if self._is_carried(foot) else room_m(unseen_s)
        covariance = R @ state.covariance @ R.T + room**2 * np.eye(3)
        turning = R @ state.orientation_covariance @ R.T
        if np.trace(turning) > _KNOWN_TURN_RAD**2:
            return FootExpectation(place, covariance)
        return FootExpectation(place, covariance, R @ rotation_from_quaternion(state.orientation_xyzw), turning)

    def _is_carried(self, foot: _Foot) -> bool:
        return isinstance(foot.filter, FootFilter) and foot.filter.aligned

    def _is_doubted(self, foot: _Foot, t_ns: int) -> bool:
        return foot.doubted_ns is not None and t_ns - foot.doubted_ns > _DOUBT_S * 1e9

    def _doubt(self, foot: _Foot, t_ns: int, *, believed: bool, contradicted: bool) -> None:
        """Note since when a foot's marker is seen where it is not expected, and nothing backs the expectation."""
        if believed:
            foot.doubted_ns, foot.lost = None, False
        elif contradicted and foot.doubted_ns is None:
            foot.doubted_ns = t_ns

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


def _put_marker(target: _Filter, marker: FootMarker, view: View) -> bool:
    """Put a marker into a filter, with its orientation where that is clear."""
    T = view.T_rig_camera
    position, covariance = view.in_rig(marker.place), view.covariance_in_rig(marker.place, marker.covariance[3:, 3:])
    if not marker.orientation_clear:
        return target.marker(marker.t_ns, position, covariance)
    R = T[:3, :3]
    turning = R @ marker.covariance[:3, :3] @ R.T + HEAD_TURN_RAD**2 * np.eye(3)
    orientation = quaternion_from_rotation(R @ marker.R_camera_foot)
    return target.marker(marker.t_ns, position, covariance, orientation, turning)


def _message(side: Side, state: FootState, *, backed: bool) -> FootPose:
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
        state="measured" if backed else "predicted",
    )
