"""The whole upper body from hips, head and tracked hands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import SPINE_SHARES, BodyModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rigid, rotation_y, shortest_rotation
from rhot.types import Side
from rhot_ik.legs.hips import OUTWARDS, bend_leg

# The spine between hips and neck, as a chain of three bones.
#
# Its ends are known: the hips hang under the head and over the feet, the neck is the head's pivot. Between them the
# chain is straight when it is as long as they are apart; when they are nearer it bends backwards, as a trunk that
# slouches, by the same angle at both of its joints, so that its bones keep their lengths; when they are farther its
# bones are longer by the same share (the person's lengths are not known better than that).
#
# How far the head is turned over the hips is shared between the joints as their ranges are: of 10° in the lumbar, 35°
# in the thoracic and 80° in the cervical spine to either side (White & Panjabi, "Clinical Biomechanics of the Spine",
# 1990, rounded).

_RANGES_DEG: Final = (10.0, 35.0, 80.0)
_TWIST_SHARES: Final = (
    _RANGES_DEG[0] / sum(_RANGES_DEG),
    (_RANGES_DEG[0] + _RANGES_DEG[1]) / sum(_RANGES_DEG),
)
"""Of how far the head is turned over the hips, what `spine_lower` and `chest` have."""
_MOST_TWIST_RAD: Final = math.radians(sum(_RANGES_DEG))
_MOST_BEND_RAD: Final = math.radians(75.0)
"""Of either joint: half of what the trunk flexes at most, hips included."""
_ROUNDS: Final = 24
_LEVEL: Final = 1e-6
_LEAST_LEVEL: Final = 0.3
"""Below this cosine of its tilt aside a head tells ever less of where the trunk faces."""


def spine(T_rig_hips: FloatArray, T_rig_head: FloatArray, body: BodyModel) -> dict[str, FloatArray]:
    """Return `spine_lower`, `chest`, `neck` and `head`, (4, 4) each in the rig frame; frames as in `BodyJoint`.

    Args:
        T_rig_hips: (4, 4), +Y up.
        T_rig_head: (4, 4) headset, OpenXR axes.
        body: lengths.
    """
    R_hips, hips, R_head = T_rig_hips[:3, :3], T_rig_hips[:3, 3], T_rig_head[:3, :3]
    neck = R_head @ np.array(body.neck_m) + T_rig_head[:3, 3]
    skull = R_head @ np.array(body.skull_m) + T_rig_head[:3, 3]
    points = [hips, *_chain(hips, neck, R_hips, body), neck]
    twist = _twist(R_hips, R_head)
    joints: dict[str, FloatArray] = {}
    for name, share, k in (("spine_lower", _TWIST_SHARES[0], 1), ("chest", _TWIST_SHARES[1], 2)):
        right = (R_hips @ rotation_y(share * twist))[:, 0]
        joints[name] = rigid(_upright(points[k + 1] - points[k], right, R_hips), points[k])
    joints["neck"] = rigid(_upright(skull - neck, R_head[:, 0], R_head), neck)
    joints["head"] = rigid(R_head, skull)
    return joints


def _chain(hips: FloatArray, neck: FloatArray, R_hips: FloatArray, body: BodyModel) -> tuple[FloatArray, FloatArray]:
    """Return the two joints (3,) between the hips and the neck."""
    line = neck - hips
    far = float(np.linalg.norm(line))
    up = line / far if far > _LEVEL else R_hips[:, 1]
    lengths = np.array(SPINE_SHARES) * body.neck_height_m
    back = R_hips[:, 2] - (R_hips[:, 2] @ up) * up
    size = float(np.linalg.norm(back))
    # Who bows until the spine points straight ahead: backwards is up then.
    back = back / size if size > _LEVEL else R_hips[:, 1]
    bend = _bend(lengths, far)
    directions = np.array([-bend, 0.0, bend])
    along, aside = lengths * np.cos(directions), -lengths * np.sin(directions)
    # In the chain's own plane its end lies far from its beginning, at an angle that is taken out.
    end = np.array([along.sum(), aside.sum()])
    reached = float(np.linalg.norm(end))
    unit = end / max(reached, _LEVEL)
    places = []
    for k in (1, 2):
        place = np.array([along[:k].sum(), aside[:k].sum()])
        share = far / max(reached, _LEVEL)
        across = share * (unit[0] * place[1] - unit[1] * place[0])
        places.append(hips + share * float(unit @ place) * up + across * back)
    return places[0], places[1]


def _bend(lengths: FloatArray, far_m: float) -> float:
    """Return the angle at both joints by which three bones span a distance; 0 where they are too short."""
    low, high = 0.0, _MOST_BEND_RAD
    first, middle, last = lengths.tolist()
    for _ in range(_ROUNDS):
        half = 0.5 * (low + high)
        span = math.hypot(middle + (first + last) * math.cos(half), (last - first) * math.sin(half))
        low, high = (half, high) if span > far_m else (low, half)
    return low


def _twist(R_hips: FloatArray, R_head: FloatArray) -> float:
    """Return how far the head is turned over the hips, radians, to the left positive, no more than anybody can.

    Beyond that it fades, so that nothing jumps where left and right meet at half a turn.
    """
    # The head's own right-hand axis stays level while it nods.
    right = R_hips.T @ R_head[:, 0]
    turned = math.atan2(-right[2], right[0]) * min(math.hypot(right[0], right[2]) / _LEAST_LEVEL, 1.0)
    most = _MOST_TWIST_RAD
    if abs(turned) <= most:
        return turned
    return math.copysign(most * (math.pi - abs(turned)) / (math.pi - most), turned)


def _upright(bone: FloatArray, right: FloatArray, otherwise: FloatArray) -> FloatArray:
    """Return axes (3, 3) with +Y along a bone and +X as near to a direction as that allows."""
    size = float(np.linalg.norm(bone))
    if size < _LEVEL:
        return otherwise
    y = bone / size
    x = right - (right @ y) * y
    if float(np.linalg.norm(x)) < _LEVEL:
        # The bone lies along the direction: the other axes decide.
        x = np.cross(y, otherwise[:, 2])
    x = x / np.linalg.norm(x)
    return np.stack([x, y, np.cross(x, y)], axis=-1)


# An arm in closed form: two bones between a shoulder and a tracked wrist.
#
# Two bones of known length leave one angle open: where on a circle the elbow is. Nobody measures it. Held straight
# ahead, an elbow hangs down and a little outwards; for any other direction of the wrist that is carried along by the
# smallest rotation. So an elbow is behind a hanging arm, under one stretched to the side, and before one raised over
# the head, and it goes everywhere without a jump but straight through the trunk to the back, where no wrist goes.

_AHEAD: Final = np.array([0.0, 0.0, -1.0])
_ELBOW: Final = np.array([0.34, -0.94, 0.0])
"""Where the elbow of an arm held straight ahead is from the line to its wrist: 20° outwards of down. A choice that
looks natural, no measurement; chest axes of the right side."""
_TO_ARM: Final = np.diag([-1.0, 1.0, -1.0])
"""From the frame of a knee's bones, whose hinge points the other way, to that of an arm's."""
LONGEST: Final = 1.25
"""Of the arm's length: a wrist that is farther from the shoulder is not this person's. Room for a shoulder that is
drawn forwards (40 mm) and for a person with other proportions."""


def solve_arm(
    side: Side, R_chest: FloatArray, shoulder: FloatArray, T_rig_wrist: FloatArray, upper_m: float, forearm_m: float
) -> dict[str, FloatArray] | None:
    """Return `<side>_shoulder`, `_elbow` and `_wrist`, (4, 4) each in the rig frame; None when it is out of reach.

    Args:
        side: whose arm.
        R_chest: (3, 3) axes of the chest.
        shoulder: (3,) metres.
        T_rig_wrist: (4, 4) wrist of the hand, OpenXR's hand axes.
        upper_m, forearm_m: lengths.
    """
    wrist = T_rig_wrist[:3, 3]
    line = wrist - shoulder
    far = float(np.linalg.norm(line))
    if far > LONGEST * (upper_m + forearm_m):
        return None
    direction = line / far if far > 1e-6 else R_chest @ _AHEAD
    carried = shortest_rotation(_AHEAD, R_chest.T @ direction)
    elbow = R_chest @ carried @ (_ELBOW * np.array([OUTWARDS[side], 1.0, 1.0]))
    arm = bend_leg(shoulder, wrist, np.cross(direction, elbow), upper_m, forearm_m)
    return {
        f"{side}_shoulder": rigid(arm.R_thigh @ _TO_ARM, arm.hip),
        f"{side}_elbow": rigid(arm.R_shank @ _TO_ARM, arm.knee),
        f"{side}_wrist": rigid(hand_axes(side, T_rig_wrist[:3, :3]), arm.ankle),
    }


def hand_axes(side: Side, R_rig_wrist: FloatArray) -> FloatArray:
    """Return the axes of a wrist as in `BodyJoint` (3, 3) from those of `HandPose`."""
    out = OUTWARDS[side]
    # Of a hanging hand OpenXR's +Y, out of its back, points outwards and its +Z, to the wrist, upwards.
    return np.stack([out * R_rig_wrist[:, 1], R_rig_wrist[:, 2], out * R_rig_wrist[:, 0]], axis=-1)


def solve_upper_body(
    T_rig_hips: FloatArray, T_rig_head: FloatArray, wrists: Mapping[Side, FloatArray], body: BodyModel
) -> dict[str, FloatArray]:
    """Return the joints above the hips by name, as in `BodyPose`, (4, 4) each in the rig frame.

    Args:
        T_rig_hips: (4, 4) middle between the hip joints.
        T_rig_head: (4, 4) headset, OpenXR axes.
        wrists: (4, 4) of the tracked hands, OpenXR's hand axes; an arm that cannot reach its wrist is left out.
        body: lengths.
    """
    joints = spine(T_rig_hips, T_rig_head, body)
    R_chest, neck = joints["chest"][:3, :3], joints["neck"][:3, 3]
    for side, T_rig_wrist in wrists.items():
        shoulder = neck + R_chest @ (np.array(body.shoulder_m) * [OUTWARDS[side], 1.0, 1.0])
        arm = solve_arm(side, R_chest, shoulder, T_rig_wrist, body.upper_arm_m, body.forearm_m)
        if arm is not None:
            joints |= arm
    return joints
