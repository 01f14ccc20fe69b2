"""Where poses come from: the seam between the objects service and a tracking system.

A source speaks in the *tracker's own space*; `rhot_objects.registration` brings its poses into the rig frame.

`open` and `read` may block for a moment and come from one thread at a time; `close` may come from another thread while
`read` still runs, because a thread cannot be cancelled.
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
    """One tracked device at one moment, backed by an observation of that moment.

    Attributes:
        t_ns: the moment at which the pose is true, rig clock.
        pose: T_space_device; maps the device's coordinates to the tracker's space, metres.
    """

    t_ns: int
    pose: Pose


class SpaceMovedError(DeviceError):
    """The tracking system's space is not where it was registered any more; looking again does not help."""


class PoseSource(Protocol):
    """A tracking system, a recording of one, or a simulated one."""

    def open(self, start_ns: int) -> None:
        """Connect and make ready.

        Args:
            start_ns: rig time at which the session starts; recordings and the simulated world begin there.

        Raises:
            DeviceError: the tracking system is absent; calling `open` again later may succeed.
            ConfigError: a file of the rig folder cannot be used; calling again does not help.
        """
        ...

    def read(self, now_ns: int) -> Mapping[str, PoseSample]:
        """Return the poses at this moment by object id; what is not tracked right now is absent.

        Args:
            now_ns: rig time.

        Raises:
            DeviceError: the tracking system went away; `close`, then `open` again.
            SpaceMovedError: its space has moved since its first pose; register it again.
        """
        ...

    def close(self) -> None:
        """Let go of the device; closing twice does no harm."""
        ...
