"""Where the hips are when only the head and the feet are seen.

The trunk hangs from the head's pivot as a rod of known length N. How it leans is not measured; three things are known
of people: their trunk leans a little forwards; more so when they look down, and the deeper they crouch with their feet
side by side; and while they stand their weight is over their soles. With the lean l (share of N by which the hips lie
behind the pivot), its usual value l₀, the weight's position c(l) = n − (1 − s)·N·l (n the pivot, s the trunk's share)
and the part m of the soles that is nearest to c(l₀), all along the level forward direction, the lean minimises

    ((l − l₀) / σ_lean)² + w · ((c(l) − m) / σ_balance)²,

where w falls to nothing when the weight is far behind the feet, as of somebody who sits. Then the hips go where both
legs reach. Turned are they by the feet, and a little by the head.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rigid
from rhot.types import Side

# One leg in closed form: a thigh and a shank on a hinge, between a hip joint and an ankle.
#
# A chain of two bones whose hinge axis is known has one solution (the law of cosines), so that nothing is iterated:
# with d the distance from hip to ankle, the knee lies d/2 + (a² − b²)/(2 d) along that line and as far in front of it
# as the thigh's length asks. The bend is to the front of the hinge axis by construction: a knee cannot point
# backwards.


@dataclass(frozen=True, slots=True)
class Ankle:
    """An ankle at a moment.

    Attributes:
        T_rig_ankle: (4, 4), axes level when the foot stands flat.
        trust: 1 = as measured, 0 = only guessed.
    """

    T_rig_ankle: FloatArray
    trust: float = 1.0

    @property
    def position(self) -> FloatArray:
        """(3,) metres, rig frame."""
        position: FloatArray = self.T_rig_ankle[:3, 3]
        return position


@dataclass(frozen=True, slots=True)
class LegPose:
    """A solved leg; frames as in `rhot.messages.BodyJoint`.

    Attributes:
        hip, knee, ankle: (3,) metres. The ankle differs from the asked one where that was out of reach.
        R_thigh, R_shank: (3, 3); +X along the hinge to the body's right, +Y along the bone towards the hip.
        knee_flexion_rad: 0 = straight.
    """

    hip: FloatArray
    knee: FloatArray
    ankle: FloatArray
    R_thigh: FloatArray
    R_shank: FloatArray
    knee_flexion_rad: float


def bend_leg(hip: FloatArray, ankle: FloatArray, hinge: FloatArray, thigh_m: float, shank_m: float) -> LegPose:
    """Return the leg between a hip joint and an ankle, (3,) metres.

    Args:
        hip, ankle: (3,) metres; the ankle is moved along the line to the hip where it is out of reach, and by up
            to 0.3 % of the leg's length where the leg is straight.
        hinge: (3,) direction of the knee's axis, to the body's right; the part of it across the leg counts, and it must
            have one.
        thigh_m, shank_m: lengths.
    """
    line = ankle - hip
    reach = float(np.linalg.norm(line))
    length = thigh_m + shank_m
    down = _unit(line) if reach > 1e-9 else _unit(np.cross(_across(hinge), hinge))
    # Ankle to hip is no shorter than this share of the leg: the flesh of thigh and calf meets at about 150° of
    # flexion.
    distance = max(_softened(reach, length), 0.25 * length, 1.001 * abs(thigh_m - shank_m))
    right = _unit(hinge - (hinge @ down) * down)
    front = np.cross(right, down)
    along = (distance**2 + thigh_m**2 - shank_m**2) / (2.0 * distance)
    off = float(np.sqrt(max(thigh_m**2 - along**2, 0.0)))
    knee = hip + along * down + off * front
    end = hip + distance * down
    cosine = (thigh_m**2 + shank_m**2 - distance**2) / (2.0 * thigh_m * shank_m)
    flexion = float(np.pi - np.arccos(np.clip(cosine, -1.0, 1.0)))
    return LegPose(hip, knee, end, _bone_frame(hip - knee, right), _bone_frame(knee - end, right), flexion)


def _bone_frame(up: FloatArray, right: FloatArray) -> FloatArray:
    y = _unit(up)
    return np.stack([right, y, np.cross(right, y)], axis=-1)


def _softened(reach_m: float, length_m: float) -> float:
    """Return the distance from hip to ankle that a leg takes on for an asked one.

    Near the straight leg the knee's position goes with the root of what is left, and an error of millimetres would make
    it jump by centimetres; so the last bit is approached exponentially ("soft IK", known from character animation).
    """
    # The last part of the leg's length, over which it straightens ever more slowly.
    soft_m = 0.008 * length_m
    begin_m = length_m - soft_m
    if reach_m <= begin_m:
        return reach_m
    return length_m - soft_m * float(np.exp(-(reach_m - begin_m) / soft_m))


def _unit(vector: FloatArray) -> FloatArray:
    unit: FloatArray = vector / np.linalg.norm(vector)
    return unit


def _across(direction: FloatArray) -> FloatArray:
    """Return the axis (3,) that a direction has least of: any that is not parallel to it."""
    axis = np.zeros(3)
    axis[int(np.argmin(np.abs(direction)))] = 1.0
    return axis


OUTWARDS: Final[Mapping[Side, float]] = {"left": -1.0, "right": 1.0}
"""Direction of a leg from the middle, along the body's +X."""

