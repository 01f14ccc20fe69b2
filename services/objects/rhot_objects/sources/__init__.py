"""The interface between the objects service and a tracking system.

A source returns poses in the *tracker's space*; `rhot_objects.pose` transforms them to the rig frame.

`open` and `read` may block briefly and are called from one thread at a time; `close` may be called from another thread
during a `read`, because a thread cannot be cancelled.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from rhot.errors import DeviceError
from rhot_objects.pose import Pose

HEAD: Final = "head"
"""The object id that stands for the headset: it is published on `rhot/head`."""


@dataclass(frozen=True, slots=True)
class PoseSample:
    """The measured pose of one device at one time.

    Attributes:
        t_ns: time of the measurement, rig clock.
        pose: T_space_device; maps the device's coordinates to the tracker's space, metres.
    """

    t_ns: int
    pose: Pose


class SpaceMovedError(DeviceError):
    """The tracking system's space has moved since its registration; retrying does not help."""


class PoseSource(Protocol):
    """A tracking system, a recording of one, or a simulated one."""

    def open(self, start_ns: int) -> None:
        """Connect to the tracking system.

        Args:
            start_ns: rig time at which the session, a recording or the simulated world starts.

        Raises:
            DeviceError: the tracking system is absent; calling `open` again later may succeed.
            ConfigError: a file of the rig folder cannot be used; calling again does not help.
        """
        ...

    def read(self, now_ns: int) -> Mapping[str, PoseSample]:
        """Return the current poses by object id; an object that is not tracked is absent.

        Args:
            now_ns: rig time.

        Raises:
            DeviceError: the connection is lost; call `close`, then `open` again.
            SpaceMovedError: the space has moved since the first pose and has to be registered again.
        """
        ...

    def close(self) -> None:
        """Release the device; may be called repeatedly."""
        ...
