"""When an object was picked up, carried and put down, and what the hand did before and after.

Told from the object's own path and from how far the fingertips lie from its surface; no truth is needed. The phases are
those of the 2018 thesis's grabbing test.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import BoolArray, FloatArray
from rhot_ik.hand_core import body_of
from rhot_tools.grasp.session import TIPS, GraspSession

TOUCH_M: Final = 0.015
"""Gap up to which a finger counts as touching: three times the error aimed at for a hidden tip (5 mm)."""
_NEAR_M: Final = 0.04
"""Thumb and a finger nearer to the surface than this are about to close: the opening of a relaxed hand."""
_REACH_S: Final = 1.0
"""Of the phase before the hand is near."""
_RELEASE_S: Final = 2.0
"""Longest time that letting go may take."""
_WINDOW_S: Final = 0.2
"""Over which an object's speed is taken; a tracker's jitter of 0.3 mm then stays far below `_MOVING_M_S`."""
_MOVING_M_S: Final = 0.03
"""Faster = it moves; a hand that carries something is ten times as fast."""
_PAUSE_S: Final = 0.8
"""A shorter stop in the air does not end the carrying."""
_CARRIED_M: Final = 0.03
"""Farther from where it lay = it was carried, not pushed or jostled."""


@dataclass(frozen=True, slots=True)
class Pickup:
    """One grasp, as ranges of poses (first, one past the last).

    Attributes:
        reach: the hand comes.
        close: thumb and a finger are near, the object still lies.
        carry: the object moves.
        release: it lies again, until the hand is away.
    """

    reach: slice
    close: slice
    carry: slice
    release: slice

    def phases(self) -> dict[str, slice]:
        """Return all by name, in order."""
        return {"reach": self.reach, "close": self.close, "carry": self.carry, "release": self.release}


def gaps_m(session: GraspSession) -> FloatArray:
    """Return how far the flesh of each joint lies from the object's surface, (N, 26) metres, negative inside."""
    gaps = np.empty(session.joints.shape[:2])
    for row, (joints, T) in enumerate(zip(session.joints, session.objects, strict=True)):
        gaps[row] = body_of(session.shape, T).distance(joints)[0] - session.radii_m
    return gaps


def find_pickups(session: GraspSession, gaps: FloatArray) -> list[Pickup]:
    """Return every time that the object was carried while the hand was near.

    Args:
        session: hand and object.
        gaps: (N, 26) of `gaps_m`.
    """
    t_s = session.t_s
    near = opposed(gaps, _NEAR_M)
    found = []
    for first, last in _carried(t_s, session.objects[:, :3, 3]):
        if not near[first : last + 1].any():
            continue
        begun = first
        while begun > 0 and near[begun - 1]:
            begun -= 1
        away = last
        while away + 1 < len(t_s) and near[away] and t_s[away] - t_s[last] < _RELEASE_S:
            away += 1
        reached = int(np.searchsorted(t_s, t_s[begun] - _REACH_S))
        found.append(
            Pickup(slice(reached, begun), slice(begun, first), slice(first, last + 1), slice(last + 1, away + 1))
        )
    return found


def opposed(gaps: FloatArray, within_m: float) -> BoolArray:
    """Return (N,) whether the thumb's tip and another one lie no farther than this from the surface."""
    tips = gaps[:, list(TIPS)]
    together: BoolArray = (tips[:, 0] <= within_m) & (tips[:, 1:].min(axis=1) <= within_m)
    return together


def flesh() -> list[int]:
    """Return the joints whose flesh meets an object: those of the fingers, without the palm."""
    names = ("proximal", "intermediate", "distal", "tip")
    return [JOINTS.index(name) for name in JOINTS if name.rpartition("_")[2] in names]


def _carried(t_s: FloatArray, places: FloatArray) -> list[tuple[int, int]]:
    """Return the first and last pose of every stretch in which the object moved away from where it lay."""
    half = 0.5 * _WINDOW_S
    before = np.searchsorted(t_s, t_s - half)
    after = np.minimum(np.searchsorted(t_s, t_s + half), len(t_s) - 1)
    span_s = np.maximum(t_s[after] - t_s[before], 1e-6)
    moving = np.linalg.norm(places[after] - places[before], axis=1) / span_s > _MOVING_M_S
    stretches: list[tuple[int, int]] = []
    for row in np.flatnonzero(moving).tolist():
        if stretches and t_s[row] - t_s[stretches[-1][1]] <= _PAUSE_S:
            stretches[-1] = stretches[-1][0], row
        else:
            stretches.append((row, row))
    carried = []
    for first, last in stretches:
        lay = places[max(first - 1, 0)]
        if np.linalg.norm(places[first : last + 1] - lay, axis=1).max() > _CARRIED_M:
            carried.append((first, last))
    return carried


def as_true(session: GraspSession, joints: FloatArray, palm: FloatArray, objects: FloatArray) -> GraspSession:
    """Return the same moments with the true hand and object; every finger counts as measured."""
    return replace(session, joints=joints, palm=palm, objects=objects, measured=np.ones_like(session.measured))
