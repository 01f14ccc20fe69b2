"""The programs: what the simulated person can be asked to do.

The first four repeat the stationary tests of the 2021 thesis, six others its walking tasks. Ours are
walking on the spot, forwards and backwards, along a narrow curve, over obstacles with knee raises and kicks, squatting
and kneeling, and a seated person. Every program ends where it began and is repeated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_sim.walker.foot_path import OUTWARDS, SIDES, Choreographer, Plan, Posture, Print, Sole
from rhot_sim.walker.sway import draw_wave, swaying
from rhot_sim.world.motion import bump

# The six walking tasks of the 2021 thesis: what its persons did for Table 5.1.
#
# One step forward and back, sideways steps, a straight line of 2 m, a circle of 2 m (its diameter, as we read it),
# bending the knees, turning the upper body over standing feet. How fast, and how often, the thesis does not say: beats
# and step lengths are those of the other programs.

LINE_M: Final = 2.0
CIRCLE_M: Final = 2.0
"""Diameter."""
_TURN_STEPS: Final = 4
"""Of each foot for half a turn on the spot."""


def step(body: BodyModel, steps: Choreographer) -> Plan:
    """One step forward with one foot, the other beside it, and back."""
    rng = steps.rng
    steps.pause(1.0)
    for _ in range(4):
        length = rng.uniform(0.24, 0.36) * body.height_m
        first = int(rng.integers(2))
        order = (SIDES[first], SIDES[1 - first])
        for z in (-length, 0.0):
            beat_s = rng.uniform(0.55, 0.7)
            targets = [(side, near(steps.place(side, 0.0, z, 0.0), rng, 0.012)) for side in order]
            steps.walk(targets, beat_s, level=z == 0.0)
            steps.pause(rng.uniform(0.4, 1.0))
    steps.return_to_start()
    return steps.plan(swaying(rng))


def side_steps(body: BodyModel, steps: Choreographer) -> Plan:
    """Four steps to the left and four back, several times."""
    rng = steps.rng
    steps.pause(1.0)
    for _ in range(3):
        beat_s = rng.uniform(0.5, 0.65)
        length = rng.uniform(0.14, 0.2) * body.height_m
        way: tuple[tuple[Side, Side], tuple[Side, Side]] = (("left", "right"), ("right", "left"))
        for leading, order in enumerate(way):
            for number in range(4):
                x = length * (-(number + 1.0) if leading == 0 else number - 3.0)
                targets = [(side, near(steps.place(side, x, 0.0, 0.0), rng, 0.015)) for side in order]
                steps.walk(targets, beat_s, clearance_m=0.05, level=True)
            steps.pause(rng.uniform(0.3, 0.8))
    steps.return_to_start()
    return steps.plan(swaying(rng))


def line(body: BodyModel, steps: Choreographer) -> Plan:
    """Two metres straight ahead, half a turn on the spot, two metres back and the same turn undone."""
    rng = steps.rng
    steps.pause(1.0)
    count = int(np.ceil(LINE_M / (rng.uniform(0.28, 0.36) * body.height_m)))
    beat_s = rng.uniform(0.54, 0.68)
    for begin, yaw in ((0.0, 0.0), (-LINE_M, np.pi)):
        way = LINE_M if yaw else -LINE_M
        targets = []
        for number in range(1, count + 2):
            side = SIDES[number % 2]
            far = begin + way * min(number, count) / count
            targets.append((side, near(steps.place(side, 0.0, far, yaw), rng, 0.012)))
        steps.walk(targets, beat_s)
        steps.pause(rng.uniform(0.3, 0.6))
        end = begin + way
        turn = []
        for number in range(1, 2 * _TURN_STEPS + 1):
            side = SIDES[(number + (yaw > 0.0)) % 2]
            share = np.ceil(number / 2) / _TURN_STEPS
            turn.append((side, steps.place(side, 0.0, end, yaw + np.pi * share * (-1.0 if yaw else 1.0))))
        steps.walk(turn, 0.55, level=True)
        steps.pause(rng.uniform(0.3, 0.6))
    steps.return_to_start()
    return steps.plan(swaying(rng))


def circle(body: BodyModel, steps: Choreographer) -> Plan:
    """Once around a circle of two metres' diameter to the left, then the whole turn undone on the spot."""
    steps.pause(1.0)
    return around(steps, 0.5 * CIRCLE_M, int(np.ceil(np.pi * CIRCLE_M / (0.27 * body.height_m))))


