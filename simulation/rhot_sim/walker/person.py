"""The whole person as a function of time: feet along their paths, hips over them, legs between, head on top.

Hips, trunk and head follow uniform cubic B-splines (`rhot_sim.world.motion`) whose controls, ten a second, come from
the plan: the hips stay between the footprints, shift to the standing leg, and are held as high as both legs allow at
all times near, so that every leg reaches its ankle with the lengths of the body model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_sim.walker.foot_path import OUTWARDS, SIDES, FootPath, Posture, Sole, rotations
from rhot_sim.walker.programs import plan_program
from rhot_sim.world.motion import evaluate_spline, ramp
from rhot_sim.world.script import seeded

# One leg between hip and ankle: where the knee is, exactly, and how thigh and shank lie.


@dataclass(frozen=True, slots=True)
class Leg:
    """A leg at N moments, rig frame; frames as in `rhot.messages.BodyJoint`.

    Attributes:
        knee: (N, 3) metres.
        R_thigh, R_shank: (N, 3, 3); +Y along the bone towards the hip, +X the axis of the knee, to the body's right.
    """

    knee: FloatArray
    R_thigh: FloatArray
    R_shank: FloatArray


def solve_leg(hip: FloatArray, ankle: FloatArray, ahead: FloatArray, thigh_m: float, shank_m: float) -> Leg:
    """Bend a leg between hip and ankle, (N, 3), so that the knee points to `ahead` (N, 3) as far as it can.

    Two triangles with a common side: the knee lies at a² − b² + d² over 2 d from the hip along the line to the ankle,
    and as far off that line as the thigh's length then asks. Where the ankle is out of reach the lengths are kept and
    the leg ends short of it.
    """
    line = ankle - hip
    reach = np.linalg.norm(line, axis=1)
    along_axis = line / reach[:, None]
    distance = np.minimum(reach, thigh_m + shank_m)
    along = (thigh_m**2 - shank_m**2 + distance**2) / (2.0 * distance)
    off = np.sqrt(np.maximum(thigh_m**2 - along**2, 0.0))
    bend = ahead - (ahead * along_axis).sum(axis=1, keepdims=True) * along_axis
    bend /= np.linalg.norm(bend, axis=1, keepdims=True)
    knee = hip + along[:, None] * along_axis + off[:, None] * bend
    right = np.cross(along_axis, bend)
    end = hip + distance[:, None] * along_axis
    return Leg(knee, _frame(hip - knee, right), _frame(knee - end, right))


def _frame(up: FloatArray, right: FloatArray) -> FloatArray:
    y = up / np.linalg.norm(up, axis=1, keepdims=True)
    return np.stack([right, y, np.cross(right, y)], axis=-1)


KNOT_S: Final = 0.1
SHOE_M: Final = 0.022
"""Thickness of the shoes' soles."""
STRAIGHTEST: Final = 0.9995
"""Hip to ankle over thigh and shank: a standing leg is never quite straight, and no acceleration is ever infinite."""
_STANDING: Final = 0.9992
_DENSE: Final = 10
_REACH_MARGIN_M: Final = 0.0005
_SWAY: Final = 0.3
_STEADY_S: Final = 0.7
"""The last part of a period, in which the body comes back to where the period begins."""
PROPORTION_SIGMA: Final = 0.02
"""Of a person's lengths about the average of their height."""
_UPWARDS: Final = 0.3
"""Knees point ahead and this much upwards, which decides where a leg that is raised to the front bends."""
_STREAM: Final = 40
HIPS_X, HIPS_Y, HIPS_Z, YAW, LEAN, HEAD_YAW, HEAD_PITCH, HEAD_ROLL = range(8)


@dataclass(frozen=True, slots=True)
class PersonSample:
    """A person at N moments, rig frame; transforms (N, 4, 4), metres.

    Attributes:
        head: pose of the headset.
        hips: pose of the middle between the hip joints.
        neck: (N, 3) pivot of the head.
        hip_joints: side to (N, 3).
        legs: side to thigh and shank.
        ankles: side to the pose of the ankle, level when the foot stands flat.
    """

    head: FloatArray
    hips: FloatArray
    neck: FloatArray
    hip_joints: dict[Side, FloatArray]
    legs: dict[Side, Leg]
    ankles: dict[Side, FloatArray]


