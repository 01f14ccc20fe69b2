"""The scripted motion: gestures and grasps that follow from the seed alone, for as long as anybody asks.

Time is cut into cycles of four gestures' length. In each, the leading hand makes a gesture, grasps an object, carries
it to its next place, puts it down, and makes another gesture; the other hand makes four gestures. Nothing has to
be remembered from cycle to cycle: where an object lies in cycle c follows from c.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_sim.world.motion import (
    OBJECT_SIZE_M,
    PALM_FORWARD_M,
    MotionSample,
    bump,
    evaluate_spline,
    home_x_m,
    lying_pose,
    ramp,
    wrist_poses,
)

# The gestures that the simulated hand makes, as control values of splines.
#
# A gesture takes `GESTURE_S` seconds and begins and ends at ease, so that gestures can follow one another in any order.
# Angles are in degrees here, the way gestures are thought of: rows are fingers, columns those of `rhot.anatomy.hand`
# without the last hinge, which follows from the one before it.

Random = np.random.Generator

GESTURE_S: Final = 4.0
EASE_DEG: Final[FloatArray] = np.array([[6, 6, 10], [6, 4, 12], [5, 0, 13], [6, -3, 14], [8, -6, 16]], dtype=float)
"""A hand at ease."""
OPEN_DEG: Final[FloatArray] = np.array([[0, 12, 4], [2, 10, 4], [2, 0, 4], [2, -8, 5], [3, -12, 6]], dtype=float)
"""A spread hand."""
GRIP_DEG: Final[FloatArray] = np.array([[6, 4, 12], [26, 2, 14], [24, 0, 14], [26, -1, 14], [28, -3, 14]], dtype=float)
"""A hand around the object."""
REACH_DEG: Final[FloatArray] = np.array([[-6, 4, 4], [6, 6, 6], [4, 0, 6], [6, -4, 7], [8, -8, 8]], dtype=float)
"""A hand about to grasp."""

Gesture = Callable[[FloatArray, Random], tuple[FloatArray, FloatArray]]
"""From control times (K,) within the gesture to finger angles (K, 5, 3), degrees, and a placement to add (K, 6)."""


def _wiggle(t: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
    fingers = _eased(t)
    rate_hz = rng.uniform(0.7, 1.2)
    phase = rng.uniform(0.0, 2.0 * np.pi, 5)
    wave = 0.5 - 0.5 * np.cos(2.0 * np.pi * rate_hz * t[:, None] + phase)
    envelope = bump(t, 0.1, 3.9, 0.6)[:, None]
    fingers[:, :, 0] += envelope * wave * np.array([12.0, 30.0, 30.0, 28.0, 28.0])
    fingers[:, :, 2] += envelope * wave[:, ::-1] * 18.0
    fingers[:, :, 1] += envelope * (wave - 0.5) * np.array([20.0, 10.0, 0.0, 8.0, 10.0])
    return fingers, _sway(t, rng, envelope[:, 0])


def _curl(t: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
    fingers = _eased(t)
    bent = np.array([[30.0, 0.0, 45.0], [62.0, 0.0, 85.0], [62.0, 0.0, 85.0], [60.0, 0.0, 85.0], [58.0, 0.0, 80.0]])
    for index, finger in enumerate(rng.permutation(5)):
        start = 0.2 + 0.68 * index
        amount = bump(t, start, start + 0.85, 0.4)[:, None]
        fingers[:, finger] += amount * (bent[finger] - EASE_DEG[finger])
    return fingers, _sway(t, rng, bump(t, 0.1, 3.9, 0.6))


def _pinch(t: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
    fingers = _eased(t)
    thumb = np.array([34.0, 28.0, 22.0])
    for start, finger in ((0.2, 1), (2.0, int(rng.integers(1, 3)))):
        amount = bump(t, start, start + 1.7, 0.6)[:, None]
        fingers[:, 0] += amount * (thumb - EASE_DEG[0])
        fingers[:, finger] += amount * (np.array([48.0, 4.0 * (finger == 1), 42.0]) - EASE_DEG[finger])
    return fingers, _sway(t, rng, bump(t, 0.1, 3.9, 0.6))


def _wave(t: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
    fingers = _eased(t)
    envelope = bump(t, 0.1, 3.9, 0.9)
    fingers += envelope[:, None, None] * (OPEN_DEG - EASE_DEG)
    rate_hz = rng.uniform(0.9, 1.4)
    swing = np.sin(2.0 * np.pi * rate_hz * t) * envelope
    placement = _sway(t, rng, envelope)
    placement[:, 0] += 0.06 * swing
    placement[:, 3] -= np.radians(15.0) * swing
    return fingers, placement


def _rest(t: FloatArray, rng: Random) -> tuple[FloatArray, FloatArray]:
    fingers = _eased(t)
    share = rng.uniform(0.0, 0.6)
    still = bump(t, 0.2, 3.9, 0.8)
    fingers += still[:, None, None] * share * (OPEN_DEG - EASE_DEG)
    placement = still[:, None] * rng.uniform(-1.0, 1.0, 6) * np.radians([0.0, 0.0, 0.0, 6.0, 5.0, 5.0])
    return fingers, placement


GESTURES: Final[tuple[Gesture, ...]] = (_wiggle, _curl, _pinch, _wave, _rest)


def grasp(t: FloatArray) -> FloatArray:
    """Return the finger angles (K, 5, 3), degrees, of one grasp; its times are those of `rhot_sim.world.script`."""
    fingers = _eased(t)
    fingers += ramp(t, 0.4, 1.4)[:, None, None] * (REACH_DEG - EASE_DEG)
    fingers += bump(t, 2.5, 7.0, 0.6)[:, None, None] * (GRIP_DEG - REACH_DEG)
    fingers -= ramp(t, 6.9, 7.8)[:, None, None] * (REACH_DEG - EASE_DEG)
    return fingers


def _eased(t: FloatArray) -> FloatArray:
    return np.tile(EASE_DEG, (len(t), 1, 1))


def _sway(t: FloatArray, rng: Random, envelope: FloatArray) -> FloatArray:
    """Return the small movement of a hand that is held in the air, (K, 6), metres and radians."""
    reach = np.array([0.008, 0.008, 0.010, np.radians(4.0), np.radians(5.0), np.radians(5.0)])
    rate_hz = rng.uniform(0.2, 0.6, 6)
    phase = rng.uniform(0.0, 2.0 * np.pi, 6)
    sway: FloatArray = reach * np.sin(2.0 * np.pi * rate_hz * t[:, None] + phase) * envelope[:, None]
    return sway


KNOT_S: Final = 0.1
CYCLE_S: Final = 4.0 * GESTURE_S
CYCLE_KNOTS: Final = round(CYCLE_S / KNOT_S)
GESTURE_KNOTS: Final = round(GESTURE_S / KNOT_S)

GRASP_START_S: Final = GESTURE_S
GRAB_S: Final = GRASP_START_S + 3.3
"""The object moves with the hand from here in each cycle; the wrist stands still about this moment."""
RELEASE_S: Final = GRASP_START_S + 6.4
"""The object stays where it is from here."""

HOVER_M: Final = 0.06
"""Height over the object before and after a grasp."""
CARRY_M: Final = 0.10
"""How high an object is carried."""
GRIP_M: Final[FloatArray] = np.array([0.0, -0.026 - OBJECT_SIZE_M[1] / 2.0, -0.108])
"""Centre of a held object in the wrist frame, metres; the axes are the wrist's."""
_STREAMS: Final = {"right": 1, "left": 2, "objects": 3, "person": 4}


