"""How the 2018 thesis made points of two cameras and bent its fingers: depth law, 1-euro filter, FABRIK chain by chain.

Each finger is three bones from its knuckle: the first is held in a cone about a direction of the palm (rotor), the
others turn about the finger's x axis only (hinges, with limits). A chain starts from where it was; after each of at
most ten iterations it is done when the tip is within 1 cm of its target or comes no nearer. Pure Python on triples, as
the library it used was plain Java; axes and limits turn with the hand here, which they did not there.

Source: Aristidou & Lasenby 2011 for the passes; chain build and limits from the set-up of the thesis's own solver.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from rhot.types import Vector3

# How the 2018 thesis made points of two cameras: latest arrivals within 20 ms, a depth law, a 1-euro filter.
#
#     D[cm] = 4543.3 · |u_left − u_right|^−1.035
#
# The lateral place follows from the pinhole of the left camera. Two of its mistakes are left out: one depth filter
# shared by all markers, and settings that never reached the filters. Pure Python on single numbers, as its Java was.

Pixel = tuple[float, float]

PAIRING_S: Final = 0.020
LAW: Final = (4543.3, -1.035)


def law_depth_m(disparity_px: float) -> float:
    """Return the depth, metres, of the thesis's fitted law; infinite for no disparity."""
    disparity = abs(disparity_px)
    return 0.01 * LAW[0] * disparity ** LAW[1] if disparity > 0.0 else math.inf


class OneEuro:
    """The 1-euro filter of one number (Casiez, Roussel, Vogel, CHI 2012)."""

    def __init__(self) -> None:
        self._t_s = 0.0
        self._value: float | None = None
        self._speed = 0.0

    def smooth(self, t_s: float, value: float) -> float:
        """Return the smoothed value at a time, seconds."""
        if self._value is None:
            self._t_s, self._value = t_s, value
            return value
        period = max(t_s - self._t_s, 1e-3)
        slope = (value - self._value) / period
        derivative_cutoff_hz = 1.0
        self._speed += _share(derivative_cutoff_hz, period) * (slope - self._speed)
        min_cutoff_hz = 1.0
        beta = 0.007
        self._value += _share(min_cutoff_hz + beta * abs(self._speed), period) * (value - self._value)
        self._t_s = t_s
        return self._value


def _share(cutoff_hz: float, period_s: float) -> float:
    return 1.0 / (1.0 + 1.0 / (2.0 * math.pi * cutoff_hz * period_s))


@dataclass(frozen=True, slots=True)
class Arrival:
    """The markers of one camera's frame.

    Attributes:
        t_s: when they arrived.
        markers: name to pixel.
    """

    t_s: float
    markers: Mapping[str, Pixel]


class ThesisFusion:
    """Points of the cameras `left` and `right`.

    Args:
        focal_px: of both cameras.
        middle_px: principal point.
    """

    def __init__(self, focal_px: float, middle_px: Pixel) -> None:
        self._focal_px = focal_px
        self._middle_px = middle_px
        self._latest: dict[str, Arrival] = {}
        self._filters: dict[str, tuple[OneEuro, OneEuro, OneEuro]] = {}

    def feed(self, camera: str, arrival: Arrival) -> dict[str, Vector3]:
        """Take a frame and return smoothed points, metres, left camera; empty without a partner within 20 ms."""
        self._latest[camera] = arrival
        left, right = self._latest.get("left"), self._latest.get("right")
        if left is None or right is None or abs(left.t_s - right.t_s) > PAIRING_S:
            return {}
        points = {}
        for name, (u, v) in left.markers.items():
            other = right.markers.get(name)
            if other is None or u == other[0]:
                continue
            z = law_depth_m(u - other[0])
            x, y = z * (u - self._middle_px[0]) / self._focal_px, z * (v - self._middle_px[1]) / self._focal_px
            filters = self._filters.setdefault(name, (OneEuro(), OneEuro(), OneEuro()))
            a, b, c = (one.smooth(arrival.t_s, value) for one, value in zip(filters, (x, y, z), strict=True))
            points[name] = (a, b, c)
        return points


# How the 2018 thesis bent its fingers: FABRIK chain by chain, rotor and hinge limits, 1 cm of tolerance, no coupling.


TOLERANCE_M: Final = 0.01
MAX_ITERATIONS: Final = 10
_LEAST_CHANGE_M: Final = 1e-4
ROTOR_DEG: Final = (45.0, 20.0, 20.0, 20.0, 20.0)
"""Half-angles of the cones of thumb, index, middle, ring and little finger."""
HINGES_DEG: Final = ((95.0, 95.0), (110.0, 90.0), (110.0, 90.0), (110.0, 90.0), (110.0, 90.0))


