"""From `rhot/head`, `rhot/foot/<side>` and `rhot/hand/<side>` to `rhot/body`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.core import Output
from rhot.geometry.rotations import quaternion_from_rotation, rigid, rotation_from_quaternion
from rhot.messages import BodyJoint, BodyPose, FootPose, HandPose, HeadPose, LegAngles, Position, Quaternion
from rhot.messages.base import wire_position, wire_quaternion
from rhot.rig import Rig
from rhot.types import Side, State
from rhot_ik.legs.foot_track import LEAD_S, FootTrack, HipMotion
from rhot_ik.legs.hips import OUTWARDS, Ankle, LegPose, bend_leg, hip_joint, hips_under_head, stride, within_reach
from rhot_ik.legs.upper_body import solve_upper_body

# How long a person really is from the neck to the ankles: learned from standing.
#
# Lengths that follow from the height are off by centimetres for most people, and so is a marker on its instep; near
# the straight leg one centimetre bends a knee by more than 10°. Who stands with both feet side by side has straight
# legs. What is left over between hips and ankles then, or missing, goes half to the legs and half to the trunk, which
# vary about equally, as far as both legs agree, and to the height of each ankle as far as they do not. It is learned
# quickly in the first seconds, slowly later, and upwards faster than downwards, since a person may stand with bent
# knees, but no leg is longer than it is.

_STANDING: Final = 0.999
"""Hip to ankle of a standing leg over its length: 5° of flexion."""
_MOST: Final = 0.05
"""Of what is learned, as a share of legs and trunk."""
_UPWARDS: Final = 3.0
"""How much faster lengths grow than shrink; chosen."""
_LEGS_SHARE: Final = 0.5
"""Of what is learned, the part that the legs get where nobody measured them."""
_MOST_ANKLE_M: Final = 0.015
"""Bound of what is learned of an ankle's height; chosen."""


class Stature:
    """Learns the lengths of one person.

    Attributes:
        body: lengths as far as they are known.
        ankles_m: side to how much higher the ankle is than the foot's configuration says.

    Args:
        body: by the configuration.
        legs_known: the legs were measured: only the trunk is learned.
    """

    def __init__(self, body: BodyModel, *, legs_known: bool) -> None:
        self._configured = body
        self._legs_share = 0.0 if legs_known else _LEGS_SHARE
        self._longer_m = 0.0
        self._stood_s = 0.0
        self.body = body
        self.ankles_m: dict[Side, float] = {"left": 0.0, "right": 0.0}

    def update(self, T_rig_hips: FloatArray, ankles: Mapping[Side, Ankle], elapsed_s: float) -> None:
        """Update with a moment of standing still, feet side by side.

        Args:
            T_rig_hips: (4, 4) as they hang from the head.
            ankles: one foot or both.
            elapsed_s: since the moment before.
        """
        leg_m = self.body.leg_m
        R, position = T_rig_hips[:3, :3], T_rig_hips[:3, 3]
        off_m = {
            side: float(np.linalg.norm(position + R @ hip_joint(side, self.body) - ankle.position)) - _STANDING * leg_m
            for side, ankle in ankles.items()
        }
        # A leg that is shorter than straight by this share is bent, not measured wrongly.
        if max(abs(off) for off in off_m.values()) > 0.05 * leg_m:
            return
        # Half of what is off is learned in the first half second of standing. Chosen: people are asked to
        # stand for two or three (`docs/feet.md`).
        share = elapsed_s / (0.5 + self._stood_s)
        # From so much standing on, what is new is averaged over this time; chosen.
        self._stood_s = min(self._stood_s + elapsed_s, 30.0)
        both_m = sum(off_m.values()) / len(off_m)
        for side, off in off_m.items():
            ankle_m = self.ankles_m[side] + share * (off - both_m)
            self.ankles_m[side] = float(np.clip(ankle_m, -_MOST_ANKLE_M, _MOST_ANKLE_M))
        most_m = _MOST * (self._configured.leg_m + self._configured.neck_height_m)
        share *= _UPWARDS if both_m > 0.0 else 1.0
        self._longer_m = float(np.clip(self._longer_m + min(share, 1.0) * both_m, -most_m, most_m))
        legs_m = self._legs_share * self._longer_m
        self.body = self._configured.lengthened(legs_m, self._longer_m - legs_m)


# Jumps of a tracked position: found by what bodies cannot do, and bridged at a speed that they can.
#
# A tracker that loses its map goes on at another position, and may come back. Between two samples its increment i
# should be about v·Δt, with v the velocity that was last believed, τ ago; a body changes its velocity by no more than
# A·τ. An increment is a jump when
#
#     |i − v·Δt| > n + A·τ·Δt    or    |i| > V·Δt + n,
#
# with noise n, largest acceleration A and largest speed V. τ grows while increments are refused, so that a real kick
# is believed at the next sample, while a position that is merely elsewhere costs that one increment. What was jumped
# is kept as an offset that shrinks at a speed at which the body could have gone there. When the tracker comes back,
# so does the offset, to nothing.