_LEAN: Final = 0.06
_LOOKING_LEAN: Final = 0.16
_CROUCHING_LEAN: Final = 0.4
"""Usual lean of an upright trunk; what is added for looking straight down; and per leg's length by which the pivot is
lowered. Chosen, not measured: walking trunks lean by 2 to 7°, squatting ones by 30 to 45° with the thighs level."""
_MOST_LEAN: Final = 0.95
"""Sine of 72°: beyond it the level direction of the trunk is not defined any more."""
_HEAD_WEIGHT: Final = 0.35
"""Of the head's heading beside that of both feet, 1. Chosen: heads turn without the hips, too."""
_ROUNDS: Final = 12
"""Most rounds of projections onto the balls of reach."""


def estimate_hips(T_rig_head: FloatArray, ankles: Mapping[Side, Ankle], up: FloatArray, body: BodyModel) -> FloatArray:
    """Return T_rig_hips (4, 4), the middle between the hip joints, +Y up and +X to the body's right.

    Args:
        T_rig_head: (4, 4) headset, OpenXR axes.
        ankles: one foot or both.
        up: (3,) unit vector against gravity.
        body: lengths.
    """
    return within_reach(hips_under_head(T_rig_head, ankles, up, body), ankles, body)


def hips_under_head(
    T_rig_head: FloatArray, ankles: Mapping[Side, Ankle], up: FloatArray, body: BodyModel
) -> FloatArray:
    """Return the hips as of `estimate_hips` before they go where the legs reach."""
    right = _level_right(T_rig_head, ankles, up)
    forward = np.cross(up, right)
    neck = T_rig_head[:3, :3] @ np.array(body.neck_m) + T_rig_head[:3, 3]
    above = neck - np.mean([ankle.position for ankle in ankles.values()], axis=0)
    lowered_m = body.leg_m + body.neck_height_m - float(above @ up)
    down = float(T_rig_head[:3, 2] @ up)
    trust = min(ankle.trust for ankle in ankles.values())
    lean = _lean(float(above @ forward), lowered_m, stride(ankles, forward), down, trust, body)
    hips = neck - body.neck_height_m * (lean * forward + np.sqrt(1.0 - lean**2) * up)
    return rigid(np.stack([right, up, -forward], axis=-1), hips)


def within_reach(T_rig_hips: FloatArray, ankles: Mapping[Side, Ankle], body: BodyModel) -> FloatArray:
    """Return the hips (4, 4), not turned, at the nearest position from which every leg reaches its ankle.

    Alternating projections onto the balls of reach (von Neumann 1950); feet that are too far apart for both legs end
    with the middle between the balls. The less an ankle is known, the farther it may be out of reach.
    """
    R, position = T_rig_hips[:3, :3], T_rig_hips[:3, 3].copy()
    for _ in range(_ROUNDS):
        moved = False
        for side, ankle in ankles.items():
            line = position + R @ hip_joint(side, body) - ankle.position
            reach = float(np.linalg.norm(line))
            # Keeps the slack of a foot that is not trusted finite: 10 m.
            doubt = 1.0 / max(ankle.trust, 0.01) - 1.0
            # Share of a leg's length that the hips may be away from its ankle: 9° of flexion are left to
            # the knee.
            # How far a foot that is trusted by half may be out of reach before it pulls the hips. Chosen:
            # the error of the pendulum by which such a foot swings.
            over = reach - 0.997 * body.leg_m - doubt * 0.1
            if over > 0.0:
                position -= line * (over / reach)
                moved = True
        if not moved:
            break
    return rigid(R, position)


