"""What moves in the simulated world: the seam behind which scripted motion and joint recordings stand."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.rotations import quaternion_from_rotation
from rhot.messages import Side, TruePose
from rhot.messages.base import wire_position, wire_quaternion

# Smooth curves that can be asked for at any time: uniform cubic B-splines over control values.
#
# With knots every h seconds, k = ⌊t/h⌋ and u = t/h − k, the curve is the sum of B_i(u) · c[k − 1 + i], i = 0…3 (de
# Boor, "A Practical Guide to Splines", ch. IX). It is twice continuously differentiable and lies in the convex hull
# of its four controls, so that controls within limits give a curve within limits, and equal controls a curve that
# stands still.


def evaluate_spline(t_s: FloatArray, knot_s: float, control: Callable[[int], FloatArray]) -> FloatArray:
    """Return the curve at times `t_s` (N,), seconds, as (N, C).

    Args:
        t_s: any times in any order.
        knot_s: distance of the knots, seconds.
        control: returns the control values (C,) of a knot by its number.
    """
    knots = np.asarray(t_s, dtype=np.float64) / knot_s
    knot = np.floor(knots).astype(np.int64)
    weights = basis(knots - knot)
    first, last = int(knot.min()) - 1, int(knot.max()) + 2
    if last - first <= 4 * len(knot) + 4:
        table = np.stack([control(k) for k in range(first, last + 1)])
        index = knot[:, None] + np.arange(4) - 1 - first
    else:
        wanted, inverse = np.unique(knot[:, None] + np.arange(-1, 3), return_inverse=True)
        table = np.stack([control(int(k)) for k in wanted])
        index = inverse.reshape(-1, 4)
    curve: FloatArray = np.einsum("nk,nkc->nc", weights, table[index])
    return curve


def basis(u: FloatArray) -> FloatArray:
    """Return the four weights (N, 4) of the uniform cubic B-spline at u (N,) in [0, 1); they sum to 1."""
    v = 1.0 - u
    return np.stack([v**3, 3.0 * u**3 - 6.0 * u**2 + 4.0, 3.0 * v**3 - 6.0 * v**2 + 4.0, u**3], axis=-1) / 6.0


def ramp(t: FloatArray, start: float, end: float) -> FloatArray:
    """Return 0 before `start`, 1 after `end` and a smooth step (3x² − 2x³) between."""
    x = np.clip((t - start) / (end - start), 0.0, 1.0)
    smooth: FloatArray = x * x * (3.0 - 2.0 * x)
    return smooth


def bump(t: FloatArray, start: float, end: float, edge: float) -> FloatArray:
    """Return 1 within [start + edge, end − edge], 0 outside [start, end], smooth between."""
    rising: FloatArray = ramp(t, start, start + edge) * (1.0 - ramp(t, end - edge, end))
    return rising


@dataclass(frozen=True, slots=True)
class MotionSample:
    """Everything that moves at N moments, rig frame.

    Attributes:
        wrists: side to the pose of the wrist joint, (N, 4, 4), metres, OpenXR's axes.
        angles: side to joint angles, (N, 5, 4), radians, as in `rhot.anatomy.hand`.
        objects: object id to the pose of its centre, (N, 4, 4), metres.
    """

    wrists: Mapping[Side, FloatArray]
    angles: Mapping[Side, FloatArray]
    objects: Mapping[str, FloatArray]


class Motion(Protocol):
    """A function of time without memory: the same moment always gives the same pose, in any order of asking."""

    def sample(self, t_s: FloatArray) -> MotionSample:
        """Return the motion at times (N,), seconds since the world's start."""
        ...


R_RIG_HAND: FloatArray = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
"""Axes of a hand that lies palm down under the cameras, fingers towards the lower edge of the picture."""
R_RIG_HAND.setflags(write=False)

PALM_FORWARD_M = 0.07
"""A hand is placed by the point this far in front of its wrist joint."""


def wrist_poses(placement: FloatArray) -> FloatArray:
    """Return wrist poses (N, 4, 4), metres, from placements (N, 6).

    A placement is the point `PALM_FORWARD_M` in front of the wrist (x, y, z, metres, rig frame) and three angles in
    radians:

        R_rig_wrist = Rz(yaw) · Rx(pitch) · Ry(roll) · R_RIG_HAND.
    """
    yaw, pitch, roll = placement[:, 3], placement[:, 4], placement[:, 5]
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (np.cos, np.sin))
    R = np.empty((len(placement), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = cy * cr - sy * sp * sr, -sy * cp, cy * sr + sy * sp * cr
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = sy * cr + cy * sp * sr, cy * cp, sy * sr - cy * sp * cr
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = -cp * sr, sp, cp * cr
    T = np.zeros((len(placement), 4, 4))
    T[:, :3, :3] = R @ R_RIG_HAND
    T[:, :3, 3] = placement[:, :3] + PALM_FORWARD_M * T[:, :3, 2]
    T[:, 3, 3] = 1.0
    return T


class StillMotion:
    """Open hands, 17 cm above the desk, and objects that never move, for tests and for looking.

    Args:
        sides: hands, side by side where there are two.
        objects: ids; they lie in a row beside the fingers.
        desk_z_m: distance of the desk from the reference camera.
    """

    def __init__(self, sides: Sequence[Side], objects: Sequence[str], desk_z_m: float = 0.95) -> None:
        self._placements: dict[Side, FloatArray] = {
            side: np.array([home_x_m(side, sides), -0.03, desk_z_m - 0.17, 0.0, 0.0, 0.0]) for side in sides
        }
        self._objects = {
            name: lying_pose(np.array([0.19 - 0.12 * index, 0.14, 0.0]), desk_z_m) for index, name in enumerate(objects)
        }
        angles = np.radians([[8, 5, 10, 10], [8, 4, 12, 8], [6, 0, 12, 8], [8, -3, 14, 9], [10, -6, 16, 11]])
        self._angles: FloatArray = angles.astype(np.float64)

    def sample(self, t_s: FloatArray) -> MotionSample:
        """Return the one pose for each of the times (N,)."""
        n = len(t_s)
        return MotionSample(
            wrists={side: wrist_poses(np.tile(placed, (n, 1))) for side, placed in self._placements.items()},
            angles={side: np.tile(self._angles, (n, 1, 1)) for side in self._placements},
            objects={name: np.tile(pose, (n, 1, 1)) for name, pose in self._objects.items()},
        )


def home_x_m(side: Side, sides: Sequence[Side]) -> float:
    """Return where a hand stays about, metres: the middle when alone, else right hand to the left in the picture."""
    if len(sides) == 1:
        return 0.0
    return -0.13 if side == "right" else 0.13


OBJECT_SIZE_M: FloatArray = np.array([0.100, 0.060, 0.065])
"""Extent of a simulated object (a rounded box) along its own axes: across the hand, up, along the fingers."""
OBJECT_SIZE_M.setflags(write=False)


def lying_pose(spot: FloatArray, desk_z_m: float) -> FloatArray:
    """Return the pose (4, 4) of an object that stands on the desk at (x, y, yaw), metres and radians."""
    pose: FloatArray = wrist_poses(np.array([[spot[0], spot[1], 0.0, spot[2], 0.0, 0.0]]))[0]
    pose[:3, 3] = spot[0], spot[1], desk_z_m - OBJECT_SIZE_M[1] / 2.0
    return pose


def true_pose(T: NDArray[np.float64]) -> TruePose:
    """Return the message's form of a transform (4, 4), metres."""
    return TruePose(position=wire_position(T[:3, 3]), orientation=wire_quaternion(quaternion_from_rotation(T[:3, :3])))