class Person:
    """A person who carries out a program again and again.

    Args:
        seed: with the time it determines everything.
        body: lengths.
        program: one of `rhot_sim.walker.programs.PROGRAMS`.
        camera_pitch_rad: how far the camera looks down from the head: the head turns so that the camera sees the feet.
    """

    def __init__(self, seed: int, body: BodyModel, program: str, camera_pitch_rad: float) -> None:
        self.body = body
        self.sole = Sole(body.ankle_height_m + SHOE_M, -float(body.ball_m[2]), body.heel_m)
        self._plan = plan_program(program, body, self.sole, seeded(seed, _STREAM))
        self.feet = {side: FootPath(self.sole, self._plan.start[side], self._plan.steps[side]) for side in SIDES}
        rng = seeded(seed, _STREAM, 1)
        self._knee_out_rad = {side: -OUTWARDS[side] * float(np.radians(rng.uniform(-3.0, 6.0))) for side in SIDES}
        self._count = round(self._plan.period_s / KNOT_S)
        self._controls = self._hips_and_posture(camera_pitch_rad)

    @property
    def period_s(self) -> float:
        """After this long the same movements begin again."""
        return self._plan.period_s

    def flat(self, side: Side, t_s: FloatArray) -> NDArray[np.bool_]:
        """Tell (N,) when a foot rests on its whole sole and does not move at all."""
        return self.feet[side].flat(self._within(t_s))

    def ankles(self, side: Side, t_s: FloatArray) -> FloatArray:
        """Return T_rig_ankle (N, 4, 4) of one foot at times (N,), seconds."""
        return self.feet[side].ankles(self._within(t_s))

    def heads(self, t_s: FloatArray) -> FloatArray:
        """Return T_rig_head (N, 4, 4) at times (N,), seconds."""
        curve = self._curve(t_s)
        return self._head(curve, self._neck(curve))

    def sample(self, t_s: FloatArray) -> PersonSample:
        """Return the person at times (N,), seconds, any times in any order."""
        curve = self._curve(t_s)
        neck = self._neck(curve)
        # The pelvis takes part of the trunk's lean.
        hips = transforms(rotations(curve[:, YAW], -0.3 * curve[:, LEAN], np.zeros(len(curve))), curve[:, :3])
        ankles = {side: self.ankles(side, t_s) for side in SIDES}
        joints = {side: self._hip_joints(side, curve) for side in SIDES}
        legs = {
            side: solve_leg(
                joints[side],
                ankles[side][:, :3, 3],
                self._ahead(side, curve[:, YAW], ankles[side]),
                self.body.thigh_m,
                self.body.shank_m,
            )
            for side in SIDES
        }
        return PersonSample(self._head(curve, neck), hips, neck, joints, legs, ankles)

    def _within(self, t_s: FloatArray) -> FloatArray:
        return np.mod(t_s, self._plan.period_s)

    def _curve(self, t_s: FloatArray) -> FloatArray:
        """Return hips, yaw, lean and head angles (N, 8) at times (N,)."""
        return evaluate_spline(t_s, KNOT_S, self._control)

    def _control(self, knot: int) -> FloatArray:
        row: FloatArray = self._controls[knot % self._count]
        return row

    def _hip_joints(self, side: Side, curve: FloatArray) -> FloatArray:
        out = OUTWARDS[side] * self.body.hip_width_m / 2.0
        joints: FloatArray = curve[:, :3] + out * _right(curve[:, YAW])
        return joints

    def _ahead(self, side: Side, yaw: FloatArray, ankles: FloatArray) -> FloatArray:
        """Return where a knee points (N, 3): mostly where the toes do, a little where the body does."""
        # The foot's own +X is level whatever its pitch, so that its heading is known with the heel up too.
        right = ankles[:, :3, 0] * [1.0, 0.0, 1.0]
        right = 0.75 * right / np.linalg.norm(right, axis=1, keepdims=True) + 0.25 * _right(yaw)
        out = self._knee_out_rad[side]
        c, s = np.cos(out), np.sin(out)
        x, z = right[:, 2], -right[:, 0]
        ahead = np.stack([c * x + s * z, np.zeros(len(x)), -s * x + c * z], axis=-1)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        ahead[:, 1] = _UPWARDS
        return ahead

    def _neck(self, curve: FloatArray) -> FloatArray:
        trunk = rotations(curve[:, YAW], -curve[:, LEAN], np.zeros(len(curve)))
        neck: FloatArray = curve[:, :3] + trunk[:, :, 1] * self.body.neck_height_m
        return neck

    def _head(self, curve: FloatArray, neck: FloatArray) -> FloatArray:
        R = rotations(curve[:, YAW] + curve[:, HEAD_YAW], -curve[:, HEAD_PITCH], curve[:, HEAD_ROLL])
        return transforms(R, neck - R @ np.array(self.body.neck_m))

    def _hips_and_posture(self, camera_pitch_rad: float) -> FloatArray:
        """Return the controls (K, 8) of one period."""
        dense: FloatArray = np.arange(self._count * _DENSE, dtype=np.float64) * (KNOT_S / _DENSE)
        t = dense[::_DENSE]
        posture = _steadied(self._plan.posture(t), ramp(t, self._plan.period_s - _STEADY_S, self._plan.period_s))
        controls = np.zeros((self._count, 8))
        prints = {side: self.feet[side].footprints(t) for side in SIDES}
        middle = (prints["left"] + prints["right"]) / 2.0
        for side in SIDES:
            other = SIDES[1 - SIDES.index(side)]
            middle += _SWAY * self.feet[other].airborne(t)[:, None] * (prints[side] - middle) * [1.0, 1.0, 0.0]
        yaw = middle[:, 2]
        right = _right(yaw)
        back = np.stack([np.sin(yaw), np.zeros(len(yaw)), np.cos(yaw)], axis=-1)
        hips = posture.shift_m[:, :1] * right + posture.shift_m[:, 1:] * back
        controls[:, HIPS_X], controls[:, HIPS_Z] = middle[:, 0] + hips[:, 0], middle[:, 1] + hips[:, 2]
        controls[:, YAW], controls[:, LEAN] = yaw + posture.turn_rad, posture.lean_rad
        self._controls = controls
        standing = self.sole.ankle_height_m + _STANDING * self.body.leg_m
        controls[:, HIPS_Y] = np.minimum(standing - posture.drop_m, self._highest_hips(dense))
        controls[:, HEAD_YAW:] = posture.head_rad
        feet_back = ((middle[:, :2] - controls[:, [HIPS_X, HIPS_Z]]) * back[:, ::2]).sum(axis=1)
        gaze = self._gaze(controls[:, HIPS_Y], feet_back, posture.lean_rad) - camera_pitch_rad
        controls[:, HEAD_PITCH] += np.clip(gaze, np.radians(2.0), np.radians(66.0)) * posture.look
        return controls

    def _highest_hips(self, dense: FloatArray) -> FloatArray:
        """Return (K,) the height that the hips keep below so that both legs reach, at each control and near it."""
        curve = self._curve(dense)
        limit = np.full(len(dense), np.inf)
        for side in SIDES:
            apart = self.ankles(side, dense)[:, :3, 3] - self._hip_joints(side, curve)
            level = apart[:, 0] ** 2 + apart[:, 2] ** 2
            rise = np.sqrt(np.maximum((STRAIGHTEST * self.body.leg_m) ** 2 - level, 0.0))
            limit = np.minimum(limit, self.ankles(side, dense)[:, 1, 3] + rise)
        # A control weighs on the curve for two knots to either side.
        reach = range(-2 * _DENSE, 2 * _DENSE + 1)
        near = np.stack([np.roll(limit, shift) for shift in reach]).min(axis=0)
        lowest: FloatArray = near[::_DENSE] - _REACH_MARGIN_M
        return lowest

    def _gaze(self, hips_y: FloatArray, feet_back: FloatArray, lean: FloatArray) -> FloatArray:
        """Return (K,) how far below the horizon the insteps lie, seen from a head that looks down at them."""
        body = self.body
        eye_y = hips_y + body.neck_height_m * np.cos(lean) - 0.05 * body.height_m
        eye_back = -body.neck_height_m * np.sin(lean) - 0.1 * body.height_m
        instep_back = feet_back - 0.06
        # Somewhat before the feet, where the next step goes.
        ahead = eye_back - instep_back + 0.12
        gaze: FloatArray = np.arctan2(eye_y - 0.07, ahead)
        return gaze


