"""The last moments of live streams, in which a tracked device and something else have to be held still."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import nearest_rotation

STILL_S = 0.5
"""How long things are held still."""
LEAST_COVERED = 0.8
"""Share of that time that a stream must cover."""
_WINDOW_NS = round(STILL_S * 1e9)
_LEAST_SAMPLES = 6


class Timed(Protocol):
    """A sample with its time."""

    @property
    def t_ns(self) -> int:
        """Rig clock, nanoseconds."""
        ...


def forget_old(*streams: deque[Any]) -> None:
    """Drop what lies further back than the newest `Timed` sample of all streams less `STILL_S`."""
    newest = max(stream[-1].t_ns for stream in streams if stream)
    for stream in streams:
        while stream and stream[0].t_ns < newest - _WINDOW_NS:
            stream.popleft()


def covers(samples: Sequence[Timed]) -> bool:
    """Return whether samples, by time, cover enough of the time in which things are held still."""
    return len(samples) >= _LEAST_SAMPLES and samples[-1].t_ns - samples[0].t_ns >= LEAST_COVERED * _WINDOW_NS


def held_pose(p: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return the mean position (3,) and rotation (3, 3) of a device that is held still; None while it moves.

    Args:
        p: (N, 3) positions, metres.
        R: (N, 3, 3) rotations.
    """
    p_mean, R_mean = p.mean(axis=0), nearest_rotation(R.mean(axis=0))
    turned = max(angle_between(R_mean, one) for one in R)
    device_still_m = 0.003
    device_still_rad = np.radians(1.0)
    if np.linalg.norm(p - p_mean, axis=1).max() > device_still_m or turned > device_still_rad:
        return None
    return p_mean, R_mean


def angle_between(first: FloatArray, second: FloatArray) -> float:
    """Return the angle between two rotations (3, 3), radians."""
    chord = float(np.linalg.norm(first - second)) / np.sqrt(8.0)
    return float(2.0 * np.arcsin(min(chord, 1.0)))
