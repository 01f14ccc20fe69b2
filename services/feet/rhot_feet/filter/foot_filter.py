"""The filter of one foot: marker, depth image and inertial sensor, each measurement at its own time.

Without a sensor, and until its alignment is known (`rhot_feet.imu.alignment.estimator`), the foot has a random
acceleration (`kinematic`); the sensor then only detects zero velocity. Afterwards the motion is predicted from the
sensor, and corrected by images and zero velocity (`inertial`). During a dropout of the sensor the kinematic model is
used; afterwards the marker's orientation aligns the sensor again through the mounting that was estimated before.

Every observation passes a gate on its innovation. If several consecutive rejected observations agree with each other,
the filter was wrong, and it restarts at their position.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace
from typing import Final, TypeVar

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot_feet.filter.displacement import UnseenDisplacement
from rhot_feet.filter.inertial import InertialModel
from rhot_feet.filter.kinematic import KinematicModel, KinematicState, set_off_m
from rhot_feet.filter.model import FilterCounts, FootFilterSettings, FootMotion, FootState, Observation, Stage
from rhot_feet.filter.out_of_sequence import StateHistory
from rhot_feet.filter.strapdown import InertialState, Strapdown
from rhot_feet.imu.alignment.equations import Alignment
from rhot_feet.imu.alignment.estimator import AlignmentEstimator
from rhot_feet.imu.samples import GRAVITY_M_S2, ImuSamples, up_rotation
from rhot_feet.imu.track import ImuTrack

# What a foot's outlier gate refused, in case the filter was wrong and not the observations.

_FASTEST_M_S: Final = 8.0
"""Feet are not faster: the swing of a sprinting foot."""
_LONGEST_GAP_S: Final = 0.3
"""Observations farther apart say nothing about each other; chosen."""
_SIGMAS: Final = 4.0
"""Of both observations' stated errors, beyond what a foot can move between them; chosen."""


class OutlierRun:
    """Refused observations in a row that agree with each other.

    Args:
        agreeing: so many in a row are right.
    """

    def __init__(self, agreeing: int) -> None:
        self._agreeing = agreeing
        self._row: list[Observation] = []

    def clear(self) -> None:
        """Forget them: an observation was accepted."""
        self._row.clear()

    def add(self, observation: Observation) -> bool:
        """Add a refused observation; return whether enough agree, which ends the row."""
        if self._row and not _agree(self._row[-1], observation):
            self._row.clear()
        self._row.append(observation)
        if len(self._row) < self._agreeing:
            return False
        self._row.clear()
        return True


def _agree(before: Observation, after: Observation) -> bool:
    """Return whether one foot may have been at both positions, one after the other."""
    span_s = (after.t_ns - before.t_ns) * 1e-9
    if not 0.0 < span_s < _LONGEST_GAP_S:
        return False
    reach_m = _FASTEST_M_S * span_s + _SIGMAS * math.sqrt(float(np.trace(before.covariance + after.covariance)))
    change = after.position - before.position
    return math.sqrt(float(change @ change)) <= reach_m


State = TypeVar("State")

_NO_RATE: Final = np.zeros(3)


