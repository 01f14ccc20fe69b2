"""Figures of recorded marker streams without a truth: steps, delay, noise where the hand rests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from rhot.arrays import BoolArray, FloatArray
from rhot_tools.measures.delay import stream_delay
from rhot_tools.measures.points import scatter_m

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
