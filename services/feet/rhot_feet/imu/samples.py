"""Inertial samples, independent of the sensor's protocol, and the interface of their sources."""

from __future__ import annotations

import math
from collections.abc import Callable, Reversible, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, TypeVar

import numpy as np

from rhot.arrays import FloatArray, IntArray
from rhot.geometry.rotations import (
    orthonormal,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
    rotation_vectors,
)

# From what inertial sensors send to specific force, angular rate and a level orientation.
#
# Two kinds of sensors: those that fuse inside (BNO080: orientation q and linear acceleration a, gravity removed by
# means of that very q) and those that send specific force f and angular rate ω. The first are converted back,
#
#     f = a + Rᵀ(q)·(0, 0, g),        ω = log(Rᵀ(q₀)·R(q₁)) / h,
#
# so that an error of the sensor's own idea of "down" cancels and one navigation filter serves both. The second get an
# orientation from a complementary filter: rotated by ω, and drawn to where the force says "up" while it measures g
# (Mahony, Hamel and Pflimlin, "Nonlinear complementary filters on the special orthogonal group", IEEE Transactions on
# Automatic Control 53 (5), 2008, with the gain as the source leaves it open).

S = TypeVar("S")

LONGEST_STEP_S: Final = 0.25
"""Samples further apart than this do not belong together: the sensor was away."""


def nearest_sample(samples: Reversible[S], t_ns: int, time_of: Callable[[S], int]) -> S | None:
    """Return the one of some samples, in order of time, that is nearest to a moment, if one is near."""
    # From the newest backwards: what is asked for is seldom older than a picture.
    nearest = None
    for sample in reversed(samples):
        if nearest is not None and abs(time_of(sample) - t_ns) > abs(time_of(nearest) - t_ns):
            break
        nearest = sample
    return None if nearest is None or abs(time_of(nearest) - t_ns) > LONGEST_STEP_S * 1e9 else nearest