def seeded(seed: int, *keys: int) -> np.random.Generator:
    """Return the random numbers that belong to a seed and a place in the script."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, *keys])))


class ScriptedMotion:
    """Hands and objects as a function of (seed, time); before time 0 everything stands still.

    Args:
        seed: chooses everything.
        hands: whose limits the angles keep; the first side given grasps.
        objects: ids; they are grasped in turn.
        desk_z_m: distance of the desk from the reference camera.
    """

    def __init__(
        self, seed: int, hands: Mapping[Side, HandModel], objects: Sequence[str], desk_z_m: float = 0.95
    ) -> None:
        self._seed = seed
        self._hands = dict(hands)
        self._sides: tuple[Side, ...] = tuple(hands)
        self._objects = tuple(objects)
        self._desk_z_m = desk_z_m
        # Tables of pure functions: dropping or keeping an entry changes no result.
        self._controls: dict[Side, Callable[[int], FloatArray]] = {
            side: lru_cache(maxsize=32)(self._table_builder(side)) for side in self._sides
        }
        self._spot = lru_cache(maxsize=32)(self._random_spot)
        self._lying = lru_cache(maxsize=32)(self._lying_pose)

    def sample(self, t_s: FloatArray) -> MotionSample:
        """Return the motion at times (N,), seconds since the world's start."""
        t = np.maximum(np.asarray(t_s, dtype=np.float64), 0.0)
        wrists: dict[Side, FloatArray] = {}
        angles: dict[Side, FloatArray] = {}
        for side in self._sides:
            table = self._controls[side]

            def control(knot: int, table: Callable[[int], FloatArray] = table) -> FloatArray:
                cycle, place = divmod(max(knot, 0), CYCLE_KNOTS)
                row: FloatArray = table(cycle)[place]
                return row

            curve = evaluate_spline(t, KNOT_S, control)
            wrists[side] = wrist_poses(curve[:, :6])
            angles[side] = curve[:, 6:].reshape(-1, 5, 4)
        return MotionSample(wrists, angles, {name: self._object(name, t, wrists) for name in self._objects})

    def _object(self, name: str, t: FloatArray, wrists: Mapping[Side, FloatArray]) -> FloatArray:
        place, count = self._objects.index(name), len(self._objects)
        cycle = np.floor(t / CYCLE_S).astype(np.int64)
        phase = t - cycle * CYCLE_S
        mine = cycle % count == place if self._sides else np.zeros(len(t), dtype=bool)
        # Grasps of this object that were over when the cycle began.
        done = (cycle - place + count - 1) // count
        moved = done + (mine & (phase >= RELEASE_S))
        held = mine & (phase >= GRAB_S) & (phase < RELEASE_S)
        poses = np.empty((len(t), 4, 4))
        for number in np.unique(moved):
            poses[moved == number] = self._lying(place, int(number))
        if held.any():
            T = wrists[self._sides[0]][held]
            poses[held] = T
            poses[held, :3, 3] = T[:, :3, 3] + T[:, :3, :3] @ GRIP_M
        return poses

    def _lying_pose(self, place: int, number: int) -> FloatArray:
        """Return the pose (4, 4) of an object on the desk after `number` grasps."""
        return lying_pose(self._spot(place, number), self._desk_z_m)

    def _random_spot(self, place: int, number: int) -> FloatArray:
        """Return where an object lies after `number` grasps: x, y (metres) and yaw (radians)."""
        rng = seeded(self._seed, _STREAMS["objects"], place, number)
        count = len(self._objects)
        home = home_x_m(self._sides[0], self._sides) if self._sides else 0.0
        lane = 0.24 / count
        x = home + (place + 0.5) * lane - 0.12
        spread = min(0.10, lane / 2.0 - 0.02) if count > 1 else 0.10
        return np.array([x, 0.03, 0.0]) + rng.uniform(-1.0, 1.0, 3) * (max(spread, 0.0), 0.04, np.radians(12.0))

    def _station(self, side: Side, number: int) -> FloatArray:
        """Return where a hand makes gesture `number`: a placement (6,), see `wrist_poses`."""
        rng = seeded(self._seed, _STREAMS[side], 0, number)
        alone = len(self._sides) == 1
        middle = np.array([home_x_m(side, self._sides), -0.025, self._desk_z_m - (0.21 if alone else 0.14), 0, 0, 0])
        reach = np.array([0.12 if alone else 0.03, 0.05, 0.06 if alone else 0.01, 0, 0, 0])
        reach[3:] = np.radians([12.0, 10.0, 10.0])
        placed: FloatArray = middle + rng.uniform(-1.0, 1.0, 6) * reach
        return placed

    def _table_builder(self, side: Side) -> Callable[[int], FloatArray]:
        hand = self._hands[side]
        grasping = side == self._sides[0] and bool(self._objects)
        # People differ in how the last hinge follows the one before it.
        coupling = hand.coupling * seeded(self._seed, _STREAMS["person"]).uniform(0.92, 1.08, 5)

        def build(cycle: int) -> FloatArray:
            placement = np.empty((CYCLE_KNOTS, 6))
            fingers = np.empty((CYCLE_KNOTS, 5, 3))
            for quarter in range(4):
                rows = slice(quarter * GESTURE_KNOTS, (quarter + 1) * GESTURE_KNOTS)
                if grasping and quarter in (1, 2):
                    continue
                turn = 2 * cycle + quarter // 2 if grasping else 4 * cycle + quarter
                placement[rows], fingers[rows] = self._gesture(side, 4 * cycle + quarter, turn)
            if grasping:
                rows = slice(GESTURE_KNOTS, 3 * GESTURE_KNOTS)
                placement[rows], fingers[rows] = self._grasp(side, cycle)
            angles = np.empty((CYCLE_KNOTS, 5, 4))
            angles[..., :3] = np.radians(fingers)
            angles[..., 3] = coupling * angles[..., 2]
            return np.hstack([placement, hand.clamp(angles).reshape(-1, 20)])

        return build

    def _gesture(self, side: Side, number: int, turn: int) -> tuple[FloatArray, FloatArray]:
        t: FloatArray = np.arange(GESTURE_KNOTS, dtype=np.float64) * KNOT_S
        # Every gesture comes once in five, in an order of its own.
        order = seeded(self._seed, _STREAMS[side], 1, turn // len(GESTURES)).permutation(len(GESTURES))
        gesture = GESTURES[order[turn % len(GESTURES)]]
        fingers, movement = gesture(t, seeded(self._seed, _STREAMS[side], 2, number))
        start, end = self._station(side, max(number - 1, 0)), self._station(side, number)
        return start + ramp(t, 0.2, 1.5)[:, None] * (end - start) + movement, fingers

    def _grasp(self, side: Side, cycle: int) -> tuple[FloatArray, FloatArray]:
        t: FloatArray = np.arange(2 * GESTURE_KNOTS, dtype=np.float64) * KNOT_S
        count = len(self._objects)
        place, number = cycle % count, cycle // count
        start, end = self._station(side, 4 * cycle), self._station(side, 4 * cycle + 2)
        pick = self._over(self._spot(place, number))
        put = self._over(self._spot(place, number + 1))
        height = np.zeros(6)
        height[2] = -1.0
        placement = start + ramp(t, 0.2, 1.6)[:, None] * (pick + HOVER_M * height - start)
        placement -= ramp(t, 1.6, 2.4)[:, None] * HOVER_M * height
        placement += (ramp(t, 3.6, 4.4) - ramp(t, 5.2, 6.0))[:, None] * CARRY_M * height
        placement += ramp(t, 3.8, 5.7)[:, None] * (put - pick)
        placement += ramp(t, 6.9, 7.9)[:, None] * (end - put)
        return placement, grasp(t)

    def _over(self, spot: FloatArray) -> FloatArray:
        """Return the placement (6,) of a hand that holds the object lying at `spot`."""
        pose = lying_pose(spot, self._desk_z_m)
        ahead = pose[:3, :3] @ (np.array([0.0, 0.0, -PALM_FORWARD_M]) - GRIP_M)
        placement = np.zeros(6)
        placement[:3] = pose[:3, 3] + ahead
        placement[3] = spot[2]
        return placement
