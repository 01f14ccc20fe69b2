"""The path of one foot: standing, steps with heel-off, toe-off, heel strike and foot flat, and poses in the air.

A foot's pose is that of its ankle, whose frame (+X right, +Y up, +Z to the heel) is level when the foot stands flat:

    R_rig_ankle = Ry(yaw) · Rx(pitch) · Rz(roll),   pitch positive with the toes up.

Between two moments every coordinate is a polynomial of degree five that meets place, velocity and acceleration at both
ends (a minimum-jerk movement where these are zero, Flash & Hogan 1985), so that accelerations are continuous. While
only the ball or only the heel touches the floor, the pitch turns about that point and the ankle follows from it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_x, rotation_y
from rhot.messages import Side
from rhot_sim.world.motion import ramp

# What a person does, written down: the steps of both feet and the posture of the body over one period of time.

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
    """

    period_s: float
    start: dict[Side, Print]
    steps: dict[Side, list[PlannedStep]]
    posture: Callable[[FloatArray], Posture]


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
        self.steps: dict[Side, list[PlannedStep]] = {side: [] for side in SIDES}

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
        self._append(side, PlannedStep(self.t_s, self.t_s + duration_s, to, clearance_m, push_rad, strike_rad))

    def lift(
        self, side: Side, via: Sequence[Waypoint], back_s: float, *, push_rad: float = 0.3, push_s: float = 0.2
    ) -> None:
        """Move a foot through poses in the air and put it down where it stood, `back_s` after the last of them."""
        step = PlannedStep(
            self.t_s, via[-1].t_s + back_s, self.prints[side], 0.0, push_rad, 0.1, via, push_s, 0.75 * push_s
        )
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
            self._append(side, PlannedStep(start_s, end_s, to, clearance_m, push_rad, strike_rad))
            self.t_s = start_s + beat_s * self.rng.uniform(0.96, 1.04)
        self.t_s += (STEP_SPAN - 0.9) * beat_s

    def return_to_start(self) -> None:
        """Put both feet where they began, with level soles."""
        self.walk([(side, self.start[side]) for side in SIDES], 0.6, level=True)

    def off(self, side: Side, t_s: float, offset: FloatArray) -> Waypoint:
        """Return a pose in the air relative to where the foot stands now.

        Args:
            side: which foot.
            t_s: time since the world's start.
            offset: (6,) right, up, backwards, metres, and yaw, pitch, roll, radians, in the foot's own heading.
        """
        place = self.prints[side]
        pose = np.array([place.x, self._sole.ankle_height_m, place.z, place.yaw, 0.0, 0.0]) + offset
        pose[:3] += rotation_y(place.yaw) @ offset[:3] - offset[:3]
        return Waypoint(t_s, pose, np.zeros(6))

    def on_ball(self, side: Side, t_s: float, heel_up_rad: float) -> Waypoint:
        """Return a foot that stands on its ball where it is, the heel up."""
        place = self.prints[side]
        turned = rotations(np.array([place.yaw]), np.array([-heel_up_rad]), np.zeros(1))[0]
        ankle = np.array([place.x, self._sole.ankle_height_m, place.z])
        ankle += rotation_y(place.yaw) @ self._sole.ball - turned @ self._sole.ball
        return Waypoint(t_s, np.array([*ankle, place.yaw, -heel_up_rad, 0.0]))

    def plan(self, posture: Callable[[FloatArray], Posture]) -> Plan:
        """Return all that was written, ended by standing; the feet must be where they began."""
        self.pause(0.8)
        return Plan(np.ceil(self.t_s * 10.0) / 10.0, self.start, self.steps, posture)

    def _append(self, side: Side, step: PlannedStep) -> None:
        self.steps[side].append(step)
        self.prints[side] = step.to
        self.t_s = step.end_s