def level_rotation(specific_force: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from the sensor to a level world (z up) of a sensor at rest; yaw is arbitrary."""
    up = specific_force / max(math.sqrt(specific_force @ specific_force), 1e-9)
    side = np.array([0.0, 1.0, 0.0]) if abs(up[1]) < 0.9 else np.array([1.0, 0.0, 0.0])
    x = np.cross(side, up)
    x /= math.sqrt(x @ x)
    return np.array([x, np.cross(up, x), up])


def up_rotation(up: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from a level world (z up) to a frame in which `up` (3,) is up."""
    rotation: FloatArray = level_rotation(up).T
    return rotation


class FusedImuConverter:
    """Converts samples of a sensor that fuses inside: orientation and linear acceleration."""

    def __init__(self) -> None:
        self._last: tuple[int, FloatArray] | None = None

    def reset(self) -> None:
        """Forget the last sample: there was a gap."""
        self._last = None

    def convert(self, t_ns: IntArray, linear_acceleration: FloatArray, orientation_xyzw: FloatArray) -> ImuSamples:
        """Return N samples.

        Args:
            t_ns: (N,) strictly increasing, also from call to call.
            linear_acceleration: (N, 3) m/s², sensor frame, without gravity.
            orientation_xyzw: (N, 4) sensor to a level world (z up).
        """
        if not len(t_ns):
            return ImuSamples.none()
        R = rotation_from_quaternion(orientation_xyzw)
        first_t, first_R = self._last if self._last is not None else (int(t_ns[0]) - 1, R[0])
        before = np.concatenate([first_R[None], R[:-1]])
        spans = np.diff(t_ns, prepend=first_t) * 1e-9
        rotations = rotation_vectors(before.swapaxes(1, 2) @ R)
        whole = spans <= LONGEST_STEP_S
        rates = np.where(whole[:, None], rotations / np.maximum(spans, 1e-6)[:, None], 0.0)
        self._last = int(t_ns[-1]), R[-1]
        return ImuSamples(t_ns, linear_acceleration + GRAVITY_M_S2 * R[:, 2, :], rates, quaternion_from_rotation(R))


class RawImuConverter:
    """Converts samples of a sensor that sends specific force and angular rate."""

    def __init__(self) -> None:
        self._last: tuple[int, FloatArray] | None = None
        self._R: FloatArray | None = None

    def reset(self) -> None:
        """Forget the last sample: there was a gap."""
        self._last = self._R = None

    def convert(self, t_ns: IntArray, specific_force: FloatArray, angular_rate: FloatArray) -> ImuSamples:
        """Return N samples.

        Args:
            t_ns: (N,) strictly increasing, also from call to call.
            specific_force: (N, 3) m/s².
            angular_rate: (N, 3) rad/s, at the moments of the samples.
        """
        if not len(t_ns):
            return ImuSamples.none()
        first_t, first_rate = self._last if self._last is not None else (int(t_ns[0]) - 1, angular_rate[0])
        rates = 0.5 * (angular_rate + np.concatenate([first_rate[None], angular_rate[:-1]]))
        spans = np.diff(t_ns, prepend=first_t) * 1e-9
        rotations = np.empty((len(t_ns), 3, 3))
        for index, (span, force, rate) in enumerate(zip(spans.tolist(), specific_force, rates, strict=True)):
            rotations[index] = self._follow(span, force, rate)
        self._last = int(t_ns[-1]), angular_rate[-1]
        return ImuSamples(t_ns, specific_force, rates, quaternion_from_rotation(rotations))

    def _follow(self, span_s: float, force: FloatArray, rate: FloatArray) -> FloatArray:
        if self._R is None or span_s > LONGEST_STEP_S:
            self._R = level_rotation(force)
            return self._R
        R = self._R @ rotation_from_vector(span_s * rate)
        size = math.sqrt(force @ force)
        # M/s²: a force that differs from gravity by more does not say where up is.
        if abs(size - GRAVITY_M_S2) < 0.5:
            up = R @ force / size
            # Gain of the complementary filter, 1/s.
            R = rotation_from_vector((0.5 * span_s) * np.array([up[1], -up[0], 0.0])) @ R
        self._R = orthonormal(R)
        return self._R


GRAVITY_M_S2: Final = 9.81
"""Standard gravity that sensors are scaled to."""


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """Samples of one inertial sensor in order of time.

    Attributes:
        t_ns: (N,) int64, strictly increasing, rig clock.
        specific_force: (N, 3) m/s², sensor frame; what an accelerometer measures, so 9.81 upwards at rest.
        angular_rate: (N, 3) rad/s, sensor frame; mean since the sample before.
        orientation_xyzw: (N, 4) unit quaternions, sensor to a level world of the sensor's own: z up, yaw anywhere and
            slowly drifting.
    """

    t_ns: IntArray
    specific_force: FloatArray
    angular_rate: FloatArray
    orientation_xyzw: FloatArray

    def __len__(self) -> int:
        return len(self.t_ns)

    @classmethod
    def none(cls) -> ImuSamples:
        """Return no samples."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 4)))

    @classmethod
    def joined(cls, parts: Sequence[ImuSamples]) -> ImuSamples:
        """Return concatenated batches."""
        if not parts:
            return cls.none()
        return cls(
            np.concatenate([part.t_ns for part in parts]),
            np.concatenate([part.specific_force for part in parts]),
            np.concatenate([part.angular_rate for part in parts]),
            np.concatenate([part.orientation_xyzw for part in parts]),
        )

    def rows(self, first: int, last: int) -> ImuSamples:
        """Return the samples from `first` to before `last`."""
        return ImuSamples(
            self.t_ns[first:last],
            self.specific_force[first:last],
            self.angular_rate[first:last],
            self.orientation_xyzw[first:last],
        )


class ImuSource(Protocol):
    """A sensor on a wire, a recording of one, or a simulated one."""

    def open(self, start_ns: int) -> None:
        """Connect and make ready.

        Args:
            start_ns: rig time at which the session starts; recordings and the simulated world begin there.

        Raises:
            DeviceError: the sensor is absent; calling `open` again later may succeed.
            ConfigError: a file cannot be used; calling again does not help.
        """
        ...

    def read(self, now_ns: int) -> ImuSamples:
        """Return the samples that came since the last call; none is no error.

        Args:
            now_ns: rig time.

        Raises:
            DeviceError: the sensor went away; `close`, then `open` again.
        """
        ...

    def close(self) -> None:
        """Release the device; may be called repeatedly."""
        ...
