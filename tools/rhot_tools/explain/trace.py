"""Messages of the seconds before a time, and curves of their quality."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rhot.arrays import FloatArray
from rhot.messages import HandPose, MarkerFrame, Message, PointSet

Line = tuple[FloatArray, FloatArray]


@dataclass(slots=True)
class Trace:
    """Messages of the stages up to a time.

    Attributes:
        t_ns: the time.
        frames: newest marker frame of each camera.
        points: newest points.
        hands: newest hand of each side.
        before: all hands and points by key and time.
    """

    t_ns: int
    frames: dict[str, MarkerFrame] = field(default_factory=dict)
    points: PointSet | None = None
    hands: dict[str, HandPose] = field(default_factory=dict)
    before: dict[tuple[str, int], HandPose | PointSet] = field(default_factory=dict)
    _residuals: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    _sigmas: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    _seen: dict[str, list[tuple[float, float]]] = field(default_factory=dict)

    @property
    def residuals_mm(self) -> Mapping[str, Line]:
        """Finger to time relative to `t_ns` (N,), seconds, negative, and residual of its marker (N,), millimetres."""
        return _lines(self._residuals)

    @property
    def sigmas_mm(self) -> Mapping[str, Line]:
        """Marker to relative time (N,), seconds, and standard deviation of its point (N,), millimetres."""
        return _lines(self._sigmas)

    @property
    def seen(self) -> Mapping[str, Line]:
        """Camera to relative time (N,), seconds, and number of markers detected (N,)."""
        return _lines(self._seen)

    def add(self, key: str, message: Message) -> None:
        """Add a message; messages must be in order of time."""
        at_s = (message.t_ns - self.t_ns) / 1e9
        if isinstance(message, MarkerFrame):
            self.frames[message.camera] = message
            self._seen.setdefault(message.camera, []).append((at_s, len(message.markers)))
        elif isinstance(message, PointSet):
            self.points = message
            self.before[key, message.t_ns] = message
            for name, point in message.points.items():
                self._sigmas.setdefault(name, []).append((at_s, 1e3 * point.sigma))
        elif isinstance(message, HandPose):
            self.hands[message.side] = message
            self.before[key, message.t_ns] = message
            for finger in message.fingers:
                miss_m = message.residual.get(finger, np.nan)
                self._residuals.setdefault(f"{message.side} {finger}", []).append((at_s, 1e3 * miss_m))


def trace_of(t_ns: int, messages: Iterable[tuple[str, Message]]) -> Trace:
    """Return the trace of messages up to a time."""
    trace = Trace(t_ns)
    for key, message in messages:
        trace.add(key, message)
    return trace


def difference_m(first: HandPose | PointSet, second: HandPose | PointSet) -> float:
    """Return the largest distance between joints or points that both have; NaN if there are none."""
    one, other = _positions(first), _positions(second)
    gaps = [
        float(np.linalg.norm(np.subtract(position, other[name]))) for name, position in one.items() if name in other
    ]
    return max(gaps, default=float("nan"))


def _positions(message: HandPose | PointSet) -> dict[str, tuple[float, float, float]]:
    parts = message.joints if isinstance(message, HandPose) else message.points
    return {name: part.position for name, part in parts.items()}


def _lines(pairs: Mapping[str, list[tuple[float, float]]]) -> dict[str, Line]:
    return {name: (values[:, 0], values[:, 1]) for name, values in ((n, np.array(p)) for n, p in pairs.items())}
