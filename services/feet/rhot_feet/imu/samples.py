"""Inertial samples, independent of the sensor's protocol, and the interface of their sources."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from rhot.arrays import FloatArray, IntArray

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