def around(steps: Choreographer, radius_m: float, count: int) -> Plan:
    """Walk once around a circle to the left in `count` steps, then turn on the spot to the right."""
    rng = steps.rng
    beat_s = rng.uniform(0.52, 0.66)
    targets = []
    for number in range(1, count + 1):
        turn = 2.0 * np.pi * number / count
        x, z = radius_m * (np.cos(turn) - 1.0), -radius_m * np.sin(turn)
        side = SIDES[number % 2]
        targets.append((side, near(steps.place(side, x, z, turn), rng, 0.01)))
    last = SIDES[(count + 1) % 2]
    targets.append((last, steps.place(last, 0.0, 0.0, 2.0 * np.pi)))
    steps.walk(targets, beat_s)
    steps.pause(1.0)
    turns = []
    for number in range(1, 9):
        side = SIDES[number % 2]
        turns.append((side, steps.place(side, 0.0, 0.0, 2.0 * np.pi * (1.0 - number / 8.0))))
    steps.walk([*turns, *((side, steps.start[side]) for side in ("right", "left"))], 0.6, level=True)
    return steps.plan(swaying(rng))


def bend_knees(body: BodyModel, steps: Choreographer) -> Plan:
    """The knees bend over flat feet, again and again, from slightly to a half squat."""
    rng = steps.rng
    bends = []
    steps.pause(1.0)
    for _ in range(6):
        began_s = steps.pause(rng.uniform(1.8, 2.8))
        bends.append((began_s, steps.t_s, rng.uniform(0.08, 0.26) * body.height_m / 1.75))
        steps.pause(rng.uniform(0.3, 0.8))
    sway = swaying(rng)

    def posture(t: FloatArray) -> Posture:
        held = sway(t)
        bend = sum((depth * bump(t, start, end, 0.8) for start, end, depth in bends), np.zeros(len(t)))
        # The weight goes backwards over the heels, and the trunk leans forward against it.
        shift = held.shift_m + np.stack([np.zeros(len(t)), 0.3 * bend], axis=-1)
        return replace(held, drop_m=held.drop_m + bend, shift_m=shift, lean_rad=held.lean_rad + 0.6 * bend)

    return steps.plan(posture)


def turn_body(body: BodyModel, steps: Choreographer) -> Plan:
    """Hips and trunk turn left and right over standing feet, and the head further still."""
    rng = steps.rng
    turns = []
    steps.pause(1.0)
    for number in range(6):
        began_s = steps.pause(rng.uniform(1.8, 2.8))
        turns.append((began_s, steps.t_s, (-1.0) ** number * rng.uniform(0.6, 1.0)))
        steps.pause(rng.uniform(0.2, 0.6))
    sway = swaying(rng)

    def posture(t: FloatArray) -> Posture:
        held = sway(t)
        turned = sum((much * bump(t, start, end, 0.8) for start, end, much in turns), np.zeros(len(t)))
        head = held.head_rad + np.stack([np.radians(35.0) * turned, *np.zeros((2, len(t)))], axis=-1)
        return replace(held, turn_rad=np.radians(25.0) * turned, drop_m=held.drop_m + 0.015 * turned**2, head_rad=head)

    return steps.plan(posture)


def near(place: Print, rng: np.random.Generator, spread_m: float) -> Print:
    """Return a footprint that misses its target as people do."""
    x, z = rng.normal(0.0, spread_m, 2).clip(-2.0 * spread_m, 2.0 * spread_m)
    return Print(place.x + x, place.z + z, place.yaw + float(rng.normal(0.0, 0.03)))


Bends = list[tuple[float, float, float]]

_STATIONARY_S: Final = 30.0
LOOK_AT_MARKER: Final = "look_at_marker"
"""For `rhot calibrate headset`; nobody tracks feet meanwhile."""
_LOOK_PERIODS_S: Final = (13.0, 9.0, 11.0, 8.0, 6.1, 4.3, 7.7, 10.0)
"""Of drop, shift sideways and back, lean, yaw, pitch and roll of the head, and turn of the body: a person at ease."""


