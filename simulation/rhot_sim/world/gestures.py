"""The gestures that the simulated hand makes, as control values of splines.

A gesture takes `GESTURE_S` seconds and begins and ends at ease, so that gestures can follow one another in any order.
Angles are in degrees here, the way gestures are thought of: rows are fingers, columns those of `rhot.anatomy.hand`
without the last hinge, which follows from the one before it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_sim.world.spline import bump, ramp

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
