"""A hand that touches the faces of a box one after the other, for finding where an object sits on its tracker.

The first hand waits, then touches each face at its four corners: the top, with the box turned by a quarter after each
touch, so that the same error of the cameras tilts nothing; then each side when it is turned towards the hand. Then all
of it repeats. The tracker sits askew on the box, which `registration.json` does not know before
`rhot calibrate objects --touch` has found it out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from rhot.anatomy.hand import MOVING, HandModel
from rhot.arrays import FloatArray
from rhot.geometry.rotations import rigid, rotation_from_vector
from rhot.messages import Side
from rhot_sim.world.motion import (
    OBJECT_SIZE_M,
    PALM_FORWARD_M,
    MotionSample,
    StillMotion,
    evaluate_spline,
    lying_pose,
    wrist_poses,
)

T_DEVICE_OBJECT: Final[FloatArray] = rigid(
    rotation_from_vector(np.array([0.5, -0.9, 0.7])), np.array([0.02, 0.055, -0.03])
)
"""Where a box that is touched truly sits on its tracker, (4, 4), metres: neither beside it nor straight."""
T_DEVICE_OBJECT.setflags(write=False)

FACES: Final = ("top", "front", "right", "back", "left")
TOUCHES_A_FACE: Final = 4
WAIT_S: Final = 8.0
"""Before the first touch: time to start the command."""
KNOT_S: Final = 0.1
_SPOT_M: Final = np.array([0.0, 0.06])
"""Where the box stands: the side that is turned to the hand is the one that the cameras see."""
_WAIT: Final = round(WAIT_S / KNOT_S)
_HOLD: Final = 15
"""Knots for which a touch is held; the curve stands still for three less."""
_TRAVEL: Final = 2
"""Knots off the face, before and after a touch."""
_EDGE_M: Final = 0.011
"""Distance of a touch from the edges of its face: more than the finger's radius."""
_YAW_A_ROUND_RAD: Final = 4.0 * np.pi
_SWAY_M: Final = 0.03
_SWAY_HZ: Final = 0.4
_PITCH_RAD: Final = {"top": np.radians(20.0), "side": np.radians(14.0)}
"""How the hand is tilted, fingers down."""
_POINTING_DEG: Final = np.array([[6, 6, 14], [2, 2, 6], [52, 0, 62], [54, -1, 64], [54, -3, 64]], dtype=float)
"""Angles of `rhot.anatomy.hand` without the last hinge: the index finger points."""