def plan_program(program: str, body: BodyModel, sole: Sole, rng: np.random.Generator) -> Plan:
    """Return what a person of these lengths does in a program, one of `PROGRAMS` or `LOOK_AT_MARKER`."""
    return {**PROGRAMS, LOOK_AT_MARKER: _look_at_marker}[program](
        body, Choreographer(sole, 1.15 * body.hip_width_m, rng)
    )


def _still(body: BodyModel, steps: Choreographer) -> Plan:
    steps.pause(_STATIONARY_S)
    return steps.plan(swaying(steps.rng, glances=False))


def _marker_moving(body: BodyModel, steps: Choreographer) -> Plan:
    """One foot is moved about over the floor for half a minute, with a rest on the floor now and then."""
    rng = steps.rng
    side: Side = "right" if rng.random() < 0.5 else "left"
    while steps.t_s < _STATIONARY_S:
        steps.pause(1.0)
        t_s = steps.t_s + 0.8
        via = []
        for _ in range(6):
            out = OUTWARDS[side] * rng.uniform(-0.02, 0.2)
            place = np.array([out, rng.uniform(0.05, 0.2), rng.uniform(-0.5, -0.12)])
            turn = np.radians(rng.uniform((-25.0, -20.0, -8.0), (25.0, 20.0, 8.0)))
            via.append(steps.off(side, t_s, np.concatenate([place, turn])))
            t_s += rng.uniform(0.4, 0.9)
        steps.lift(side, via, 0.8)
    return steps.plan(swaying(rng, glances=False))


def _head_moving(body: BodyModel, steps: Choreographer) -> Plan:
    """The feet stand; hips and head move about, up to about half a metre and 60 degrees a second."""
    steps.pause(_STATIONARY_S)
    sway = swaying(steps.rng, glances=False)
    waves = [draw_wave(steps.rng, (0.15, 0.9)) for _ in range(7)]

    def posture(t: FloatArray) -> Posture:
        held = sway(t)
        begin = bump(t, 0.5, 1e9, 1.0)
        move = np.stack([begin * wave(t) for wave in waves], axis=-1)
        return Posture(
            0.008 * (begin + move[:, 0]),
            held.shift_m + move[:, 1:3] * [0.07, 0.05],
            held.lean_rad + 0.05 * begin + 0.12 * move[:, 3],
            held.head_rad + move[:, 4:7] * np.radians([12.0, 8.0, 7.0]),
            held.look,
            held.turn_rad,
        )

    return steps.plan(posture)


def _look_at_marker(body: BodyModel, steps: Choreographer) -> Plan:
    """The feet stand; the head nods, turns and tilts, the trunk leans to all sides and goes down, all of it slowly."""
    steps.pause(_STATIONARY_S)
    phases = steps.rng.uniform(0.0, 2.0 * np.pi, len(_LOOK_PERIODS_S))
    rates = 2.0 * np.pi / (np.array(_LOOK_PERIODS_S) * steps.rng.uniform(0.9, 1.1, len(_LOOK_PERIODS_S)))

    def posture(t: FloatArray) -> Posture:
        held = Posture.upright(len(t))
        begin = bump(t, 0.5, 1e9, 1.0)
        wave = begin[:, None] * np.sin(t[:, None] * rates + phases)
        return Posture(
            0.12 * (begin + wave[:, 0]),
            held.shift_m + wave[:, 1:3] * [0.09, 0.07] + [0.0, 0.04],
            held.lean_rad + 0.2 + 0.12 * wave[:, 3],
            held.head_rad + wave[:, 4:7] * np.radians([22.0, 12.0, 20.0]),
            held.look,
            held.turn_rad + np.radians(15.0) * wave[:, 7],
        )

    return steps.plan(posture)


def _sudden(body: BodyModel, steps: Choreographer) -> Plan:
    """Standing, and suddenly a kick, a lunge or a stamp with one foot."""
    rng = steps.rng
    kind = 0
    while steps.t_s < _STATIONARY_S:
        steps.pause(rng.uniform(1.2, 2.2))
        t_s = steps.t_s
        side = SIDES[int(rng.integers(2))]
        out = OUTWARDS[side]
        offset = {
            0: np.array([0.05 * out, 0.25, -0.45, 0.0, 0.4, 0.0]),
            1: np.array([0.30 * out, 0.15, -0.05, -0.3 * out, 0.0, 0.1 * out]),
            2: np.array([0.0, 0.30, -0.20, 0.0, -0.3, 0.0]),
        }[kind % 3]
        kind += 1
        fast_s = rng.uniform(0.24, 0.32)
        out_s = t_s + 0.12 + fast_s
        hold_s = out_s + rng.uniform(0.1, 0.4)
        via = [steps.off(side, out_s, offset), steps.off(side, hold_s, offset)]
        steps.lift(side, via, fast_s + 0.09, push_s=0.12)
    return steps.plan(swaying(rng))