class FootFilter:
    """Filters one foot; reads no clock, so the same measurements always give the same answer."""

    def __init__(self, settings: FootFilterSettings | None = None) -> None:
        self.settings = settings = settings or FootFilterSettings()
        self.counts = FilterCounts()
        self._C = up_rotation(np.array(settings.up))
        self._position_floor = settings.position_floor_m**2 * np.eye(3)
        self._rotation_floor = settings.rotation_floor_rad**2 * np.eye(3)
        strapdown = Strapdown(-GRAVITY_M_S2 * self._C[:, 2], settings.noise)
        self._inertial = InertialModel(strapdown, self._C)
        self._kinematic = KinematicModel()
        self._alignment = AlignmentEstimator(self._C, np.array(settings.sensor_m))
        self._previous_alignment: Alignment | None = None
        self._imu = ImuTrack(settings.zero_velocity, 2 * settings.horizon_ns)
        self._displacement = UnseenDisplacement(self._C, np.array(settings.sensor_m))
        self._inertial_history: StateHistory[InertialState] | None = None
        self._kinematic_history: StateHistory[KinematicState] | None = None
        self._outliers = OutlierRun(settings.agreeing)
        self._restarts_ns: deque[int] = deque(maxlen=settings.restarts)
        self._observed_ns: dict[str, int] = {}
        # Until when the foot has stood since it was observed; None once it has moved.
        self._stood_ns: int | None = 0

    @property
    def aligned(self) -> bool:
        """Whether the sensor is aligned, so that the foot's motion is predicted from it."""
        return self._inertial_history is not None

    def add_imu_samples(self, samples: ImuSamples) -> None:
        """Add samples of the sensor, not older than those before."""
        rotations = [rotation_from_quaternion(orientation) for orientation in samples.orientation_xyzw]
        stands = []
        for t_ns, force, rate, R_world in zip(
            samples.t_ns.tolist(), samples.specific_force, samples.angular_rate, rotations, strict=True
        ):
            for missing_ns in self._imu.missing(t_ns, force, R_world):
                self._add_imu_sample(missing_ns, force, _NO_RATE, R_world)
            stands.append(self._add_imu_sample(t_ns, force, rate, R_world))
        if self._inertial_history is None:
            self._alignment.add_imu_samples(samples, rotations, stands)

    def update_marker(
        self,
        t_ns: int,
        position: FloatArray,
        covariance: FloatArray,
        orientation_xyzw: FloatArray | None = None,
        orientation_covariance: FloatArray | None = None,
    ) -> bool:
        """Update with an observation of the foot's marker; return whether it was accepted.

        Args:
            t_ns: middle of the exposure, rig clock; may lie in the past.
            position: (3,) metres, rig frame.
            covariance: (3, 3) m².
            orientation_xyzw: (4,) foot to rig, if it was seen.
            orientation_covariance: (3, 3) rad², of its error as a rotation vector in the rig frame; that of the
                settings when left out.
        """
        rotation = None if orientation_xyzw is None else rotation_from_quaternion(orientation_xyzw)
        noise = orientation_covariance
        if noise is None:
            noise = self.settings.marker_rotation_rad**2 * np.eye(3)
        return self._update(
            Observation(
                t_ns, position, covariance + self._position_floor, rotation, noise + self._rotation_floor, "marker"
            )
        )

    def update_depth(self, t_ns: int, position: FloatArray, covariance: FloatArray) -> bool:
        """Update with a position (3,) of the foot's origin from the depth image; return whether it was accepted."""
        return self._update(
            Observation(t_ns, position, covariance + self._position_floor, None, self._rotation_floor, "depth")
        )

    def state(self, t_ns: int) -> FootState | None:
        """Return the foot's state at a time, rig clock; None before the first observation."""
        self._handle_dropout(t_ns)
        motion = self._motion(t_ns)
        if motion is None:
            return None
        interval = self._imu.at(t_ns)
        stands = interval is not None and interval.zero_velocity.still
        measured_ns = max(*self._observed_ns.values(), self._stood_ns or 0)
        followed = self._inertial_history is not None or self._displacement.known_at(t_ns)
        return FootState(
            t_ns,
            motion.position,
            motion.velocity,
            quaternion_from_rotation(motion.rotation),
            motion.covariance,
            motion.rotation_covariance,
            self._stage(t_ns, stands=stands),
            stands,
            measured_ns,
            0.0 if followed else set_off_m(1e-9 * (t_ns - measured_ns)),
            followed,
        )

    def _add_imu_sample(self, t_ns: int, force: FloatArray, rate: FloatArray, R_world: FloatArray) -> bool:
        """Add a sample; return whether it shows zero velocity, even as briefly as in a fast walk."""
        interval = self._imu.add(t_ns, force, rate, R_world)
        if interval is None:
            self._stood_ns = None
            self._displacement.forget()
            self._handle_dropout(t_ns)
            return False
        self._displacement.add(interval, seen=self._stood_ns is not None)
        if self._displacement.sets_off and self._kinematic_history is not None:
            self._displacement.stood(self._seen_motion(self._kinematic_history, t_ns))
        if not interval.zero_velocity.still:
            self._stood_ns = None
        elif self._stood_ns is not None:
            self._stood_ns = interval.t_ns
        history = self._inertial_history or self._kinematic_history
        if history is not None and interval.t_ns >= history.start_ns:
            history.add(interval)
        return interval.zero_velocity.speed_sigma is not None

    def _update(self, observation: Observation) -> bool:
        self._handle_dropout(observation.t_ns)
        history = self._inertial_history or self._kinematic_history
        if history is None:
            self._start(observation)
            return True
        if observation.t_ns < history.start_ns:
            self.counts.late += 1
            return False
        position_nis, rotation_nis = self._nis(observation)
        if position_nis > self.settings.gate_nis:
            return self._refuse(observation)
        self._outliers.clear()
        if rotation_nis > self.settings.gate_nis:
            observation = replace(observation, rotation=None)
        if observation.stage == "depth" and self._inertial_history is not None:
            observation = self._decorrelated(observation)
        history.add(observation)
        self._accept(observation)
        return True

    def _nis(self, observation: Observation) -> tuple[float, float]:
        if self._inertial_history is not None:
            return self._inertial.nis(self._inertial_history.at(observation.t_ns), observation)
        if self._kinematic_history is not None:
            seen = self._seen_motion(self._kinematic_history, observation.t_ns)
            moved = self._displacement.moved(observation.t_ns, seen)
            position, rotation = self._kinematic.nis(self._kinematic_history.at(observation.t_ns), observation)
            return position if moved is seen else moved.nis(observation), rotation
        return 0.0, 0.0

    def _decorrelated(self, observation: Observation) -> Observation:
        """Return a depth observation with its noise increased, because its error correlates with the previous one's."""
        since_s = 1e-9 * (observation.t_ns - self._observed_ns.get("depth", 0))
        factor = max(1.0, 2.0 * self.settings.depth_correlation_s / max(since_s, 1e-3))
        return replace(observation, covariance=factor * observation.covariance)

    def _accept(self, observation: Observation) -> None:
        """Record an accepted observation; while the sensor is not aligned, use it for the alignment."""
        self.counts.accepted += 1
        self._stood_ns = observation.t_ns
        self._observed_ns[observation.stage] = max(observation.t_ns, self._observed_ns.get(observation.stage, 0))
        if self._inertial_history is not None:
            return
        interval = self._imu.at(observation.t_ns)
        if self._kinematic_history is not None and (interval is None or not interval.zero_velocity.still):
            self._displacement.see(observation.t_ns, self._seen_motion(self._kinematic_history, observation.t_ns))
        if observation.stage == "marker":
            sigma_m, rotation_sigma_rad = (
                math.sqrt(float(np.trace(covariance)) / 3.0)
                for covariance in (observation.covariance, observation.rotation_covariance)
            )
            self._alignment.add_marker(
                observation.t_ns, observation.position, sigma_m, observation.rotation, rotation_sigma_rad
            )
        self._try_alignment(observation)

    def _refuse(self, observation: Observation) -> bool:
        """Record an outlier; if enough of them agree, restart and return True."""
        settings = self.settings
        self.counts.gated += 1
        if not self._outliers.add(observation):
            return False
        self.counts.restarts += 1
        self._restarts_ns.append(observation.t_ns)
        often = (
            len(self._restarts_ns) == settings.restarts
            and observation.t_ns - self._restarts_ns[0] < settings.restarts_ns
        )
        if self._inertial_history is not None and not often:
            state = self._inertial.restart(self._inertial_history.at(observation.t_ns), observation)
            self._inertial_history = self._replayed(
                StateHistory(self._inertial, observation.t_ns, state, settings.horizon_ns)
            )
        else:
            if self._inertial_history is not None:
                # After repeated restarts, the sensor's alignment is assumed to be wrong.
                self._alignment.reset()
                self._previous_alignment = None
            self._start(observation)
        self._accept(observation)
        return True

    def _start(self, observation: Observation) -> None:
        """Start the kinematic model at an observation."""
        state = self._kinematic.start(observation.position, observation.covariance, observation.rotation)
        if observation.rotation is None and self._kinematic_history is not None:
            before = self._kinematic_history.at(observation.t_ns)
            state = replace(state, R=before.R, rotation_covariance=before.rotation_covariance)
        self._inertial_history = None
        self._kinematic_history = self._replayed(
            StateHistory(self._kinematic, observation.t_ns, state, self.settings.horizon_ns)
        )
        self._observed_ns[observation.stage] = observation.t_ns

    def _replayed(self, history: StateHistory[State]) -> StateHistory[State]:
        """Add to a history what the sensor has measured since its beginning."""
        for interval in self._imu.since(history.start_ns):
            history.add(interval)
        return history

    def _try_alignment(self, observation: Observation) -> None:
        """Start the inertial model as soon as the sensor's alignment is known."""
        in_sight = observation.stage == "marker"
        alignment = self._alignment.solve(at_once=not in_sight) or self._realigned(observation)
        interval = self._imu.at(observation.t_ns)
        if alignment is None or interval is None or self._kinematic_history is None:
            return
        stands = interval.zero_velocity.still
        if in_sight and not stands and alignment.yaw_sigma_rad > self.settings.moving_yaw_rad:
            return
        motion = self._seen_motion(self._kinematic_history, observation.t_ns)
        state = self._inertial.start(alignment, interval.R_world, motion, interval.rate, stands=stands)
        history = StateHistory(self._inertial, observation.t_ns, state, self.settings.horizon_ns)
        self._inertial_history, self._kinematic_history = self._replayed(history), None

    def _realigned(self, observation: Observation) -> Alignment | None:
        """Return the former alignment of a reconnected sensor, with the yaw from the marker's orientation."""
        known, interval = self._previous_alignment, self._imu.at(observation.t_ns)
        if known is None or not known.mounting_known or observation.rotation is None or interval is None:
            return None
        level = self._C.T @ observation.rotation @ known.M.T @ interval.R_world.T
        yaw = math.atan2(level[1, 0] - level[0, 1], level[0, 0] + level[1, 1])
        return replace(known, yaw_rad=yaw, yaw_sigma_rad=self.settings.return_yaw_rad)

    def _handle_dropout(self, t_ns: int) -> None:
        """Switch to the kinematic model if the sensor's dropout is too long at this time."""
        history = self._inertial_history
        if history is None or not self._imu.is_silent(t_ns):
            return
        state = history.at(history.newest_ns)
        kinematic = self._kinematic.follow(self._inertial.motion(state, state.rate_bias))
        self._previous_alignment = self._inertial.alignment(state)
        self._alignment.reset()
        self._inertial_history = None
        self._kinematic_history = StateHistory(self._kinematic, history.newest_ns, kinematic, self.settings.horizon_ns)

    def _motion(self, t_ns: int) -> FootMotion | None:
        if self._inertial_history is not None:
            interval = self._imu.at(t_ns)
            rate = _NO_RATE if interval is None else interval.rate
            return self._inertial.motion(self._inertial_history.at(t_ns), rate)
        if self._kinematic_history is not None:
            return self._displacement.moved(t_ns, self._seen_motion(self._kinematic_history, t_ns))
        return None

    def _seen_motion(self, history: StateHistory[KinematicState], t_ns: int) -> FootMotion:
        """Return the foot's motion at a time from image observations alone."""
        return self._kinematic.motion(history.at(t_ns), _NO_RATE)

    def _stage(self, t_ns: int, *, stands: bool) -> Stage:
        if t_ns - self._observed_ns.get("marker", 0) <= self.settings.fresh_ns:
            return "marker"
        if t_ns - self._observed_ns.get("depth", 0) <= self.settings.fresh_ns:
            return "depth"
        # A sensor that is not aligned yet still detects that the foot stands.
        return "inertial" if self._inertial_history is not None or stands else "lost"