PUSH_SHARE: Final = 0.31
LAND_SHARE: Final = 0.15
"""Parts of a step, from heel-off to the flat foot, on the ball and on the heel; Perry's phases of a walking cycle with
heel-off at 40 %, toe-off at 62 % and foot flat at 10 %, as textbooks give them, rounded."""
_BODY_LEAD: Final = 0.3
_PIVOT_RATE: Final = 1.6
"""Rate of the pitch when a pivot ends or begins, over its mean rate."""
X, Y, Z, YAW, PITCH, ROLL = range(6)
_DEGREE: Final = 6


@dataclass(frozen=True, slots=True)
class Sole:
    """Where a foot touches the floor, ankle frame, metres.

    Attributes:
        ankle_height_m: of the ankle over the floor while the foot stands flat.
        ball_m, heel_m: how far the ball lies before and the heel's end behind the ankle.
    """

    ankle_height_m: float
    ball_m: float
    heel_m: float

    @property
    def ball(self) -> FloatArray:
        """(3,) the floor under the ball of the flat foot."""
        return np.array([0.0, -self.ankle_height_m, -self.ball_m])

    @property
    def heel(self) -> FloatArray:
        """(3,) the floor under the heel's end of the flat foot."""
        return np.array([0.0, -self.ankle_height_m, self.heel_m])