@dataclass(frozen=True, slots=True)
class JumpLimits:
    """What a part of the body can do.

    Attributes:
        acceleration: m/s², largest.
        speed: m/s, largest.
        bridging: m/s, at most, at which an offset shrinks.
    """

    acceleration: float
    speed: float
    bridging: float


FOOT: Final = JumpLimits(acceleration=150.0, speed=8.0, bridging=2.0)
"""The ankle markers of three real walks (`../shared/data/vive_tracker`, motion capture) reach 52 m/s² and 3.1 m/s;
thrice that leaves room for running and kicks. 8 m/s is the swing of a sprinting foot."""
HEAD: Final = JumpLimits(acceleration=60.0, speed=4.0, bridging=1.0)
"""The waists of the same walks reach 11 m/s² and 0.6 m/s; five times that leaves room for nods and dodges."""

_NOISE_M: Final = 0.02
"""Of a tracker, between two samples."""
_LONGEST_GAP_S: Final = 0.3
"""After a longer pause nothing is known about where a body went."""
_FORGET_S: Final = 0.1
"""A velocity that was believed so long ago says nothing about now."""


@dataclass(frozen=True, slots=True)
class Bridged:
    """A position without its jumps.

    Attributes:
        position: (3,) metres.
        velocity: (3,) m/s, as last believed.
        bridging: it is away from what the tracker says by more than noise.
        jumped: this very sample jumped.
    """

    position: FloatArray
    velocity: FloatArray
    bridging: bool
    jumped: bool


class JumpBridge:
    """Follows one tracked position.

    Args:
        limits: of the part of the body that wears the tracker.
    """

    def __init__(self, limits: JumpLimits) -> None:
        self._limits = limits
        self._t_ns: int | None = None
        self._believed_ns = 0
        self._measured = np.zeros(3)
        self._velocity = np.zeros(3)
        self._offset = np.zeros(3)
        self.jumps = 0

    def update(self, t_ns: int, position: FloatArray) -> Bridged:
        """Return the position (3,) of a sample, metres, without jumps; samples must not go back in time."""
        before_ns, before = self._t_ns, self._measured
        elapsed_s = 0.0 if before_ns is None else 1e-9 * (t_ns - before_ns)
        if before_ns is not None and elapsed_s <= 0.0:
            return self._bridged(before + self._offset, jumped=False)
        self._t_ns, self._measured = t_ns, position
        if before_ns is None or elapsed_s > _LONGEST_GAP_S:
            self._believed_ns, self._velocity, self._offset = t_ns, np.zeros(3), np.zeros(3)
            return self._bridged(position, jumped=False)
        increment = position - before
        unsure_s = 1e-9 * (t_ns - self._believed_ns)
        if unsure_s > _FORGET_S:
            self._velocity = np.zeros(3)
        jumped = self._is_jump(increment, elapsed_s, unsure_s)
        if jumped:
            self.jumps += 1
            self._offset = self._offset + self._velocity * elapsed_s - increment
        else:
            self._velocity, self._believed_ns = increment / elapsed_s, t_ns
            self._shrink(elapsed_s)
        return self._bridged(position + self._offset, jumped=jumped)

    def _is_jump(self, increment: FloatArray, elapsed_s: float, unsure_s: float) -> bool:
        limits = self._limits
        change_m = float(np.linalg.norm(increment - self._velocity * elapsed_s))
        moved_m = float(np.linalg.norm(increment))
        return (
            change_m > _NOISE_M + limits.acceleration * unsure_s * elapsed_s
            or moved_m > _NOISE_M + limits.speed * elapsed_s
        )

    def _shrink(self, elapsed_s: float) -> None:
        left_m = float(np.linalg.norm(self._offset))
        if left_m == 0.0:
            return
        speed = self._limits.speed - float(np.linalg.norm(self._velocity))
        # M/s: an offset shrinks at least so fast, however fast the body moves.
        step_m = elapsed_s * min(max(speed, 0.25), self._limits.bridging)
        self._offset = self._offset * max(1.0 - step_m / left_m, 0.0)

    def _bridged(self, position: FloatArray, *, jumped: bool) -> Bridged:
        away = float(np.linalg.norm(self._offset)) > _NOISE_M
        return Bridged(position, self._velocity, away, jumped)


# The whole lower body from the head and the feet: hips, knees, ankles, balls of the feet, joint angles.


@dataclass(frozen=True, slots=True)
class BodySolution:
    """A solved lower body.

    Attributes:
        joints: name as in `BodyPose` to (4, 4) in the rig frame.
        legs: side to the leg.
        angles_rad: side to (5,): hip flexion, abduction and rotation, knee flexion, ankle flexion as in `LegAngles`.
    """

    joints: Mapping[str, FloatArray]
    legs: Mapping[Side, LegPose]
    angles_rad: Mapping[Side, FloatArray]