class TouchMotion:
    """The hand touches the first object; other hands and objects keep still. A function of time alone.

    Args:
        hands: the first one touches.
        objects: ids, at least one.
        desk_z_m: distance of the desk from the reference camera.
    """

    def __init__(self, hands: Mapping[Side, HandModel], objects: Sequence[str], desk_z_m: float = 0.95) -> None:
        self._rest = StillMotion(tuple(hands), objects, desk_z_m)
        self._side = next(iter(hands))
        self._object = objects[0]
        self._desk_z_m = desk_z_m
        hand = hands[self._side]
        angles = np.empty((5, 4))
        angles[:, :3] = np.radians(_POINTING_DEG)
        angles[:, 3] = hand.coupling * angles[:, 2]
        self._angles: FloatArray = hand.clamp(angles)
        self._tip = hand.forward_local(self._angles).positions[MOVING[1, 3]]
        self._radius_m = float(hand.radii[MOVING[1, 3]])
        self._table = self._knots()

    @property
    def round_s(self) -> float:
        """Time after which the motion repeats, the box turned by `_YAW_A_ROUND_RAD`, seconds."""
        return KNOT_S * len(self._table)

    def sample(self, t_s: FloatArray) -> MotionSample:
        """Return the motion at times (N,), seconds since the world's start."""
        t = np.maximum(np.asarray(t_s, dtype=np.float64), 0.0)
        rest = self._rest.sample(t)

        def control(knot: int) -> FloatArray:
            cycle, place = divmod(max(knot, 0), len(self._table))
            row: FloatArray = self._table[place].copy()
            row[6] += _YAW_A_ROUND_RAD * cycle
            return row

        curve = evaluate_spline(t, KNOT_S, control)
        poses = np.array([lying_pose(np.array([*_SPOT_M, yaw]), self._desk_z_m) for yaw in curve[:, 6]])
        return MotionSample(
            {**rest.wrists, self._side: wrist_poses(curve[:, :6])},
            {**rest.angles, self._side: np.tile(self._angles, (len(t), 1, 1))},
            {**rest.objects, self._object: poses},
        )

    def _knots(self) -> FloatArray:
        """Return the controls (K, 7) of one round: the hand's placement, see `wrist_poses`, and the box's yaw."""
        rows: list[FloatArray] = []

        def stay(placement: FloatArray, yaw: float, count: int) -> None:
            rows.extend([np.append(placement, yaw)] * count)

        away = self._placement("side", np.array([0.0, _SPOT_M[1] - 0.12, self._desk_z_m - 0.08]))
        for knot in range(_WAIT):
            phase = 2.0 * np.pi * _SWAY_HZ * KNOT_S * knot
            sway = _SWAY_M * np.array([np.sin(phase), 0.0, 0.5 * np.cos(phase), 0.0, 0.0, 0.0])
            rows.append(np.append(away + sway, 0.0))
        for number, face in enumerate(FACES):
            for touch in range(TOUCHES_A_FACE):
                # The top is touched during one turn of the box, the sides during the next.
                yaw = 0.5 * np.pi * (touch if face == "top" else TOUCHES_A_FACE + number - 1)
                rows += self._turned(rows[-1][6], yaw, away)
                contact, out = self._contact(face, touch, yaw)
                posture = "top" if face == "top" else "side"
                # How far the tip is taken off a face between touches.
                near = self._placement(posture, contact + (self._radius_m + 0.03) * out)
                stay(near, yaw, _TRAVEL)
                stay(self._placement(posture, contact + self._radius_m * out), yaw, _HOLD)
                stay(near, yaw, _TRAVEL)
        return np.array([*rows, *self._turned(rows[-1][6], _YAW_A_ROUND_RAD, away)])

    @staticmethod
    def _turned(before: float, yaw: float, away: FloatArray) -> list[FloatArray]:
        """Return the controls while the box is turned; none where it stands right."""
        if before == yaw:
            return []
        # Knots in which the box is turned.
        shares = np.linspace(0.0, 1.0, 14)
        # Never still: a finger that waits beside the box must not look like one that touches it.
        bob = 0.02 * np.sin(2.0 * np.pi * shares)[:, None] * np.array([1.0, 0.0, 0.5, 0.0, 0.0, 0.0])
        return list(np.column_stack([away + bob, before + shares * (yaw - before)]))

    def _contact(self, face: str, touch: int, yaw: float) -> tuple[FloatArray, FloatArray]:
        """Return the point of a face to touch, (3,) metres, and the way out there, (3,), rig frame."""
        middle = lying_pose(np.array([*_SPOT_M, yaw]), self._desk_z_m)[:3, 3]
        turned = OBJECT_SIZE_M if round(yaw / (np.pi / 2.0)) % 2 == 0 else OBJECT_SIZE_M[[2, 1, 0]]
        across, up, along = 0.5 * turned
        if face == "top":
            return middle + np.array([across - _EDGE_M, _EDGE_M - along, -up]), np.array([0.0, 0.0, -1.0])
        x, z = ((1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))[touch]
        return middle + np.array([x * (across - _EDGE_M), -along, -z * (up - _EDGE_M)]), np.array([0.0, -1.0, 0.0])

    def _placement(self, posture: str, tip: FloatArray) -> FloatArray:
        """Return the placement (6,) that brings the index finger's tip joint to a point (3,), rig frame, metres."""
        placement = np.zeros(6)
        placement[4] = _PITCH_RAD[posture]
        R = wrist_poses(placement[None])[0, :3, :3]
        placement[:3] = tip - R @ self._tip - PALM_FORWARD_M * R[:, 2]
        return placement
