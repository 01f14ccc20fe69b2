"""Figures of recorded marker streams without a truth: steps, delay, noise where the hand rests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rhot.arrays import BoolArray, FloatArray
from rhot_tools.measures.points import scatter_m

# How late a tracked path is, against a truth that is known at any moment.

REACH_S: Final = 0.060
"""Largest delay looked for, either sign."""
STEP_S: Final = 0.002
"""Of the search."""
_STREAM_REACH: Final = 5


def delay_s(
    t_s: FloatArray,
    found: FloatArray,
    true_t_s: FloatArray,
    true: FloatArray,
    used: NDArray[np.bool_] | None = None,
) -> float:
    """Return the delay at which the truth fits what was found best, seconds; positive = found is late.

    The mean squared difference of found(t) and true(t − delay), each column without its mean difference, is sampled at
    steps of the delay; the vertex of the parabola through the least three gives fractions of a step. For a signal of
    zero mean that is the delay of the highest cross-correlation.

    Args:
        t_s: (N,) times of what was found, rising.
        found: (N, K); NaN = nothing there.
        true_t_s: (T,) times at which the truth was sampled, rising, reaching `REACH_S` beyond both ends of `t_s`.
        true: (T, K).
        used: (N, K) which samples count; all finite ones when not given.

    Returns:
        NaN with fewer than ten samples or without motion to tell by.
    """
    usable = np.isfinite(found) if used is None else used & np.isfinite(found)
    if int(usable.sum()) < 10:
        return float("nan")
    lags = np.arange(-round(REACH_S / STEP_S), round(REACH_S / STEP_S) + 1) * STEP_S
    cost = np.array([_mean_square(t_s - lag, found, true_t_s, true, usable) for lag in lags])
    best = int(np.argmin(cost))
    # Rounding of a world that does not move at all is no motion.
    if best in (0, len(lags) - 1) or cost.max() - cost.min() < 1e-12:
        return float("nan")
    before, least, after = cost[best - 1 : best + 2]
    bend = before - 2.0 * least + after
    return float(lags[best] + (0.5 * (before - after) / bend * STEP_S if bend > 0.0 else 0.0))


def _mean_square(
    t_s: FloatArray, found: FloatArray, true_t_s: FloatArray, true: FloatArray, usable: NDArray[np.bool_]
) -> float:
    total, count = 0.0, 0
    for column in range(found.shape[1]):
        rows = usable[:, column]
        number = int(rows.sum())
        if number < 2:
            continue
        off = found[rows, column] - np.interp(t_s[rows], true_t_s, true[:, column])
        total += float(((off - off.mean()) ** 2).sum())
        count += number
    return total / max(count, 1)


def stream_delay(u: FloatArray, x: FloatArray, clean: NDArray[np.bool_]) -> float:
    """Return the lag, samples, at which the speed of x follows that of u best, for streams without a truth.

    The correlation of the steps is summed over the columns at whole lags of up to 5; a parabola gives the fraction.

    Args:
        u: (N, M) what was seen, such as pixels.
        x: (N, M) what was made of it, in any unit.
        clean: (N, M) samples that may be compared.
    """
    lags = range(-_STREAM_REACH, _STREAM_REACH + 1)
    scores = [_correlation(u, x, clean, lag) for lag in lags]
    best = int(np.clip(np.argmax(scores), 1, len(scores) - 2))
    before, peak, after = scores[best - 1 : best + 2]
    bend = before - 2.0 * peak + after
    return float(lags[best] + (0.5 * (before - after) / bend if bend else 0.0))


def _correlation(u: FloatArray, x: FloatArray, clean: NDArray[np.bool_], lag: int) -> float:
    """Return the correlation of the steps of u with those of x `lag` samples later, summed over the columns."""
    du, dx, good = np.diff(u, axis=0), np.diff(x, axis=0), clean[1:] & clean[:-1]
    inner = slice(_STREAM_REACH, len(du) - _STREAM_REACH)
    later = slice(inner.start + lag, inner.stop + lag)
    du, dx, good = du[inner], dx[later], good[inner] & good[later]
    good = good & np.isfinite(du) & np.isfinite(dx)
    total = 0.0
    for marker in range(du.shape[1]):
        rows = good[:, marker]
        seen, made = du[rows, marker], dx[rows, marker]
        if len(seen) > 2 and seen.std() > 0.0 and made.std() > 0.0:
            total += float(np.corrcoef(seen, made)[0, 1])
    return total


REST_FRAMES: Final = 15
"""A marker rests while it stays within `REST_PX` in every view over this many frames."""
REST_PX: Final = 2.0


@dataclass(frozen=True, slots=True)
class Stream:
    """A recorded stream and what was made of it: N frames, M markers, C cameras.

    Attributes:
        uv: (C, N, M, 2) pixels as recorded; NaN = no row.
        positions: (N, M, 3) metres, rig frame; NaN = not published.
        measured: (N, M).
        views: (N, M) cameras that a point rests on.
    """

    uv: FloatArray
    positions: FloatArray
    measured: BoolArray
    views: NDArray[np.int64]


def step_p99_m(stream: Stream) -> float:
    """Return the 99th percentile of the steps of markers between consecutive frames, metres."""
    steps = np.linalg.norm(np.diff(stream.positions, axis=0), axis=2)
    finite = steps[np.isfinite(steps)]
    return float(np.percentile(finite, 99)) if finite.size else float("nan")


def lateral_delay(stream: Stream) -> float:
    """Return by how many frames the published sideways position is behind the first camera's picture."""
    clean = np.isfinite(stream.uv[0, :, :, 0]) & np.isfinite(stream.positions[:, :, 0])
    # Held and jumping samples tell nothing of a delay: a marker neither stands still to the pixel nor leaps.
    moved = np.abs(np.diff(stream.uv[0, :, :, 0], axis=0, prepend=np.nan))
    clean &= (moved > 0.0) & (moved < 60.0)
    with np.errstate(invalid="ignore"):
        return stream_delay(stream.uv[0, :, :, 0], stream.positions[:, :, 0] / stream.positions[:, :, 2], clean)