def person_of(body: BodyModel, seed: int) -> BodyModel:
    """Return somebody of the same height whose legs, hips and trunk are not quite average."""
    thigh, shank, width, trunk = 1.0 + seeded(seed, _STREAM, 2).normal(0.0, PROPORTION_SIGMA, 4).clip(-0.05, 0.05)
    return replace(
        body,
        hip_width_m=body.hip_width_m * width,
        thigh_m=body.thigh_m * thigh,
        shank_m=body.shank_m * shank,
        neck_height_m=body.neck_height_m * trunk,
    )


def transforms(R: FloatArray, position: FloatArray) -> FloatArray:
    """Return the transforms (N, 4, 4) of rotations (N, 3, 3) and translations (N, 3)."""
    T = np.zeros((len(R), 4, 4))
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, position, 1.0
    return T


def _right(yaw: FloatArray) -> FloatArray:
    """Return the level direction (N, 3) to the right of headings (N,), radians."""
    return np.stack([np.cos(yaw), np.zeros(len(yaw)), -np.sin(yaw)], axis=-1)


def _steadied(posture: Posture, share: FloatArray) -> Posture:
    """Return a posture (K moments) that ends as it begins: `share` (K,) goes from 0 to 1 at the end."""

    def closed(values: FloatArray) -> FloatArray:
        weight = share.reshape(-1, *[1] * (values.ndim - 1))
        blended: FloatArray = values + weight * (values[0] - values)
        return blended

    return Posture(
        closed(posture.drop_m),
        closed(posture.shift_m),
        closed(posture.lean_rad),
        closed(posture.head_rad),
        closed(posture.look),
        closed(posture.turn_rad),
    )
