"""What a person does, written down: the steps of both feet and the posture of the body over one period of time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_y
from rhot.messages import Side
from rhot_sim.walker.foot_path import Print, Sole, Step, Waypoint, rotations

SIDES: Final[tuple[Side, Side]] = ("left", "right")
OUTWARDS: Final[dict[Side, float]] = {"left": -1.0, "right": 1.0}
"""Sign of x on which a leg stands."""
TOE_OUT_RAD: Final = float(np.radians(7.0))
STEP_SPAN: Final = 1.4
"""From heel-off to the flat foot, in beats: 70 % of a walking cycle of two."""


@dataclass(frozen=True, slots=True)
class Posture:
    """How the body is held at N moments.

    Attributes:
        drop_m: (N,) hips lower than standing.
        shift_m: (N, 2) of the hips to the body's right and backwards, from the middle between the footprints.
        lean_rad: (N,) of the trunk, forwards positive.
        head_rad: (N, 3) yaw, pitch (down positive) and roll of the head, added to where it looks.
        look: (N,) 1 looks at the feet, 0 straight ahead.
        turn_rad: (N,) of hips and trunk over the feet, to the left positive.
    """

    drop_m: FloatArray
    shift_m: FloatArray
    lean_rad: FloatArray
    head_rad: FloatArray
    look: FloatArray
    turn_rad: FloatArray

    @classmethod
    def upright(cls, count: int) -> Posture:
        """Return `count` moments of standing straight and looking at the feet."""
        zeros = np.zeros(count)
        return cls(zeros, np.zeros((count, 2)), zeros, np.zeros((count, 3)), np.ones(count), zeros)


@dataclass(frozen=True, slots=True)
class Plan:
    """A program's movements; after the period they begin again, at the same place.

    Attributes:
        period_s: a whole number of tenths of a second.
        start: where each foot stands first.
        steps: of each foot, in order.
        posture: of times (N,), seconds, within the period.
        turn_rad: what the body has turned at the end of the period, whole turns.
    """

    period_s: float
    start: dict[Side, Print]
    steps: dict[Side, list[Step]]
    posture: Callable[[FloatArray], Posture]
    turn_rad: float = 0.0


class Choreographer:
    """Writes steps one after the other.

    Args:
        sole: of both feet.
        width_m: between the ankles when standing.
        rng: of small irregularities.
    """

    def __init__(self, sole: Sole, width_m: float, rng: np.random.Generator) -> None:
        self.t_s = 0.0
        self.rng = rng
        self._sole = sole
        self._half_width = width_m / 2.0
        self.start = {side: self.place(side, 0.0, 0.0, 0.0) for side in SIDES}
        self.prints = dict(self.start)
        self.steps: dict[Side, list[Step]] = {side: [] for side in SIDES}

    def place(self, side: Side, x: float, z: float, yaw: float) -> Print:
        """Return where a foot stands when the body stands at (x, z) and faces `yaw`."""
        out = OUTWARDS[side]
        offset = rotation_y(yaw) @ [out * self._half_width, 0.0, 0.0]
        return Print(x + offset[0], z + offset[2], yaw - out * TOE_OUT_RAD)

    def pause(self, duration_s: float) -> float:
        """Stand, and return when that began."""
        began_s = self.t_s
        self.t_s += duration_s
        return began_s

    def step(
        self,
        side: Side,
        to: Print,
        duration_s: float,
        *,
        clearance_m: float = 0.05,
        push_rad: float = 0.5,
        strike_rad: float = 0.2,
    ) -> None:
        """Make one step and wait until it is over."""
        self._append(side, Step(self.t_s, self.t_s + duration_s, to, clearance_m, push_rad, strike_rad))

    def lift(
        self, side: Side, via: Sequence[Waypoint], back_s: float, *, push_rad: float = 0.3, push_s: float = 0.2
    ) -> None:
        """Move a foot through poses in the air and put it down where it stood, `back_s` after the last of them."""
        step = Step(self.t_s, via[-1].t_s + back_s, self.prints[side], 0.0, push_rad, 0.1, via, push_s, 0.75 * push_s)
        self._append(side, step)

    def walk(
        self, targets: Sequence[tuple[Side, Print]], beat_s: float, *, clearance_m: float = 0.04, level: bool = False
    ) -> None:
        """Walk over alternating footprints, a beat apart; steps of both feet overlap as they do in walking.

        Args:
            targets: where each foot lands in turn.
            beat_s: from one foot's heel-off to the other's.
            clearance_m: of every step.
            level: land with a nearly flat foot, as backwards, sideways and on the spot.
        """
        for side, to in targets:
            before = self.prints[side]
            length = float(np.hypot(to.x - before.x, to.z - before.z))
            push_rad = 0.3 + min(0.55 * length, 0.6)
            strike_rad = 0.05 if level else 0.05 + min(0.25 * length, 0.3)
            end_s = self.t_s + STEP_SPAN * beat_s
            start_s = self.t_s
            self._append(side, Step(start_s, end_s, to, clearance_m, push_rad, strike_rad))
            self.t_s = start_s + beat_s * self.rng.uniform(0.96, 1.04)
        self.t_s += (STEP_SPAN - 0.9) * beat_s

    def return_to_start(self) -> None:
        """Put both feet where they began, with level soles."""
        self.walk([(side, self.start[side]) for side in SIDES], 0.6, level=True)

    def off(self, side: Side, t_s: float, offset: FloatArray, *, velocity: FloatArray | None = None) -> Waypoint:
        """Return a pose in the air relative to where the foot stands now.

        Args:
            side: which foot.
            t_s: time since the world's start.
            offset: (6,) right, up, backwards, metres, and yaw, pitch, roll, radians, in the foot's own heading.
            velocity: (6,) along the same axes; none when not given.
        """
        place = self.prints[side]
        heading = rotation_y(place.yaw)
        pose = np.array([place.x, self._sole.ankle_height_m, place.z, place.yaw, 0.0, 0.0]) + offset
        pose[:3] += heading @ offset[:3] - offset[:3]
        moving = np.zeros(6) if velocity is None else np.concatenate([heading @ velocity[:3], velocity[3:]])
        return Waypoint(t_s, pose, moving)

    def on_ball(self, side: Side, t_s: float, heel_up_rad: float) -> Waypoint:
        """Return a foot that stands on its ball where it is, the heel up."""
        place = self.prints[side]
        turned = rotations(np.array([place.yaw]), np.array([-heel_up_rad]), np.zeros(1))[0]
        ankle = np.array([place.x, self._sole.ankle_height_m, place.z])
        ankle += rotation_y(place.yaw) @ self._sole.ball - turned @ self._sole.ball
        return Waypoint(t_s, np.array([*ankle, place.yaw, -heel_up_rad, 0.0]))

    def plan(self, posture: Callable[[FloatArray], Posture], turn_rad: float = 0.0) -> Plan:
        """Return all that was written, ended by standing; the feet must be where they began."""
        self.pause(0.8)
        return Plan(np.ceil(self.t_s * 10.0) / 10.0, self.start, self.steps, posture, turn_rad)

    def _append(self, side: Side, step: Step) -> None:
        self.steps[side].append(step)
        self.prints[side] = step.to
        self.t_s = step.end_s
