"""From `rhot/head` and `rhot/foot/<side>` to `rhot/body`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.body_anatomy import BodyModel
from rhot.messages import BodyJoint, BodyPose, FootPose, HeadPose, LegAngles, Position, Quaternion, Side
from rhot.rig import Rig
from rhot.rotations import quaternion_from_rotation, rotation_from_quaternion, rotation_from_vector
from rhot.stage import Output
from rhot.transforms import rigid
from rhot.wire_vectors import wire_position, wire_quaternion
from rhot_ik.legs.body_solver import BodySolution, solve_body
from rhot_ik.legs.hips import estimate_hips

FloatArray = NDArray[np.float64]

BODY_KEY: Final = "rhot/body"
_ANGLES: Final = tuple(LegAngles.model_fields)
_STALE_NS: Final = 300_000_000
"""A foot or head that was not heard of for so long is not known."""
_TOGETHER_NS: Final = 2_000_000
_LEAD_NS: Final = 60_000_000
"""A foot that is older than the other by less than this is carried on by its velocity."""
_LEARNING: Final = 0.03
_LEAST_LEVEL: Final = 0.77
"""Cosine of the steepest instep, 40°."""


class FootLevel:
    """How a foot's marker sits on its instep: learnt from stands, where the sole is level.

    Attributes:
        R_foot_level: (3, 3) from the axes of the ankle, level when the foot stands flat, to those of `FootPose`.
    """

    def __init__(self) -> None:
        self._up = np.array([0.0, 1.0, 0.0])
        self.R_foot_level: FloatArray = np.eye(3)

    def learn(self, R_rig_foot: FloatArray, up: FloatArray) -> None:
        """Take one sample of a foot that stands still; one tipped by more than an instep is no stand."""
        seen = R_rig_foot.T @ up
        if seen[1] < _LEAST_LEVEL:
            return
        self._up = self._up + _LEARNING * (seen - self._up)
        up_in_foot = self._up / np.linalg.norm(self._up)
        axis = np.cross([0.0, 1.0, 0.0], up_in_foot)
        sine = float(np.linalg.norm(axis))
        if sine > 1e-9:
            self.R_foot_level = rotation_from_vector(axis / sine * float(np.arctan2(sine, up_in_foot[1])))


class BodyStage:
    """The core of leg solving: keeps the newest head and feet, and solves when all feet that are tracked have moved on.

    Args:
        rig: with `[feet]` and `[body]`; without feet nothing comes out.
    """

    def __init__(self, rig: Rig) -> None:
        feet = rig.config.feet
        self._body = BodyModel.from_config(rig.config.body)
        self._up = np.array([0.0, 1.0, 0.0] if feet is None else feet.up)
        self._up /= np.linalg.norm(self._up)
        self._ankle_m = {} if feet is None else {side: np.array(foot.ankle_m) for side, foot in feet.feet.items()}
        self._level = {side: FootLevel() for side in self._ankle_m}
        self._head: HeadPose | None = None
        self._feet: dict[Side, FootPose] = {}
        self._told: dict[Side, int] = {}
        self._counts = {"bodies": 0, "no_head": 0}

    @property
    def counts(self) -> Mapping[str, int]:
        """`bodies` solved; `no_head`: feet came without the head that the hips hang from."""
        return self._counts

    def feed(self, message: HeadPose | FootPose) -> list[Output]:
        """Return the `BodyPose` that follows from a message; most often nothing or one."""
        if isinstance(message, HeadPose):
            self._head = message
            return []
        if message.side not in self._ankle_m:
            return []
        self._feet[message.side] = message
        if message.stationary and message.state == "measured":
            self._level[message.side].learn(rotation_from_quaternion(np.array(message.orientation)), self._up)
        newest_ns = max(foot.t_ns for foot in self._feet.values())
        known = {side: foot for side, foot in self._feet.items() if newest_ns - foot.t_ns < _STALE_NS}
        # A foot whose newest sample has been used is waited for, unless it stays away for longer than it is carried on.
        if any(
            self._told.get(side) == foot.t_ns and _TOGETHER_NS < newest_ns - foot.t_ns < _LEAD_NS
            for side, foot in known.items()
        ):
            return []
        self._told = {side: foot.t_ns for side, foot in known.items()}
        if self._head is None or newest_ns - self._head.t_ns > _STALE_NS:
            self._counts["no_head"] += 1
            return []
        self._counts["bodies"] += 1
        return [(BODY_KEY, self._solve(self._head, known, newest_ns))]

    def _solve(self, head: HeadPose, feet: Mapping[Side, FootPose], t_ns: int) -> BodyPose:
        T_rig_head = _transform(head.position, head.orientation)
        ankles = {side: self._ankle(foot, t_ns) for side, foot in sorted(feet.items())}
        hips = estimate_hips(T_rig_head, ankles, self._up, self._body)
        return body_pose(solve_body(hips, ankles, self._body), head, feet, t_ns)

    def _ankle(self, foot: FootPose, t_ns: int) -> FloatArray:
        T_rig_foot = _transform(foot.position, foot.orientation)
        lead_s = min(t_ns - foot.t_ns, _LEAD_NS) / 1e9
        place = T_rig_foot[:3, :3] @ self._ankle_m[foot.side] + T_rig_foot[:3, 3]
        R_rig_level = T_rig_foot[:3, :3] @ self._level[foot.side].R_foot_level
        return rigid(R_rig_level, place + lead_s * np.array(foot.velocity))


def body_pose(solution: BodySolution, head: HeadPose, feet: Mapping[Side, FootPose], t_ns: int) -> BodyPose:
    """Return the message that carries a solution."""
    names = list(solution.joints)
    poses = np.stack([solution.joints[name] for name in names])
    positions, quaternions = poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3])
    measured = head.state == "measured" and any(foot.state == "measured" for foot in feet.values())
    return BodyPose(
        t_ns=t_ns,
        frame=head.frame,
        joints={
            name: BodyJoint(position=wire_position(position), orientation=wire_quaternion(quaternion))
            for name, position, quaternion in zip(names, positions, quaternions, strict=True)
        },
        angles={
            side: LegAngles(**dict(zip(_ANGLES, values.tolist(), strict=True)))
            for side, values in solution.angles_rad.items()
        },
        legs={side: feet[side].state for side in solution.legs},
        state="measured" if measured else "predicted",
    )


def _transform(position: Position, orientation: Quaternion) -> FloatArray:
    return rigid(rotation_from_quaternion(np.array(orientation)), np.array(position))