def _on_spot(body: BodyModel, steps: Choreographer) -> Plan:
    rng = steps.rng
    steps.pause(1.0)
    beat_s = rng.uniform(0.5, 0.62)
    for _ in range(4):
        targets: list[tuple[Side, Print]] = [
            (side, near(steps.start[side], rng, 0.02)) for _ in range(5) for side in SIDES
        ]
        targets[-2:] = [(side, steps.start[side]) for side in SIDES]
        steps.walk(targets, beat_s, clearance_m=rng.uniform(0.06, 0.13), level=True)
        steps.pause(rng.uniform(0.4, 1.2))
    return steps.plan(swaying(rng))


def _walk(body: BodyModel, steps: Choreographer) -> Plan:
    """Forwards, then backwards to where it began, several times."""
    rng = steps.rng
    steps.pause(1.0)
    for _ in range(4):
        beat_s = rng.uniform(0.54, 0.68)
        length = rng.uniform(0.24, 0.33) * body.height_m
        count = int(rng.integers(3, 5))
        heading = rng.uniform(-0.2, 0.2)
        steps.walk(_line(steps, 0.0, -length, count, heading), beat_s)
        steps.pause(rng.uniform(0.3, 0.8))
        back = rng.uniform(0.5, 0.7) * length
        number = int(np.ceil(count * length / back))
        steps.walk(_line(steps, -count * length, count * length / number, number, heading), 1.1 * beat_s, level=True)
        steps.pause(rng.uniform(0.3, 0.8))
    steps.return_to_start()
    return steps.plan(swaying(rng))


def _curve(body: BodyModel, steps: Choreographer) -> Plan:
    """Once around a circle to the left, then a turn on the spot to the right."""
    rng = steps.rng
    steps.pause(1.0)
    radius_m, count = rng.uniform(0.6, 0.9), int(rng.integers(12, 15))
    return around(steps, radius_m, count)


def _step_over(body: BodyModel, steps: Choreographer) -> Plan:
    """Over an obstacle and back, knee raises, kicks."""
    rng = steps.rng
    steps.pause(1.0)
    for _ in range(2):
        length = rng.uniform(0.3, 0.36) * body.height_m
        for way in (-length, 0.0):
            for side in SIDES:
                to = steps.place(side, 0.0, way, 0.0)
                steps.step(side, to, rng.uniform(0.9, 1.1), clearance_m=rng.uniform(0.15, 0.22))
                steps.pause(0.2)
        for side in SIDES:
            up_s, hold_s = steps.t_s + 0.55, steps.t_s + 0.55 + rng.uniform(0.1, 0.5)
            raised = np.array([0.0, 0.36, -0.22, 0.0, -0.25, 0.0]) * body.height_m / 1.75
            via = [steps.off(side, up_s, raised), steps.off(side, hold_s, raised)]
            steps.lift(side, via, 0.6)
            steps.pause(0.4)
            out_s = steps.t_s + rng.uniform(0.42, 0.5)
            kick = np.array([0.0, 0.22, -0.5, 0.0, 0.3, 0.0]) * body.height_m / 1.75
            via = [steps.off(side, out_s, kick)]
            steps.lift(side, via, 0.6, push_s=0.15)
            steps.pause(0.5)
    return steps.plan(swaying(rng))


