"""The pose of SteamVR's standing space, for which a registration is valid.

`GetRawZeroPoseToStandingAbsoluteTrackingPose` is the transform from the base stations' raw space to the standing space.
Resetting the standing position changes it (event `VREvent_StandingZeroPoseReset`, 808); other base stations or a new
room setup create another raw space with another universe (`VREvent_ChaperoneUniverseHasChanged`, 801). Names and
numbers are from openvr.h.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rhot_objects.pose import Pose, angle_between

MOVED_EVENTS: Final = {801: "its universe has changed", 808: "its standing position was reset"}
_CURRENT_UNIVERSE: Final = 2004
"""`Prop_CurrentUniverseId_Uint64`."""
_HEADSET: Final = 0
"""`k_unTrackedDeviceIndex_Hmd`."""
_SAME_M: Final = 1e-3
_SAME_RAD: Final = 1e-3
"""Tolerances for an unchanged space; far below the error of a registration (docs/tested.md: 1.4 mm)."""


@dataclass(frozen=True, slots=True)
class TrackingSpace:
    """A standing space.

    Attributes:
        universe: id of the base stations' setup.
        T_standing_raw: maps the base stations' space to the standing space.
    """

    universe: int
    T_standing_raw: Pose

    def moved_from(self, other: TrackingSpace) -> str:
        """Return a description of the difference from an earlier space; empty when there is none."""
        if self.universe != other.universe:
            return MOVED_EVENTS[801]
        first, second = self.T_standing_raw, other.T_standing_raw
        distance_m = float(np.linalg.norm(first.position - second.position))
        if distance_m > _SAME_M or angle_between(first, second) > _SAME_RAD:
            return f"{MOVED_EVENTS[808]}, by {distance_m:.2f} m"
        return ""


def read_space(openvr: Any, system: Any) -> TrackingSpace | None:
    """Return SteamVR's standing space; None if SteamVR does not report it."""
    try:
        universe = int(system.getUint64TrackedDeviceProperty(_HEADSET, _CURRENT_UNIVERSE))
        matrix = system.getRawZeroPoseToStandingAbsoluteTrackingPose()
        return TrackingSpace(universe, Pose.from_matrix([[matrix.m[row][k] for k in range(4)] for row in range(3)]))
    except (openvr.OpenVRError, KeyError, ValueError):
        # KeyError: error codes that pyopenvr does not know.
        return None