def rest_noise_m(stream: Stream) -> tuple[FloatArray, FloatArray]:
    """Return the standard deviations of published points, metres, sideways and in depth, of each stretch of rest.

    A stretch is `REST_FRAMES` long and is judged by the recorded pixels alone: no view moves by more than `REST_PX`.
    Stretches do not overlap.
    """
    found = [
        scatter_m(positions)
        for marker in range(stream.positions.shape[1])
        for begin in _rests(stream.uv[:, :, marker])
        if np.isfinite(positions := stream.positions[begin : begin + REST_FRAMES, marker]).all()
    ]
    sideways, depth = np.array(found).reshape(-1, 2).T
    return sideways, depth


def _rests(uv: FloatArray) -> list[int]:
    """Return the first frames of stretches of rest of one marker; uv (C, N, 2)."""
    if uv.shape[1] < REST_FRAMES:
        return []
    windows = sliding_window_view(uv, REST_FRAMES, axis=1)
    spans = windows.max(axis=-1) - windows.min(axis=-1)
    still = (spans <= REST_PX).all(axis=(0, 2))
    begins: list[int] = []
    for begin in np.flatnonzero(still).tolist():
        if not begins or begin >= begins[-1] + REST_FRAMES:
            begins.append(begin)
    return begins


def measured_glitches(stream: Stream, glitch: NDArray[np.bool_]) -> int:
    """Return how many points were published as measured by all views while one view of the marker was a glitch.

    Args:
        stream: with its outcome.
        glitch: (N, M) known glitches.
    """
    return int((stream.measured & (stream.views >= len(stream.uv)) & glitch).sum())