def _squat(body: BodyModel, steps: Choreographer) -> Plan:
    """Squats on flat feet, and kneeling on either knee."""
    rng = steps.rng
    scale = body.height_m / 1.75
    squats: Bends = []
    kneels: Bends = []
    steps.pause(1.0)
    for _ in range(2):
        began_s = steps.pause(rng.uniform(2.4, 3.2))
        squats.append((began_s, steps.t_s, rng.uniform(0.22, 0.34) * scale))
        steps.pause(0.6)
        side = SIDES[int(rng.integers(2))]
        rear: Side = "left" if side == "right" else "right"
        steps.step(side, steps.place(side, 0.0, -0.42 * scale, 0.0), 0.9)
        began_s = steps.t_s
        via = [steps.on_ball(rear, began_s + 1.0, 1.0), steps.on_ball(rear, began_s + 2.4, 1.0)]
        steps.lift(rear, via, 0.8, push_rad=0.9, push_s=0.7)
        kneels.append((began_s + 0.2, steps.t_s - 0.1, 0.46 * scale))
        steps.step(side, steps.start[side], 1.0, strike_rad=0.05)
        steps.pause(rng.uniform(0.6, 1.2))
    sway = swaying(rng)

    def posture(t: FloatArray) -> Posture:
        held = sway(t)
        squat = sum((depth * bump(t, start, end, 0.9) for start, end, depth in squats), np.zeros(len(t)))
        kneel = sum((depth * bump(t, start, end, 0.9) for start, end, depth in kneels), np.zeros(len(t)))
        # The weight goes backwards over the heels, and the trunk leans forward against it.
        shift = held.shift_m + np.stack([np.zeros(len(t)), 0.35 * squat], axis=-1)
        return replace(held, drop_m=squat + kneel, shift_m=shift, lean_rad=held.lean_rad + 0.6 * squat)

    return steps.plan(posture)


def _sitting(body: BodyModel, steps: Choreographer) -> Plan:
    """On a chair: feet are put forward, raised, tapped, crossed over a little."""
    rng = steps.rng
    scale = body.height_m / 1.75
    while steps.t_s < _STATIONARY_S:
        steps.pause(rng.uniform(0.6, 1.5))
        side = SIDES[int(rng.integers(2))]
        out = OUTWARDS[side]
        forward = steps.place(side, out * rng.uniform(0.0, 0.08), -rng.uniform(0.05, 0.17) * scale, 0.0)
        steps.step(side, forward, rng.uniform(0.7, 1.0), clearance_m=0.06, push_rad=0.2, strike_rad=0.2)
        steps.pause(rng.uniform(0.2, 0.8))
        up_s = steps.t_s + 0.6
        raised = np.array([0.0, 0.18, -0.08, 0.0, rng.uniform(0.0, 0.4), 0.0]) * scale
        via = [steps.off(side, up_s, raised), steps.off(side, up_s + rng.uniform(0.2, 0.6), raised)]
        steps.lift(side, via, 0.4)
        steps.step(side, steps.start[side], rng.uniform(0.7, 1.0), clearance_m=0.05, push_rad=0.2, strike_rad=0.1)
    seat_m = body.leg_m - 1.06 * body.shank_m
    back_m = 1.25 * body.thigh_m
    sway = swaying(rng)

    def posture(t: FloatArray) -> Posture:
        held = sway(t)
        return replace(held, drop_m=held.drop_m + seat_m, shift_m=held.shift_m + np.array([0.0, back_m]))

    return steps.plan(posture)


def _line(steps: Choreographer, z: float, stride: float, count: int, heading: float) -> list[tuple[Side, Print]]:
    """Return footprints of `count` steps of length `stride` (backwards positive) from `z` on, then feet together.

    `heading` is the direction of the line through the start; the body faces along it, whichever way it walks.
    """
    first = int(steps.rng.integers(2))
    targets = []
    for number in range(1, count + 2):
        side = SIDES[(first + number) % 2]
        far = z + stride * min(number, count)
        place = steps.place(side, far * np.sin(heading), far * np.cos(heading), heading)
        targets.append((side, near(place, steps.rng, 0.012)))
    return targets


PROGRAMS: Final[dict[str, Callable[[BodyModel, Choreographer], Plan]]] = {
    "still": _still,
    "marker_moving": _marker_moving,
    "head_moving": _head_moving,
    "sudden": _sudden,
    "step": step,
    "side_steps": side_steps,
    "line": line,
    "circle": circle,
    "bend_knees": bend_knees,
    "turn_body": turn_body,
    "on_spot": _on_spot,
    "walk": _walk,
    "curve": _curve,
    "step_over": _step_over,
    "squat": _squat,
    "sitting": _sitting,
}
