"""From `rhot/head`, `rhot/foot/<side>` and `rhot/hand/<side>` to `rhot/body`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.core import Output
from rhot.geometry.rotations import quaternion_from_rotation, rotation_from_quaternion
from rhot.geometry.transforms import rigid
from rhot.messages import (
    BodyJoint,
    BodyPose,
    FootPose,
    HandPose,
    HeadPose,
    LegAngles,
    Position,
    Quaternion,
    Side,
    State,
)
from rhot.messages.base import wire_position, wire_quaternion
from rhot.rig import Rig
from rhot_ik.legs.body_solver import solve_body
from rhot_ik.legs.foot_track import LEAD_S, FootTrack, HipMotion
from rhot_ik.legs.hips import OUTWARDS, hip_joint, hips_under_head, stride, within_reach
from rhot_ik.legs.jumps import FOOT, HEAD, JumpBridge
from rhot_ik.legs.stature import Stature
from rhot_ik.trunk.upper_body import solve_upper_body

BODY_KEY: Final = "rhot/body"
_ANGLES: Final = tuple(LegAngles.model_fields)
_STALE_NS: Final = 300_000_000
"""A foot, hand or head that was not heard of for so long is not known."""
_TOGETHER_NS: Final = 2_000_000
"""Poses of both feet that are no further apart are of one moment."""
_LEAD_NS: Final = round(1e9 * LEAD_S)
"""A foot that is older than the other by less than this is carried on by its velocity."""
_SIDE_BY_SIDE_M: Final = 0.12
"""Feet whose ankles are no further apart along the body's front stand side by side: half a foot's length. Chosen."""
_CALM_S: Final = 0.05
"""Over which the velocity of the hips is averaged; chosen."""
_LONGEST_STEP_S: Final = 0.1
"""A longer pause counts as one of this length."""
_MEASURED: Final = frozenset({"head", *(f"{side}_{end}" for side in OUTWARDS for end in ("ankle", "foot", "wrist"))})
"""Joints next to which something is tracked; the others are inferred."""


class BodyCore:
    """The core of the body: keeps the newest head, feet and hands, and solves when all tracked feet have moved on.

    Args:
        rig: with `[feet]` and `[body]`; without feet nothing comes out.
    """

    def __init__(self, rig: Rig) -> None:
        feet, body = rig.config.feet, rig.config.body
        model = BodyModel.from_config(body)
        self._stature = Stature(model, legs_known=body.thigh_m is not None and body.shank_m is not None)
        self._up = np.array([0.0, 1.0, 0.0] if feet is None else feet.up)
        self._up /= np.linalg.norm(self._up)
        self._tracks = {
            side: FootTrack(np.array(foot.ankle_m), hip_joint(side, model) - [0.0, model.leg_m, 0.0], self._up)
            for side, foot in ({} if feet is None else feet.feet).items()
        }
        self._foot_bridges = {side: JumpBridge(FOOT) for side in self._tracks}
        self._head_bridge = JumpBridge(HEAD)
        self._hip_motion: HipMotion | None = None
        self._solved_ns = 0
        self._head: HeadPose | None = None
        self._feet: dict[Side, FootPose] = {}
        self._hands: dict[Side, HandPose] = {}
        self._solved: dict[Side, int] = {}
        self._counts = {"bodies": 0, "no_head": 0, "jumps": 0}

    @property
    def counts(self) -> Mapping[str, int]:
        """`bodies` solved; `no_head`: feet came without the head that the hips hang from; `jumps` of head or feet."""
        return self._counts

    def feed(self, message: HeadPose | FootPose | HandPose) -> list[Output]:
        """Return the `BodyPose` that follows from a message; most often nothing or one."""
        if isinstance(message, HandPose):
            self._hands[message.side] = message
            return []
        if isinstance(message, HeadPose):
            self._head = self._without_jumps(message)
            return []
        if message.side not in self._tracks:
            return []
        self._feet[message.side] = foot = self._foot_without_jumps(message)
        self._tracks[message.side].update(foot)
        newest_ns = max(foot.t_ns for foot in self._feet.values())
        known = {side: foot for side, foot in self._feet.items() if newest_ns - foot.t_ns < _STALE_NS}
        # A foot whose newest sample has been used is waited for, unless it stays away for longer than it is carried on.
        if any(
            self._solved.get(side) == foot.t_ns and _TOGETHER_NS < newest_ns - foot.t_ns < _LEAD_NS
            for side, foot in known.items()
        ):
            return []
        self._solved = {side: foot.t_ns for side, foot in known.items()}
        if self._head is None or newest_ns - self._head.t_ns > _STALE_NS:
            self._counts["no_head"] += 1
            return []
        self._counts["bodies"] += 1
        return [(BODY_KEY, self._solve(self._head, newest_ns))]

    def _solve(self, head: HeadPose, t_ns: int) -> BodyPose:
        T_rig_head = _transform(head.position, head.orientation)
        higher_m = self._stature.ankles_m
        found = {side: track.at(t_ns, self._hip_motion, higher_m[side]) for side, track in self._tracks.items()}
        ankles = {side: ankle for side, ankle in found.items() if ankle is not None}
        elapsed_s = min(max(1e-9 * (t_ns - self._solved_ns), 0.0), _LONGEST_STEP_S)
        hanging = hips_under_head(T_rig_head, ankles, self._up, self._stature.body)
        # Somebody stands, the feet side by side.
        if all(track.stands for track in self._tracks.values()) and stride(ankles, hanging[:3, 2]) < _SIDE_BY_SIDE_M:
            self._stature.update(hanging, ankles, elapsed_s)
        hips = within_reach(hanging, ankles, self._stature.body)
        self._update_hip_motion(hips, elapsed_s)
        self._solved_ns = t_ns
        states = {side: self._tracks[side].state for side in sorted(ankles)}
        legs: dict[Side, State] = {side: state for side, state in states.items() if state is not None}
        solution = solve_body(hips, {side: ankles[side] for side in legs}, self._stature.body)
        hands = {side: hand for side, hand in self._hands.items() if abs(t_ns - hand.t_ns) < _STALE_NS}
        wrists = {
            side: _transform(wrist.position, wrist.orientation)
            for side, hand in hands.items()
            if hand.frame == head.frame and (wrist := hand.joints.get("wrist")) is not None
        }
        joints = {**solution.joints, **solve_upper_body(hips, T_rig_head, wrists, self._stature.body)}
        arms = {side: hands[side].state for side in sorted(wrists) if f"{side}_wrist" in joints}
        return body_pose(joints, solution.angles_rad, head, legs, arms, t_ns)

    def _without_jumps(self, head: HeadPose) -> HeadPose:
        """Return the head's pose; while a jump of its tracker is bridged it is predicted."""
        bridged = self._head_bridge.update(head.t_ns, np.array(head.position))
        self._counts["jumps"] += bridged.jumped
        if not bridged.bridging:
            return head
        return head.model_copy(update={"position": wire_position(bridged.position), "state": "predicted"})

    def _foot_without_jumps(self, foot: FootPose) -> FootPose:
        """Return the same of a foot, which does not stand while it is bridged."""
        bridged = self._foot_bridges[foot.side].update(foot.t_ns, np.array(foot.position))
        self._counts["jumps"] += bridged.jumped
        if not bridged.bridging:
            return foot
        return foot.model_copy(
            update={
                "position": wire_position(bridged.position),
                "velocity": wire_position(bridged.velocity),
                "stationary": False,
                "state": "predicted",
            }
        )

    def _update_hip_motion(self, hips: FloatArray, elapsed_s: float) -> None:
        """Note where the hips are and how they move, for feet that hang from them."""
        velocity = np.zeros(3)
        if self._hip_motion is not None and elapsed_s > 0.0:
            velocity = self._hip_motion.velocity
            moved = (hips[:3, 3] - self._hip_motion.T_rig_hips[:3, 3]) / elapsed_s
            velocity = velocity - np.expm1(-elapsed_s / _CALM_S) * (moved - velocity)
        self._hip_motion = HipMotion(hips, velocity)


