"""The six walking tasks of the 2021 thesis: what its persons did for Table 5.1.

One step forward and back, sideways steps, a straight line of 2 m, a circle of 2 m (its diameter, as we read it),
bending the knees, turning the upper body over standing feet. How fast, and how often, the thesis does not say: beats
and step lengths are those of the other programs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from rhot.anatomy.body_proportions import BodyModel
from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_sim.walker.foot_path import Print
from rhot_sim.walker.plan import SIDES, Choreographer, Plan, Posture
from rhot_sim.walker.sway import swaying
from rhot_sim.world.spline import bump

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