@dataclass(frozen=True, slots=True)
class ThesisFinger:
    """One chain.

    Attributes:
        base: knuckle, metres, palm frame.
        lengths: of the three bones, metres.
        axis: of both hinges, unit; a positive turn bends towards the palm.
        forward: unit; middle of the rotor's cone.
        rotor_rad: half-angle of that cone.
        hinges_rad: largest turns of the two hinges; the least is 0.
    """

    base: Vector3
    lengths: tuple[float, float, float]
    axis: Vector3
    forward: Vector3
    rotor_rad: float
    hinges_rad: tuple[float, float]

    def straight(self) -> list[Vector3]:
        """Return the four joints of the straight finger."""
        points = [self.base]
        for length in self.lengths:
            points.append(_along(points[-1], self.forward, length))
        return points


def solve_finger(finger: ThesisFinger, target: Vector3, start: Sequence[Vector3]) -> list[Vector3]:
    """Return the four joints, knuckle to tip, metres, that bring the tip near a target.

    Args:
        finger: the chain.
        target: metres, palm frame.
        start: joints to start from.
    """
    points = list(start)
    last_miss = math.inf
    for _ in range(MAX_ITERATIONS):
        points[3] = target
        for k in (2, 1, 0):
            direction = _unit(_minus(points[k], points[k + 1]))
            if k > 0:
                direction = _unit(_in_plane(direction, finger.axis))
            points[k] = _along(points[k + 1], direction, finger.lengths[k])
        points[0] = finger.base
        inner = _within_cone(_unit(_minus(points[1], points[0])), finger.forward, finger.rotor_rad)
        points[1] = _along(points[0], inner, finger.lengths[0])
        for k in (1, 2):
            wanted = _unit(_in_plane(_minus(points[k + 1], points[k]), finger.axis))
            inner = _hinged(inner, wanted, finger.axis, finger.hinges_rad[k - 1])
            points[k + 1] = _along(points[k], inner, finger.lengths[k])
        miss = math.dist(points[3], target)
        if miss <= TOLERANCE_M or abs(last_miss - miss) < _LEAST_CHANGE_M:
            break
        last_miss = miss
    return points


class ThesisHand:
    """Five fingers, each solved by itself from its last pose.

    Args:
        fingers: the chains.
    """

    def __init__(self, fingers: Sequence[ThesisFinger]) -> None:
        self._fingers = tuple(fingers)
        self._poses = [finger.straight() for finger in fingers]

    def solve(self, targets: Sequence[Vector3]) -> list[list[Vector3]]:
        """Return the four joints of every finger for tips, metres, palm frame."""
        self._poses = [
            solve_finger(finger, target, pose)
            for finger, target, pose in zip(self._fingers, targets, self._poses, strict=True)
        ]
        return self._poses


def _hinged(inner: Vector3, wanted: Vector3, axis: Vector3, limit_rad: float) -> Vector3:
    """Return the direction of a bone: `wanted`, turned about the axis by 0 to the limit against the bone before."""
    flat = _unit(_in_plane(inner, axis))
    angle = math.atan2(_dot(_cross(flat, wanted), axis), _dot(flat, wanted))
    angle = min(max(angle, 0.0), limit_rad)
    side = _cross(axis, flat)
    c, s = math.cos(angle), math.sin(angle)
    return (c * flat[0] + s * side[0], c * flat[1] + s * side[1], c * flat[2] + s * side[2])


def _within_cone(direction: Vector3, middle: Vector3, limit_rad: float) -> Vector3:
    cosine = min(max(_dot(direction, middle), -1.0), 1.0)
    if math.acos(cosine) <= limit_rad:
        return direction
    across = _unit(
        (
            direction[0] - cosine * middle[0],
            direction[1] - cosine * middle[1],
            direction[2] - cosine * middle[2],
        )
    )
    c, s = math.cos(limit_rad), math.sin(limit_rad)
    return (c * middle[0] + s * across[0], c * middle[1] + s * across[1], c * middle[2] + s * across[2])


def _in_plane(v: Vector3, normal: Vector3) -> Vector3:
    off = _dot(v, normal)
    return (v[0] - off * normal[0], v[1] - off * normal[1], v[2] - off * normal[2])


def _along(start: Vector3, direction: Vector3, length: float) -> Vector3:
    return (start[0] + length * direction[0], start[1] + length * direction[1], start[2] + length * direction[2])


def _minus(a: Vector3, b: Vector3) -> Vector3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _dot(a: Vector3, b: Vector3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector3, b: Vector3) -> Vector3:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def _unit(v: Vector3) -> Vector3:
    size = math.sqrt(_dot(v, v))
    return (v[0] / size, v[1] / size, v[2] / size) if size > 1e-12 else (0.0, 0.0, -1.0)