def body_pose(
    joints: Mapping[str, FloatArray],
    angles_rad: Mapping[Side, FloatArray],
    head: HeadPose,
    legs: Mapping[Side, State],
    arms: Mapping[Side, State],
    t_ns: int,
) -> BodyPose:
    """Return the message that carries joints by name, (4, 4) each, whose legs and arms are measured or predicted."""
    names = list(joints)
    poses = np.stack([joints[name] for name in names])
    positions, quaternions = poses[:, :3, 3], quaternion_from_rotation(poses[:, :3, :3])
    measured = head.state == "measured" and "measured" in legs.values()
    return BodyPose(
        t_ns=t_ns,
        frame=head.frame,
        joints={
            name: BodyJoint(position=wire_position(position), orientation=wire_quaternion(quaternion))
            for name, position, quaternion in zip(names, positions, quaternions, strict=True)
        },
        angles={
            side: LegAngles(**dict(zip(_ANGLES, values.tolist(), strict=True))) for side, values in angles_rad.items()
        },
        legs=dict(legs),
        arms=dict(arms),
        inferred=tuple(name for name in names if name not in _MEASURED),
        state="measured" if measured else "predicted",
    )


def _transform(position: Position, orientation: Quaternion) -> FloatArray:
    return rigid(rotation_from_quaternion(np.array(orientation)), np.array(position))