def hip_joint(side: Side, body: BodyModel) -> FloatArray:
    """Return the position (3,) of a hip joint in the frame of the hips, metres."""
    return np.array([OUTWARDS[side] * body.hip_width_m / 2.0, 0.0, 0.0])


def stride(ankles: Mapping[Side, Ankle], forward: FloatArray) -> float:
    """Return how far one foot is before the other along a level direction (3,)."""
    along = [float(ankle.position @ forward) for ankle in ankles.values()]
    return max(along) - min(along)


def _lean(pivot_m: float, lowered_m: float, stride_m: float, down: float, trust: float, body: BodyModel) -> float:
    """Return the lean of the trunk, as a share of its length.

    Args:
        pivot_m: how far the head's pivot is before the feet's middle.
        lowered_m: how much lower the pivot is than when standing straight.
        stride_m: how far one foot is before the other: who lunges or kneels keeps the trunk upright.
        down: sine of the angle by which the head looks down.
        trust: in the feet, 0 to 1: over feet that are only guessed nobody is balanced.
        body: lengths.
    """
    # S: of head, arms and trunk, as a share of what must be balanced; the rest is thighs and hips. Chosen.
    lever = (1.0 - 0.62) * body.neck_height_m
    usual = _LEAN + _LOOKING_LEAN * max(down, 0.0)
    excess = _outside_soles(pivot_m - lever * usual, body)
    # How far behind the heels the weight lies when w has fallen to a quarter. Chosen, not measured.
    standing = 1.0 / (1.0 + (min(excess, 0.0) / 0.25) ** 2) ** 2
    # Distance between the feet, along the body's front, that halves the lean of crouching. Chosen.
    usual += _CROUCHING_LEAN * standing * max(lowered_m, 0.0) / body.leg_m / (1.0 + (stride_m / 0.2) ** 2)
    excess = _outside_soles(pivot_m - lever * usual, body)
    # Σ_lean, a share of the trunk's length: 11°. Chosen, not measured.
    # Σ_balance, about a third of a foot's length. Chosen, not measured.
    weight = trust * standing * (0.20 / 0.08) ** 2
    return float(np.clip(usual + weight * lever * excess / (1.0 + weight * lever**2), -_MOST_LEAN, _MOST_LEAN))


def _outside_soles(weight_m: float, body: BodyModel) -> float:
    """Return how far the weight, this far before the ankles, lies before the balls (+) or behind the heels (−)."""
    return weight_m - float(np.clip(weight_m, -body.heel_m, -float(body.ball_m[2])))


def _level_right(T_rig_head: FloatArray, ankles: Mapping[Side, Ankle], up: FloatArray) -> FloatArray:
    """Return the body's level direction to the right (3,): that of the feet, a little of the head.

    A foot's +X axis stays level while the foot pitches, so that its heading is known with the heel up, too.
    """
    head = _level(T_rig_head[:3, 0], up)
    feet = sum((ankle.trust * _level(ankle.T_rig_ankle[:3, 0], up) for ankle in ankles.values()), start=np.zeros(3))
    total = _HEAD_WEIGHT * head + feet / len(ankles)
    for direction in (total, head, np.cross(T_rig_head[:3, 2], up), np.cross(up, np.roll(up, 1) + 1.0)):
        level = _level(direction, up)
        if (norm := float(np.linalg.norm(level))) > 0.05:
            return level / norm
    raise ValueError(f"up = {up} has no level direction")


def _level(direction: FloatArray, up: FloatArray) -> FloatArray:
    level: FloatArray = direction - (direction @ up) * up
    return level
