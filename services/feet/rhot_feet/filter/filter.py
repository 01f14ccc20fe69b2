"""One foot out of everything that is known of it: marker, depth image and inertial sensor, each at its own time.

Without a sensor, and until its alignment is learnt (`rhot_feet.imu.alignment.alignment`), the foot is a body that
accelerates at random (`foot_filter_kinematic`); the sensor then only tells when it stands. Afterwards the sensor
carries the foot and pictures and stand-stills correct it (`foot_filter_inertial`). A sensor that falls silent hands
over to the first again, and one that comes back is taken up by the marker's orientation, through the mounting that was
learnt.

Every observation passes a gate on its innovation. What the gate turns away is remembered: when several in a row agree
with each other, the foot is there and the filter was wrong, and it starts anew at that place.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot_feet.filter.history import History
from rhot_feet.filter.inertial import InertialModel
from rhot_feet.filter.kinematic import KinematicModel, KinematicState
from rhot_feet.filter.model import FootFilterSettings, FootMotion, FootState, Observation, Stage
from rhot_feet.filter.rejected import Rejected
from rhot_feet.filter.samples import SampleTrack
from rhot_feet.imu.alignment.alignment import AlignmentLearner
from rhot_feet.imu.alignment.equations import Alignment
from rhot_feet.imu.inertial import up_rotation
from rhot_feet.imu.samples import ImuSamples
from rhot_feet.imu.strapdown import InertialState, Strapdown
from rhot_feet.imu.zero_velocity import GRAVITY

FloatArray = NDArray[np.float64]
State = TypeVar("State")

_NO_RATE: Final = np.zeros(3)
_FLOOR: Final = 0.001**2 * np.eye(3)
"""m²: no place out of a picture is better than a millimetre."""
_ROTATION_FLOOR: Final = np.radians(1.0) ** 2 * np.eye(3)
_DEPTH_ALIKE_S: Final = 0.05
"""Correlation time of the errors of places out of the depth image: a shoe shows the same side for a while."""
_YAW_IN_MOTION_RAD: Final = math.radians(9.0)
"""A foot that swings in sight is better served without a sensor whose yaw is worse known than this."""
_RETURN_YAW_RAD: Final = math.radians(8.0)


@dataclass(slots=True)
class FilterCounts:
    """What happened to the measurements.

    Attributes:
        accepted: observations that were put in.
        gated: turned away by the gate.
        rotations_gated: taken without their orientation.
        late: older than the horizon.
        restarts: times the filter started anew at an observed place.
    """

    accepted: int = 0
    gated: int = 0
    rotations_gated: int = 0
    late: int = 0
    restarts: int = 0


class FootFilter:
    """Filters one foot; reads no clock, so the same measurements always give the same answer."""

    def __init__(self, settings: FootFilterSettings | None = None) -> None:
        self.settings = settings or FootFilterSettings()
        self.counts = FilterCounts()
        up = np.array(self.settings.up)
        self._C = up_rotation(up)
        strapdown = Strapdown(-GRAVITY * self._C[:, 2], self.settings.noise)
        self._inertial = InertialModel(strapdown, self._C)
        self._kinematic = KinematicModel()
        self._learner = AlignmentLearner(self._C, np.array(self.settings.sensor_m))
        self._known: Alignment | None = None
        self._samples = SampleTrack(self.settings.stillness, 2 * self.settings.horizon_ns)
        self._by_sensor: History[InertialState] | None = None
        self._by_sight: History[KinematicState] | None = None
        self._rejected = Rejected(self.settings.agreeing)
        self._restarts_ns: deque[int] = deque(maxlen=3)
        self._seen: dict[str, int] = {}
        self._stood_ns: int | None = 0

    @property
    def aligned(self) -> bool:
        """Whether the inertial sensor carries the foot."""
        return self._by_sensor is not None

    def imu(self, samples: ImuSamples) -> None:
        """Take samples of the sensor, not older than those before."""
        rotations = [rotation_from_quaternion(orientation) for orientation in samples.orientation_xyzw]
        stands = []
        for t_ns, force, rate, R_world in zip(
            samples.t_ns.tolist(), samples.specific_force, samples.angular_rate, rotations, strict=True
        ):
            for missing_ns in self._samples.missing(t_ns, force, R_world):
                self._sample(missing_ns, force, _NO_RATE, R_world)
            stands.append(self._sample(t_ns, force, rate, R_world))
        if self._by_sensor is None:
            self._learner.imu(samples, rotations, stands)

    def marker(
        self,
        t_ns: int,
        position: FloatArray,
        covariance: FloatArray,
        orientation_xyzw: FloatArray | None = None,
        orientation_covariance: FloatArray | None = None,
    ) -> bool:
        """Take a place of the foot's marker; tell whether it was believed.

        Args:
            t_ns: middle of the exposure, rig clock; may lie in the past.
            position: (3,) metres, rig frame.
            covariance: (3, 3) m².
            orientation_xyzw: (4,) foot to rig, if it was seen.
            orientation_covariance: (3, 3) rad², of its error as a rotation vector in the rig frame; 3° when left out.
        """
        rotation = None if orientation_xyzw is None else rotation_from_quaternion(orientation_xyzw)
        spread = np.radians(3.0) ** 2 * np.eye(3) if orientation_covariance is None else orientation_covariance
        return self._observe(
            Observation(t_ns, position, covariance + _FLOOR, rotation, spread + _ROTATION_FLOOR, "marker")
        )

    def depth(self, t_ns: int, position: FloatArray, covariance: FloatArray) -> bool:
        """Take a place of the foot's origin (3,) out of the depth image; tell whether it was believed."""
        return self._observe(Observation(t_ns, position, covariance + _FLOOR, None, _ROTATION_FLOOR, "depth"))

    def state(self, t_ns: int) -> FootState | None:
        """Return the foot at a moment, usually now; None before it was first seen."""
        self._hand_over(t_ns)
        motion = self._motion(t_ns)
        if motion is None:
            return None
        felt = self._samples.at(t_ns)
        stands = felt is not None and felt.rest.still
        return FootState(
            t_ns,
            motion.position,
            motion.velocity,
            quaternion_from_rotation(motion.rotation),
            motion.covariance,
            motion.rotation_covariance,
            self._stage(t_ns, stands=stands),
            stands,
            max(*self._seen.values(), self._stood_ns or 0),
        )

    def _sample(self, t_ns: int, force: FloatArray, rate: FloatArray, R_world: FloatArray) -> bool:
        """Take a sample; tell whether the foot was felt to rest, if only as shortly as one that walks fast."""
        felt = self._samples.add(t_ns, force, rate, R_world)
        if felt is None:
            self._stood_ns = None
            self._hand_over(t_ns)
            return False
        # A foot that has stood ever since it was seen is where it was seen.
        if not felt.rest.still:
            self._stood_ns = None
        elif self._stood_ns is not None:
            self._stood_ns = felt.t_ns
        history = self._by_sensor or self._by_sight
        if history is not None and felt.t_ns >= history.start_ns:
            history.add(felt)
        return felt.rest.speed_sigma is not None

    def _observe(self, observation: Observation) -> bool:
        self._hand_over(observation.t_ns)
        if self._by_sensor is None and self._by_sight is None:
            self._begin(observation)
            return True
        history = self._by_sensor or self._by_sight
        if history is None or observation.t_ns < history.start_ns:
            self.counts.late += 1
            return False
        position, rotation = self._surprise(observation)
        if position > self.settings.gate:
            return self._turned_away(observation)
        self._rejected.clear()
        if rotation > self.settings.gate:
            self.counts.rotations_gated += 1
            observation = replace(observation, rotation=None)
        if observation.stage == "depth" and self._by_sensor is not None:
            observation = self._one_of_many(observation)
        history.add(observation)
        self._accepted(observation)
        return True

    def _one_of_many(self, observation: Observation) -> Observation:
        """Return a place out of the depth image for no more than it adds to the one before: their errors are alike."""
        since_s = 1e-9 * (observation.t_ns - self._seen.get("depth", 0))
        like = max(1.0, 2.0 * _DEPTH_ALIKE_S / max(since_s, 1e-3))
        return replace(observation, covariance=like * observation.covariance)

    def _accepted(self, observation: Observation) -> None:
        self.counts.accepted += 1
        self._stood_ns = observation.t_ns
        self._seen[observation.stage] = max(observation.t_ns, self._seen.get(observation.stage, 0))
        if self._by_sensor is not None:
            return
        if observation.stage == "marker":
            sigma_m, turn_sigma_rad = (
                math.sqrt(float(np.trace(covariance)) / 3.0)
                for covariance in (observation.covariance, observation.rotation_covariance)
            )
            self._learner.marker(observation.t_ns, observation.position, sigma_m, observation.rotation, turn_sigma_rad)
        self._take_up(observation)

    def _surprise(self, observation: Observation) -> tuple[float, float]:
        if self._by_sensor is not None:
            return self._inertial.surprise(self._by_sensor.at(observation.t_ns), observation)
        if self._by_sight is not None:
            return self._kinematic.surprise(self._by_sight.at(observation.t_ns), observation)
        return 0.0, 0.0

    def _turned_away(self, observation: Observation) -> bool:
        """Remember what the gate turned away; start anew when enough of it agrees."""
        self.counts.gated += 1
        if not self._rejected.add(observation):
            return False
        self.counts.restarts += 1
        self._restarts_ns.append(observation.t_ns)
        often = len(self._restarts_ns) == 3 and observation.t_ns - self._restarts_ns[0] < 3_000_000_000
        if self._by_sensor is not None and not often:
            state = self._inertial.restart(self._by_sensor.at(observation.t_ns), observation)
            self._by_sensor = self._again(History(self._inertial, observation.t_ns, state, self.settings.horizon_ns))
        else:
            if self._by_sensor is not None:
                # The sensor led astray again and again: what was learnt about it is wrong.
                self._learner.forget()
                self._known = None
            self._begin(observation)
        self._accepted(observation)
        return True

    def _begin(self, observation: Observation) -> None:
        state = self._kinematic.start(observation.position, observation.covariance, observation.rotation)
        if observation.rotation is None and self._by_sight is not None:
            before = self._by_sight.at(observation.t_ns)
            state = replace(state, R=before.R, turning=before.turning)
        self._by_sensor = None
        self._by_sight = self._again(History(self._kinematic, observation.t_ns, state, self.settings.horizon_ns))
        self._seen[observation.stage] = observation.t_ns

    def _again(self, history: History[State]) -> History[State]:
        """Put what the sensor felt since the beginning of a history into it."""
        for felt in self._samples.since(history.start_ns):
            history.add(felt)
        return history

    def _take_up(self, observation: Observation) -> None:
        """Let the sensor carry the foot as soon as its alignment is known."""
        in_sight = observation.stage == "marker"
        alignment = self._learner.alignment(at_once=not in_sight) or self._returned(observation)
        felt = self._samples.at(observation.t_ns)
        if alignment is None or felt is None or self._by_sight is None:
            return
        if in_sight and not felt.rest.still and alignment.yaw_sigma_rad > _YAW_IN_MOTION_RAD:
            return
        motion = self._kinematic.motion(self._by_sight.at(observation.t_ns), _NO_RATE)
        state = self._inertial.start(alignment, felt.R_world, motion, felt.rate, stands=felt.rest.still)
        history = History(self._inertial, observation.t_ns, state, self.settings.horizon_ns)
        self._by_sensor, self._by_sight = self._again(history), None

    def _returned(self, observation: Observation) -> Alignment | None:
        """Return the alignment of a sensor that was away, with the yaw that the marker's orientation gives it now."""
        known, felt = self._known, self._samples.at(observation.t_ns)
        if known is None or not known.mounted or observation.rotation is None or felt is None:
            return None
        level = self._C.T @ observation.rotation @ known.M.T @ felt.R_world.T
        yaw = math.atan2(level[1, 0] - level[0, 1], level[0, 0] + level[1, 1])
        return replace(known, yaw_rad=yaw, yaw_sigma_rad=_RETURN_YAW_RAD)

    def _hand_over(self, t_ns: int) -> None:
        """Go on without the sensor when it has been silent for too long, as of a moment."""
        history = self._by_sensor
        if history is None or not self._samples.is_silent(t_ns):
            return
        state = history.at(history.newest_ns)
        kinematic = self._kinematic.follow(self._inertial.motion(state, state.rate_bias))
        self._known = self._inertial.learnt(state)
        self._learner.forget()
        self._by_sensor = None
        self._by_sight = History(self._kinematic, history.newest_ns, kinematic, self.settings.horizon_ns)

    def _motion(self, t_ns: int) -> FootMotion | None:
        if self._by_sensor is not None:
            felt = self._samples.at(t_ns)
            return self._inertial.motion(self._by_sensor.at(t_ns), _NO_RATE if felt is None else felt.rate)
        if self._by_sight is not None:
            return self._kinematic.motion(self._by_sight.at(t_ns), _NO_RATE)
        return None

    def _stage(self, t_ns: int, *, stands: bool) -> Stage:
        if t_ns - self._seen.get("marker", 0) <= self.settings.fresh_ns:
            return "marker"
        if t_ns - self._seen.get("depth", 0) <= self.settings.fresh_ns:
            return "depth"
        # A sensor that is not aligned yet still feels that the foot stands where it was seen.
        return "inertial" if self._by_sensor is not None or stands else "lost"