@dataclass(frozen=True, slots=True)
class Print:
    """Where a foot stands flat: the floor under its ankle, metres, and the direction of its toes, radians."""

    x: float
    z: float
    yaw: float


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A pose in the air on the way of a step.

    Attributes:
        t_s: time since the world's start.
        pose: (6,) ankle x, y, z, metres, and yaw, pitch, roll, radians.
        velocity: (6,) of the same.
    """

    t_s: float
    pose: FloatArray
    velocity: FloatArray = field(default_factory=lambda: np.zeros(6))


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """One step: the foot leaves one print and lands on the next.

    Attributes:
        start_s, end_s: heel-off, and flat again.
        to: where it lands.
        clearance_m: how much higher the ankle swings than the straight way.
        push_rad, strike_rad: how far the heel is up at toe-off, and the toes are up at heel strike.
        via: poses on the way, in order.
        push_s, land_s: how long the foot turns on its ball and on its heel; shares of the step when not given.
    """

    start_s: float
    end_s: float
    to: Print
    clearance_m: float = 0.05
    push_rad: float = 0.6
    strike_rad: float = 0.25
    via: Sequence[Waypoint] = ()
    push_s: float | None = None
    land_s: float | None = None

    @property
    def toe_off_s(self) -> float:
        """When the ball leaves the floor."""
        return self.start_s + (self.push_s or PUSH_SHARE * (self.end_s - self.start_s))

    @property
    def strike_s(self) -> float:
        """When the heel meets the floor."""
        return self.end_s - (self.land_s or LAND_SHARE * (self.end_s - self.start_s))


class FootPath:
    """A foot that stands and steps, as a function of time; it stands before the first step and after the last.

    Args:
        sole: of the foot.
        start: where it stands first.
        steps: in order of time; they do not overlap.
    """

    def __init__(self, sole: Sole, start: Print, steps: Sequence[PlannedStep]) -> None:
        self._sole = sole
        self.steps = tuple(steps)
        self._starts: list[float] = []
        self._coefficients: list[FloatArray] = []
        self._pivots: list[tuple[bool, FloatArray, FloatArray]] = []
        prints = [start, *(step.to for step in steps)]
        self._prints = np.array([[place.x, place.z, place.yaw] for place in prints])
        self._add_still(-np.inf, start)
        for before, step in zip(prints, steps, strict=False):
            self._add_step(before, step)
            self._add_still(step.end_s, step.to)
        self._start = np.array(self._starts)
        self._coefficient = np.array(self._coefficients)
        self._pivoted = np.array([pivot[0] for pivot in self._pivots])
        self._pivot = np.array([pivot[1] for pivot in self._pivots])
        self._pivot_local = np.array([pivot[2] for pivot in self._pivots])

    def ankles(self, t_s: FloatArray) -> FloatArray:
        """Return T_rig_ankle (N, 4, 4) at times (N,), seconds."""
        segment = np.searchsorted(self._start, t_s, side="right") - 1
        start = self._start[segment]
        elapsed = np.where(np.isfinite(start), t_s - start, 0.0)
        powers = elapsed[:, None] ** np.arange(_DEGREE + 1)
        pose = np.einsum("nck,nk->nc", self._coefficient[segment], powers)
        T = np.zeros((len(t_s), 4, 4))
        T[:, :3, :3] = rotations(pose[:, YAW], pose[:, PITCH], pose[:, ROLL])
        T[:, :3, 3] = pose[:, :3]
        T[:, 3, 3] = 1.0
        turning = self._pivoted[segment]
        lever = np.einsum("nij,nj->ni", T[turning, :3, :3], self._pivot_local[segment[turning]])
        T[turning, :3, 3] = self._pivot[segment[turning]] - lever
        return T

    def footprints(self, t_s: FloatArray) -> FloatArray:
        """Return where the body takes the foot to be, (N, 3): x, z and yaw, on its way between prints.

        The body sets out before the foot does and arrives after it, which makes the steps of two feet an even walk.
        Poses in the air do not show: a kick does not move the body.
        """
        place = np.tile(self._prints[0], (len(t_s), 1))
        for change, step in zip(np.diff(self._prints, axis=0), self.steps, strict=True):
            early = _BODY_LEAD * (step.end_s - step.start_s)
            place += ramp(t_s, step.start_s - early, step.end_s + early)[:, None] * change
        return place

    def airborne(self, t_s: FloatArray) -> FloatArray:
        """Return (N,) how much the foot is off the floor, 0 to 1, smooth in time."""
        air = np.zeros(len(t_s))
        for step in self.steps:
            rise = (t_s - step.start_s) / (step.toe_off_s - step.start_s)
            fall = (step.end_s - t_s) / (step.end_s - step.strike_s)
            air = np.maximum(air, _minimum_jerk(np.clip(np.minimum(rise, fall), 0.0, 1.0)))
        return air

    def flat(self, t_s: FloatArray) -> NDArray[np.bool_]:
        """Tell (N,) when the whole sole rests on the floor, so that the foot does not move at all."""
        standing = np.ones(len(t_s), dtype=bool)
        for step in self.steps:
            standing &= (t_s < step.start_s) | (t_s >= step.end_s)
        return standing

    def _add(self, start_s: float, coefficients: FloatArray, pivot: tuple[FloatArray, FloatArray] | None) -> None:
        self._starts.append(start_s)
        self._coefficients.append(coefficients)
        self._pivots.append((False, np.zeros(3), np.zeros(3)) if pivot is None else (True, *pivot))

    def _add_still(self, start_s: float, place: Print) -> None:
        coefficients = np.zeros((6, _DEGREE + 1))
        coefficients[:, 0] = self._standing(place)
        self._add(start_s, coefficients, None)

    def _standing(self, place: Print) -> FloatArray:
        return np.array([place.x, self._sole.ankle_height_m, place.z, place.yaw, 0.0, 0.0])

    def _add_step(self, before: Print, step: PlannedStep) -> None:
        push_s, land_s = step.toe_off_s - step.start_s, step.end_s - step.strike_s
        toe_off = self._pivot_end(before, self._sole.ball, -step.push_rad, -_PIVOT_RATE * step.push_rad / push_s)
        strike = self._pivot_end(step.to, self._sole.heel, step.strike_rad, -_PIVOT_RATE * step.strike_rad / land_s)
        self._add_pivot(step.start_s, push_s, before, self._sole.ball, (self._rest(before), toe_off))
        knots: list[tuple[float, FloatArray]] = [(step.toe_off_s, toe_off)]
        knots += [(via.t_s, np.stack([via.pose, via.velocity, np.zeros(6)])) for via in step.via]
        knots.append((step.strike_s, strike))
        for (t_from, begin), (t_to, end) in pairwise(knots):
            coefficients = _quintic(begin, end, t_to - t_from)
            if not step.via:
                coefficients[Y] += _bump(step.clearance_m, t_to - t_from)
            self._add(t_from, coefficients, None)
        self._add_pivot(step.strike_s, land_s, step.to, self._sole.heel, (strike, self._rest(step.to)))

    def _add_pivot(
        self, start_s: float, duration_s: float, place: Print, local: FloatArray, ends: tuple[FloatArray, FloatArray]
    ) -> None:
        standing = self._standing(place)
        R = rotation_y(place.yaw)
        self._add(start_s, _quintic(*ends, duration_s), (standing[:3] + R @ local, local))

    def _rest(self, place: Print) -> FloatArray:
        return np.stack([self._standing(place), np.zeros(6), np.zeros(6)])

    def _pivot_end(self, place: Print, local: FloatArray, pitch: float, rate: float) -> FloatArray:
        """Return place, velocity and acceleration (3, 6) of a foot that turns about a point of its sole evenly."""
        standing = self._standing(place)
        heading = rotation_y(place.yaw)
        pivot = standing[:3] + heading @ local
        state = np.stack([standing, np.zeros(6), np.zeros(6)])
        state[:2, PITCH] = pitch, rate
        # Rx' = Rx · [x]×, and so on.
        slope = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
        turned = heading @ rotation_x(pitch)
        state[0, :3] = pivot - turned @ local
        state[1, :3] = -turned @ slope @ local * rate
        state[2, :3] = -turned @ slope @ slope @ local * rate**2
        return state


def rotations(yaw: FloatArray, pitch: FloatArray, roll: FloatArray) -> FloatArray:
    """Return Ry(yaw) · Rx(pitch) · Rz(roll), (N, 3, 3), of angles (N,), radians."""
    cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch, roll) for f in (np.cos, np.sin))
    R = np.empty((len(yaw), 3, 3))
    R[:, 0, 0], R[:, 0, 1], R[:, 0, 2] = cy * cr + sy * sp * sr, -cy * sr + sy * sp * cr, sy * cp
    R[:, 1, 0], R[:, 1, 1], R[:, 1, 2] = cp * sr, cp * cr, -sp
    R[:, 2, 0], R[:, 2, 1], R[:, 2, 2] = -sy * cr + cy * sp * sr, sy * sr + cy * sp * cr, cy * cp
    return R


def _quintic(begin: FloatArray, end: FloatArray, duration_s: float) -> FloatArray:
    """Return coefficients (C, 7), lowest first, that meet value, velocity and acceleration (3, C) at both ends."""
    d = duration_s
    p0, v0, a0 = begin
    p1, v1, a1 = end
    rest = p1 - p0
    coefficients = np.zeros((len(p0), _DEGREE + 1))
    coefficients[:, 0], coefficients[:, 1], coefficients[:, 2] = p0, v0, a0 / 2.0
    coefficients[:, 3] = (20.0 * rest - (8.0 * v1 + 12.0 * v0) * d - (3.0 * a0 - a1) * d**2) / (2.0 * d**3)
    coefficients[:, 4] = (-30.0 * rest + (14.0 * v1 + 16.0 * v0) * d + (3.0 * a0 - 2.0 * a1) * d**2) / (2.0 * d**4)
    coefficients[:, 5] = (12.0 * rest - 6.0 * (v1 + v0) * d - (a0 - a1) * d**2) / (2.0 * d**5)
    return coefficients


def _bump(height: float, duration_s: float) -> FloatArray:
    """Return coefficients (7,) of 64 h · s³ (1 − s)³, s the share of the duration that is over."""
    shape = np.array([0.0, 0.0, 0.0, 1.0, -3.0, 3.0, -1.0])
    bump: FloatArray = 64.0 * height * shape / duration_s ** np.arange(_DEGREE + 1)
    return bump


def _minimum_jerk(share: FloatArray) -> FloatArray:
    smooth: FloatArray = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    return smooth
