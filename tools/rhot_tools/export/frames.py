"""Everything that moves, read at common moments: files of biomechanics hold frames at one steady rate.

Time 0 is the first pose of any of them. Positions between two poses lie on the straight line between them, as far apart
as `MAX_GAP_S`; where there is none, the frame holds nothing (NaN).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot_tools.export.poses import Motion, frame_times_s

MAX_GAP_S: Final = 0.1
"""Longest pause between two poses that is bridged: a hand that turns back with 10 m/s² leaves the straight line by
a·t²/8 = 12 mm in it."""
AXIS_M: Final = 0.1
"""Length of a rigid thing's axes, whose ends are markers beside its origin: its rotation follows from them."""
_ROUND: Final = 24
"""Poses of a round: a multiple of 2, 3, 4, 6 and 8 cameras."""
_ALIKE: Final = 0.02
_STEADY: Final = 0.6
"""Intervals come steadily where so great a share of them is that near to the median, as a part of it. Of two cameras
out of step it is half; of one that loses every fourth frame, two thirds."""
_AXES: Final = ("x", "y", "z")


@dataclass(frozen=True, slots=True)
class Frames:
    """Markers and angles at a steady rate.

    Attributes:
        rate_hz: frames per second.
        t_s: (F,) times, seconds, from 0.
        markers: (M,) names.
        positions: (F, M, 3) metres; NaN where there is none.
        angles: by name, (F,) radians; NaN where there is none.
    """

    rate_hz: float
    t_s: FloatArray
    markers: tuple[str, ...]
    positions: FloatArray
    angles: Mapping[str, FloatArray]


def frames_of(motions: Sequence[Motion], rate_hz: float | None = None) -> Frames:
    """Read motions at common moments.

    Args:
        motions: at least one.
        rate_hz: frames per second; None = the real rate of the fastest motion, see `real_rate_hz`.

    Raises:
        ConfigError: see `frame_times_s`.
    """
    origin_ns = min(int(motion.t_ns[0]) for motion in motions)
    end_s = max(int(motion.t_ns[-1]) - origin_ns for motion in motions) / 1e9
    rate = rate_hz if rate_hz is not None else max(real_rate_hz(motion.t_ns) for motion in motions)
    t_s = frame_times_s(end_s, rate)
    names: list[str] = []
    columns: list[FloatArray] = []
    angles: dict[str, FloatArray] = {}
    for motion in motions:
        at_s = (motion.t_ns - origin_ns) / 1e9
        marked, positions = _markers(motion)
        names += marked
        columns.append(_read(at_s, positions.reshape(len(at_s), -1), t_s).reshape(len(t_s), -1, 3))
        angled = {**motion.angles, **(wrist_angles(motion) if motion.name.startswith("hand_") else {})}
        angles |= {f"{motion.name}_{name}": _read(at_s, v[:, None], t_s)[:, 0] for name, v in angled.items()}
    return Frames(rate, t_s, tuple(names), np.concatenate(columns, axis=1), angles)


def wrist_angles(motion: Motion) -> dict[str, FloatArray]:
    """Return yaw, pitch and roll (N,), radians, of a hand's wrist against the axes of the motion's frame.

    R = Ry(yaw)·Rx(pitch)·Rz(roll) with OpenXR's axes of the wrist (−z along the fingers, +y out of the back of the
    hand). In the stage: yaw to the left, fingers up and, seen by the person, counter-clockwise are positive. They are
    not flexion and deviation: those are against the forearm, which no marker shows. Yaw and roll go on over ±180°.
    """
    R = motion.rotations[:, motion.root]
    return {
        "wrist_yaw": np.unwrap(np.arctan2(R[:, 0, 2], R[:, 2, 2])),
        "wrist_pitch": np.arcsin(np.clip(-R[:, 1, 2], -1.0, 1.0)),
        "wrist_roll": np.unwrap(np.arctan2(R[:, 1, 0], R[:, 1, 1])),
    }


def real_rate_hz(t_ns: NDArray[np.int64]) -> float:
    """Return how many poses come in a second, of times (N,); 60 where there is one time alone.

    It is the inverse of the median interval, so that lost frames and pauses do not count. A hand is seen by cameras in
    turn, with long and short intervals between them: there it is the median over rounds of all cameras.
    """
    intervals = np.diff(t_ns)
    if not len(intervals):
        return 60.0
    usual = float(np.median(intervals))
    alike = np.abs(intervals - usual) <= _ALIKE * usual
    if alike.mean() < _STEADY and len(t_ns) > 2 * _ROUND:
        usual = float(np.median(t_ns[_ROUND:] - t_ns[:-_ROUND])) / _ROUND
    return 1e9 / usual


def _markers(motion: Motion) -> tuple[list[str], FloatArray]:
    """Return the names and positions (N, M, 3) of a motion's joints, or of a rigid thing's origin and axes."""
    if not motion.is_rigid:
        return [f"{motion.name}_{joint}" for joint in motion.joints], motion.positions
    origin, R = motion.positions[:, :1], motion.rotations[:, 0]
    ends = origin + AXIS_M * np.swapaxes(R, -1, -2)
    return [motion.name, *(f"{motion.name}_{axis}" for axis in _AXES)], np.concatenate([origin, ends], axis=1)


def _read(at_s: FloatArray, values: FloatArray, t_s: FloatArray) -> FloatArray:
    """Return values (N, C) of times (N,) at times (F,); NaN before the first, after the last and in longer gaps."""
    before = np.clip(np.searchsorted(at_s, t_s, side="right") - 1, 0, max(len(at_s) - 2, 0))
    after = np.minimum(before + 1, len(at_s) - 1)
    span_s = at_s[after] - at_s[before]
    share = (t_s - at_s[before]) / np.maximum(span_s, 1e-9)
    # Half a microsecond of rounding is no gap.
    share = np.where(np.abs(t_s - at_s[before]) < 5e-7, 0.0, np.where(np.abs(t_s - at_s[after]) < 5e-7, 1.0, share))
    read: FloatArray = values[before] + share[:, None] * (values[after] - values[before])
    exact = (share == 0.0) | (share == 1.0)
    read[(share < 0.0) | (share > 1.0) | ((span_s > MAX_GAP_S) & ~exact)] = np.nan
    return read