def solve_body(T_rig_hips: FloatArray, ankles: Mapping[Side, Ankle], body: BodyModel) -> BodySolution:
    """Return the lower body between the hips and the ankles that are known.

    Args:
        T_rig_hips: (4, 4) middle between the hip joints.
        ankles: one foot or both.
        body: lengths.
    """
    R_hips = T_rig_hips[:3, :3]
    joints: dict[str, FloatArray] = {"hips": T_rig_hips}
    legs: dict[Side, LegPose] = {}
    angles: dict[Side, FloatArray] = {}
    for side, ankle in ankles.items():
        hip = R_hips @ hip_joint(side, body) + T_rig_hips[:3, 3]
        leg = bend_leg(hip, ankle.position, _hinge(R_hips, ankle, hip), body.thigh_m, body.shank_m)
        R_foot = ankle.T_rig_ankle[:3, :3]
        legs[side] = leg
        joints[f"{side}_hip"] = rigid(leg.R_thigh, leg.hip)
        joints[f"{side}_knee"] = rigid(leg.R_shank, leg.knee)
        joints[f"{side}_ankle"] = rigid(R_foot, leg.ankle)
        joints[f"{side}_foot"] = rigid(R_foot, leg.ankle + R_foot @ body.ball_m)
        angles[side] = _angles(R_hips, leg, R_foot, OUTWARDS[side])
    return BodySolution(joints, legs, angles)


def _hinge(R_hips: FloatArray, ankle: Ankle, hip: FloatArray) -> FloatArray:
    """Return the direction (3,) of the knee's axis: between those of the foot and of the hips.

    Both are weighed by how much of them lies across the leg, so that the mixture never vanishes and never jumps while a
    foot rolls along the leg.
    """
    line = ankle.position - hip
    down = line / max(float(np.linalg.norm(line)), 1e-9)
    hinge = np.zeros(3)
    # How much a knee points where the toes do, and how much where the hips do.
    share = 0.75 * ankle.trust
    for direction, weight in ((ankle.T_rig_ankle[:3, 0], share), (R_hips[:, 0], 1.0 - share)):
        across = direction - (direction @ down) * down
        # A foot turned backwards is a wrong measurement: it must not turn the knee.
        # Cosine to the hips' own axis from which on a direction counts in full; 84°. Chosen.
        agreement = float(np.clip((across @ R_hips[:, 0]) / 0.1, 0.0, 1.0))
        hinge += weight * agreement * across
    if float(np.linalg.norm(hinge)) < 1e-3:
        # The leg lies along the hips' own axis: the hips' front decides.
        hinge = np.cross(down, -R_hips[:, 2])
    return hinge if float(np.linalg.norm(hinge)) > 1e-6 else np.cross(down, R_hips[:, 1])


def _angles(R_hips: FloatArray, leg: LegPose, R_foot: FloatArray, outwards: float) -> FloatArray:
    """Return (5,) angles of a leg: R_hipsᵀ R_thigh = Rx(flexion) · Rz(abduction) · Ry(rotation), ankle about +X.

    Flexion forwards, abduction away from the other leg, rotation with the toes outwards, toes upwards.
    """
    thigh = R_hips.T @ leg.R_thigh
    abduction = np.arcsin(np.clip(-thigh[0, 1], -1.0, 1.0))
    flexion = np.arctan2(thigh[2, 1], thigh[1, 1])
    rotation = np.arctan2(thigh[0, 2], thigh[0, 0])
    foot = leg.R_shank.T @ R_foot
    ankle = np.arctan2(foot[2, 1], foot[1, 1])
    return np.array([flexion, outwards * abduction, -outwards * rotation, leg.knee_flexion_rad, ankle])


BODY_KEY: Final = "rhot/body"
_ANGLES: Final = tuple(LegAngles.model_fields)
_STALE_NS: Final = 300_000_000
"""A foot, hand or head that was not heard of for so long is not known."""
_LEAD_NS: Final = round(1e9 * LEAD_S)
"""A foot that is older than the other by less than this is carried on by its velocity."""
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
        # Poses of both feet that are no further apart are of one moment.
        if any(
            self._solved.get(side) == foot.t_ns and 2_000_000 < newest_ns - foot.t_ns < _LEAD_NS
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
        # A longer pause counts as one of this length.
        elapsed_s = min(max(1e-9 * (t_ns - self._solved_ns), 0.0), 0.1)
        hanging = hips_under_head(T_rig_head, ankles, self._up, self._stature.body)
        # Somebody stands, the feet side by side.
        # Feet whose ankles are no further apart along the body's front stand side by side: half a foot's
        # length. Chosen.
        if all(track.stands for track in self._tracks.values()) and stride(ankles, hanging[:3, 2]) < 0.12:
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
            # Over which the velocity of the hips is averaged; chosen.
            velocity = velocity - np.expm1(-elapsed_s / 0.05) * (moved - velocity)
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
