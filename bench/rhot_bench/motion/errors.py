"""Estimates and hands beside the truth: one row per estimate, with all that figures are sorted by."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray, IntArray
from rhot.messages import HandPose
from rhot_bench.motion.tracks import Tracks
from rhot_tools.measures.points import MEASURED, Estimates, is_swapped

CLEAR_SHARE: Final = 0.9
"""Share of the facing paint above which its middle is hardly shifted by what hides the rest."""
_OFFSET_ROUNDS: Final = 4
_FEW: Final = 10
_BACK_S: Final = 0.1
"""A step counts as one of re-appearance within this time of the first view."""
_TIPS: Final = tuple(JOINTS.index(f"{finger}_tip") for finger in FINGERS)


@dataclass(frozen=True, slots=True)
class PointErrors:
    """N estimates of markers beside the truth.

    Attributes:
        rig: (N,) number of the rig, to tell rigs apart once joined.
        marker: (N,) index in `MARKERS`; 5 is the patch.
        age_s: (N,) since the first frame.
        error_m: (N,) distance from the middle of the paint.
        error_offset_m: (N,) the same after one constant offset per rig and marker, along the outermost bone and along
            the line of sight, fitted to what is measured in two views as `score.py` of the rendered pictures does.
        sigma_m: (N,) root of the sum of the stated variances; NaN = none stated.
        nees: (N,) normalised estimation error squared, three degrees of freedom; NaN = no covariance.
        views: (N,) cameras that see the marker well then, a quarter of its facing paint or more.
        clear: (N,) two cameras or more see nearly all of the facing paint, so that its middle is where it should be.
        hidden_s: (N,) since a camera last saw any of it; 0 while one does, NaN before it was first seen.
        measured: (N,) told as measured.
        swapped: (N,) nearer to another marker.
    """

    rig: IntArray
    marker: IntArray
    age_s: FloatArray
    error_m: FloatArray
    error_offset_m: FloatArray
    sigma_m: FloatArray
    nees: FloatArray
    views: IntArray
    clear: NDArray[np.bool_]
    hidden_s: FloatArray
    measured: NDArray[np.bool_]
    swapped: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class HandErrors:
    """N hands beside the truth.

    Attributes:
        rig: (N,) number of the rig.
        age_s: (N,) since the first frame.
        joints_m: (N,) mean distance of the 26 joints.
        tips_m: (N, 5) distance of the tip joints.
        sigmas_m: (N, 5) stated standard deviation of these.
        views: (N, 5) cameras that see each tip well then.
        hidden_s: (N, 5) since a camera last saw any of it; 0 while one does, NaN before it was first seen.
        step_m: (N, 5) step from the pose before, beyond the true one, in the 0.1 s after a tip re-appeared; else NaN.
        grasps: (N,) whether an object is held.
    """

    rig: IntArray
    age_s: FloatArray
    joints_m: FloatArray
    tips_m: FloatArray
    sigmas_m: FloatArray
    views: IntArray
    hidden_s: FloatArray
    step_m: FloatArray
    grasps: NDArray[np.bool_]


def joined_points(parts: Sequence[PointErrors]) -> PointErrors:
    """Return the rows of several rigs."""
    return PointErrors(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(PointErrors)))


def joined_hands(parts: Sequence[HandErrors]) -> HandErrors:
    """Return the rows of several rigs."""
    return HandErrors(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(HandErrors)))


def point_errors(tracks: Tracks, estimates: Estimates) -> PointErrors:
    """Return estimates beside the truth; those outside of the clip are left out."""
    truth = tracks.truth
    last_ns = min(int(times[-1]) for times in truth.frame_t_ns)
    start_ns = tracks.frames[0].t_ns
    estimates = estimates.of((estimates.t_ns >= start_ns - 10**7) & (estimates.t_ns <= last_ns))
    times, place = np.unique(estimates.t_ns, return_inverse=True)
    row = np.arange(len(place))
    true = truth.markers(times)[place]
    off = estimates.position - true[row, estimates.marker]
    error: FloatArray = np.linalg.norm(off, axis=1)
    views = truth.views(times)[place, estimates.marker]
    hidden = truth.hidden_s(times)[place, estimates.marker]
    measured = estimates.state == MEASURED
    offset = np.full(len(row), np.nan)
    axes = truth.bone_axes(times)[place]
    eye = np.mean([camera.center for camera in tracks.draw.true.values()], axis=0)
    for marker in range(true.shape[1]):
        mine = np.flatnonzero(estimates.marker == marker)
        ray = true[mine, marker] - eye
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        columns = np.stack([axes[mine, marker], ray], axis=2)
        offset[mine] = _without_offset(off[mine], columns, measured[mine] & (views[mine] >= 2))
    others = np.linalg.norm(estimates.position[:, None] - true, axis=2)
    others[row, estimates.marker] = np.inf
    return PointErrors(
        np.full(len(row), tracks.seed),
        estimates.marker,
        _seconds(estimates.t_ns - start_ns),
        error,
        offset,
        np.sqrt(np.trace(estimates.covariance, axis1=1, axis2=2)),
        _nees(off, estimates.covariance),
        views,
        truth.views(times, CLEAR_SHARE)[place, estimates.marker] >= 2,
        hidden,
        measured,
        is_swapped(error, others.min(axis=1)),
    )


def hand_errors(tracks: Tracks, poses: Iterable[HandPose]) -> HandErrors:
    """Return hands beside the truth; poses outside of the clip are left out."""
    truth = tracks.truth
    start_ns, last_ns = tracks.frames[0].t_ns, min(int(times[-1]) for times in truth.frame_t_ns)
    used = [pose for pose in poses if start_ns - 10**7 <= pose.t_ns <= last_ns]
    t_ns = np.array([pose.t_ns for pose in used], dtype=np.int64)
    found = np.array([[pose.joints[joint].position for joint in JOINTS] for pose in used]).reshape(-1, len(JOINTS), 3)
    true = truth.joints(t_ns) if len(t_ns) else np.empty((0, len(JOINTS), 3))
    apart: FloatArray = np.linalg.norm(found - true, axis=2)
    views, hidden = truth.views(t_ns)[:, :5], truth.hidden_s(t_ns)[:, :5]
    return HandErrors(
        np.full(len(t_ns), tracks.seed),
        _seconds(t_ns - start_ns),
        apart.mean(axis=1),
        apart[:, _TIPS],
        np.array([[pose.sigma.get(JOINTS[tip], np.nan) for tip in _TIPS] for pose in used]).reshape(-1, 5),
        views,
        hidden,
        _steps(t_ns, found[:, _TIPS], true[:, _TIPS], hidden),
        np.full(len(t_ns), tracks.grasps),
    )


def coverage(tracks: Tracks, estimates: Estimates) -> float:
    """Return the share of frames' markers, seen by two cameras or more, with a measured point within a period or 20 ms.

    Frames that were lost count too.
    """
    reach_ns = max(0.020, 1.0 / tracks.draw.rate_hz) * 1e9
    told = found = 0
    for times, visible in zip(tracks.truth.frame_t_ns, tracks.truth.visible, strict=True):
        views = tracks.truth.views(times)
        for marker in range(visible.shape[1]):
            wanted = times[views[:, marker] >= 2]
            mine = np.sort(estimates.t_ns[(estimates.marker == marker) & (estimates.state == MEASURED)])
            told += len(wanted)
            if len(mine) and len(wanted):
                after = np.clip(np.searchsorted(mine, wanted), 1, max(len(mine) - 1, 1))
                near = np.minimum(abs(wanted - mine[after - 1]), abs(wanted - mine[np.minimum(after, len(mine) - 1)]))
                found += int((near <= reach_ns).sum())
    return found / told if told else float("nan")


def _seconds(ns: IntArray) -> FloatArray:
    return np.asarray(ns, dtype=np.float64) * 1e-9


def _without_offset(off: FloatArray, columns: FloatArray, fitted: NDArray[np.bool_]) -> FloatArray:
    """Return what is left (N,) of errors (N, 3) after one constant along each of two directions (N, 3, 2)."""
    left: FloatArray = np.linalg.norm(off, axis=1)
    if fitted.sum() < _FEW:
        return left
    kept = fitted.copy()
    for _ in range(_OFFSET_ROUNDS):
        solution = np.linalg.lstsq(columns[kept].reshape(-1, 2), off[kept].reshape(-1), rcond=None)[0]
        left = np.linalg.norm(off - columns @ solution, axis=1)
        kept = fitted & (left <= 3.0 * np.median(left[fitted]) + 1e-12)
    return left


def _nees(off: FloatArray, covariance: FloatArray) -> FloatArray:
    nees = np.full(len(off), np.nan)
    stated = np.isfinite(covariance.reshape(-1, 9)).sum(axis=1) == 9
    # A matrix that cannot be inverted is stated with infinite confidence: its error counts as infinite, not as absent.
    stated_well = stated & (np.linalg.det(np.where(stated[:, None, None], covariance, np.eye(3))) > 0.0)
    nees[stated] = np.inf
    solved = np.linalg.solve(covariance[stated_well], off[stated_well][..., None])[..., 0]
    nees[stated_well] = (off[stated_well] * solved).sum(axis=1)
    return nees


def _steps(t_ns: IntArray, found: FloatArray, true: FloatArray, hidden_s: FloatArray) -> FloatArray:
    """Return steps (N, 5) beyond the true ones, metres, while a tip has just come back; else NaN."""
    steps = np.full(found.shape[:2], np.nan)
    if len(t_ns) < 2:
        return steps
    # Poses further apart than this are no neighbours: the hand was not told of in between.
    near = np.diff(t_ns) <= 0.1 * 1e9
    beyond = np.linalg.norm(np.diff(found, axis=0), axis=2) - np.linalg.norm(np.diff(true, axis=0), axis=2)
    for tip in range(found.shape[1]):
        back = np.flatnonzero((hidden_s[1:, tip] == 0.0) & (hidden_s[:-1, tip] > 0.0)) + 1
        for begin in back:
            recent = np.flatnonzero((t_ns[1:] >= t_ns[begin]) & (t_ns[1:] <= t_ns[begin] + _BACK_S * 1e9) & near)
            steps[recent + 1, tip] = np.maximum(beyond[recent, tip], 0.0)
    return steps
