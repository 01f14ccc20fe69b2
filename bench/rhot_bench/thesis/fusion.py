"""How the 2018 thesis made points of two cameras: latest arrivals within 20 ms, a depth law, a 1-euro filter.

    D[cm] = 4543.3 · |u_left − u_right|^−1.035

The lateral place follows from the pinhole of the left camera. Two of its mistakes are left out: one depth filter shared
by all markers, and settings that never reached the filters. Pure Python on single numbers, as its Java was.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

Pixel = tuple[float, float]
Place = tuple[float, float, float]

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

    def feed(self, camera: str, arrival: Arrival) -> dict[str, Place]:
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
