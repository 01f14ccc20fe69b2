"""Detect cameras that have moved since calibration, from pairs of views of the same markers.

Camera j observes a marker in direction y_j = (x, y, 1), camera i the same marker, interpolated to the same time, in
direction y_i. With the essential matrix E of the calibration, the signed epipolar residual in camera j is the distance
of y_j from the line n = E · y_i. It changes with small rotations of both cameras:

    r = n · y_j / |n_xy| ,     r ≈ −(y_j × n / |n_xy|) · ω_j − (y_i × Eᵀ y_j / |n_xy|) · ω_i

where ω_k (rad) is the rotation of camera k since the calibration, in its own axes: x pitch, y yaw, z roll. ω is
estimated as the maximum a posteriori under a prior of a few degrees; a component that only the prior determines is not
observable. Yaw of a camera beside the other moves points along their epipolar lines: it changes depth, but not r.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot.geometry.camera import CameraModel, essential_matrix, rays_meet_ahead
from rhot.messages import MarkerFrame

# Whole tracks of markers per camera, gathered from marker frames.


class TrackGatherer:
    """Collects frames and gives the tracks of each camera.

    Attributes:
        frames: taken so far, by camera.
    """

    def __init__(self, cameras: Mapping[str, CameraModel]) -> None:
        self._cameras = cameras
        self._rows: dict[str, dict[str, dict[int, tuple[float, float]]]] = {name: {} for name in cameras}
        self._frame_times: dict[str, list[int]] = {name: [] for name in cameras}

    @property
    def frames(self) -> dict[str, int]:
        """Frames taken so far, by camera."""
        return {name: len(times) for name, times in self._frame_times.items()}

    def add(self, frames: Iterable[MarkerFrame]) -> None:
        """Take frames; those of cameras that are not known are left out."""
        for frame in frames:
            rows = self._rows.get(frame.camera)
            if rows is None:
                continue
            self._frame_times[frame.camera].append(frame.t_ns)
            for name, marker in frame.markers.items():
                t_ns = frame.t_ns if marker.t_ns is None else marker.t_ns
                rows.setdefault(name, {})[t_ns] = (marker.u, marker.v)

    def start_ns(self) -> int:
        """Return the time of the earliest frame; seconds of all tracks count from it."""
        return min((min(times) for times in self._frame_times.values() if times), default=0)

    def periods_s(self) -> dict[str, float]:
        """Return the usual time between two frames of each camera, seconds."""
        return {
            name: 1e-9 * float(np.median(np.diff(np.unique(times)))) if len(set(times)) > 1 else 0.0
            for name, times in self._frame_times.items()
        }

    def tracks(self) -> dict[str, dict[str, PixelTrack]]:
        """Return the tracks by camera and marker, undistorted; observations outside the picture are left out."""
        start_ns = self.start_ns()
        result: dict[str, dict[str, PixelTrack]] = {}
        for camera, markers in self._rows.items():
            model = self._cameras[camera]
            result[camera] = {}
            for marker, rows in markers.items():
                times = np.array(sorted(rows), dtype=np.int64)
                uv = np.array([rows[t_ns] for t_ns in times.tolist()])
                inside = model.contains(uv)
                if inside.any():
                    t_s = np.asarray((times[inside] - start_ns) * 1e-9, dtype=np.float64)
                    result[camera][marker] = PixelTrack(t_s, model.undistort(uv[inside]))
        return result


PRIOR_SD_RAD = np.radians(2.0)
"""Prior of the rotation: a bump turns a camera by a few degrees at most."""
_BEHIND: Final = 0.5
_SWAP_RATIO: Final = 0.5
"""Cameras are swapped if exchanging them puts most points before them, or leaves less than half the residual."""
LEAST_OBSERVATIONS = 50
"""Minimum number of observations to estimate three angles: nearly two seconds of one marker at 30 Hz. Chosen."""
_CHANGE_BLOCK_S = 0.25
"""Time resolution of a change."""
_CHANGE_MARGIN = 8
"""Blocks at either end in which no change is sought."""
_ROBUST_STEPS = 20
"""Iterations, half with Huber's weights, half with Tukey's; the fit converges in far fewer."""
_HUBER, _TUKEY = 1.345, 4.7
"""Tuning constants in standard deviations: 95 % efficiency on normal noise (Holland and Welsch 1977)."""


@dataclass(frozen=True, slots=True)
class PixelTrack:
    """Observations of one marker by one camera.

    Attributes:
        t_s: (N,) increasing, seconds.
        xy: (N, 2) normalised image coordinates.
    """

    t_s: FloatArray
    xy: FloatArray


Tracks = Mapping[str, Mapping[str, PixelTrack]]
"""Camera to marker to track."""


@dataclass(frozen=True, slots=True)
class PairResiduals:
    """Epipolar residuals of a pair of cameras.

    Attributes:
        first, second: names; the residual is measured in the second camera's image.
        t_s: (N,) times, increasing.
        residual_px: (N,) signed distance from the epipolar line, pixels of the second camera.
        xy: (N, 2) observations in the second camera, normalised image coordinates.
        xy_first: (N, 2) those of the first camera at the same times.
        J_first, J_second: (N, 3) derivative of the residual with respect to either camera's rotation, px/rad.
        focal_px: of the second camera.
    """

    first: str
    second: str
    t_s: FloatArray
    residual_px: FloatArray
    xy: FloatArray
    xy_first: FloatArray
    J_first: FloatArray
    J_second: FloatArray
    focal_px: float

    @property
    def name(self) -> str:
        """`first-second`."""
        return f"{self.first}-{self.second}"

    def derivative(self, camera: str) -> FloatArray | None:
        """Return the derivative (N, 3) with respect to a camera's rotation, None if the camera is not in this pair."""
        return {self.first: self.J_first, self.second: self.J_second}.get(camera)


@dataclass(frozen=True, slots=True)
class LinearFit:
    """A robust linear model of residuals.

    Attributes:
        values: (K,) parameters.
        sd: (K,) their standard deviations, from the scatter between blocks of time.
        effect: (K,) RMS, pixels, of the part of the residuals that only this parameter can explain, per unit of it.
        systematic_px: root mean square of the fitted model.
        remaining_px: robust standard deviation of the remaining residuals.
        weight: (N,) 0 to 1; 0 = an outlier.
    """

    values: FloatArray
    sd: FloatArray
    effect: FloatArray
    systematic_px: float
    remaining_px: float
    weight: FloatArray


def pair_residuals(
    first: str, second: str, tracks: Tracks, cameras: Mapping[str, CameraModel], periods_s: Mapping[str, float]
) -> PairResiduals:
    """Return the residuals of all markers that two cameras observed at about the same time.

    Args:
        first, second: camera names.
        tracks: of all cameras.
        cameras: their calibration.
        periods_s: time between two frames of each camera, seconds.
    """
    one, other = cameras[first], cameras[second]
    E = essential_matrix(one, other)
    # No linear interpolation where the track's curvature makes its error larger than this.
    bend = 0.3 / float(one.K[0, 0])
    times, seen, matched = [np.empty(0)], [np.empty((0, 2))], [np.empty((0, 2))]
    for marker, track in tracks[second].items():
        partner = tracks[first].get(marker)
        if partner is not None:
            # No interpolation between observations further apart than this many frame periods.
            xy, valid = interpolate(partner, track.t_s, 2.0 * periods_s[first], bend)
            times.append(track.t_s[valid])
            seen.append(track.xy[valid])
            matched.append(xy[valid])
    t_s = np.concatenate(times)
    order = np.argsort(t_s, kind="stable")
    xy = np.concatenate(seen)[order]
    y_second, y_first = _directions(xy), _directions(np.concatenate(matched)[order])
    n = y_first @ E.T
    scale = np.maximum(np.hypot(n[:, 0], n[:, 1]), 1e-12)[:, None]
    focal_px = float(other.K[0, 0])
    return PairResiduals(
        first=first,
        second=second,
        t_s=t_s[order],
        residual_px=focal_px * np.sum(n * y_second, axis=1) / scale[:, 0],
        xy=xy,
        xy_first=y_first[:, :2],
        J_first=-focal_px * np.cross(y_first, y_second @ E) / scale,
        J_second=-focal_px * np.cross(y_second, n) / scale,
        focal_px=focal_px,
    )


def interpolate(track: PixelTrack, t_s: FloatArray, gap_s: float, bend: float) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return a track (N, 2) at times (N,) by linear interpolation, and which of them (N,) are valid.

    Args:
        track: none is valid with fewer than two observations.
        t_s: times.
        gap_s: no interpolation between observations further apart.
        bend: largest permitted error of linear interpolation, estimated from second differences, normalised units.
    """
    if len(track.t_s) < 2:
        return np.full((len(t_s), 2), np.nan), np.zeros(len(t_s), dtype=bool)
    right = np.clip(np.searchsorted(track.t_s, t_s, side="left"), 1, len(track.t_s) - 1)
    left = right - 1
    interval = track.t_s[right] - track.t_s[left]
    share = (t_s - track.t_s[left]) / interval
    xy = track.xy[left] + share[:, None] * (track.xy[right] - track.xy[left])
    inside = (share >= 0.0) & (share <= 1.0)
    # At the time of an observation its neighbours do not matter.
    exact = inside & (np.minimum(share, 1.0 - share) * interval < 1e-6)
    second = np.zeros(len(track.t_s))
    second[1:-1] = np.hypot(*(track.xy[2:] - 2.0 * track.xy[1:-1] + track.xy[:-2]).T) / 8.0
    straight = np.maximum(second[left], second[right]) <= bend
    return xy, exact | (inside & (interval <= gap_s) & straight)


def fit_linear(J: FloatArray, residual_px: FloatArray, t_s: FloatArray, prior_sd: FloatArray) -> LinearFit:
    """Fit r = J · v robustly (Huber, then Tukey's biweight), v with mean 0 and the given standard deviations.

    Args:
        J: (N, K).
        residual_px: (N,).
        t_s: (N,) increasing, for the blocks of time.
        prior_sd: (K,).
    """
    prior = np.diag(prior_sd**-2.0)
    weight: FloatArray = np.ones(len(residual_px))
    values: FloatArray = np.zeros(J.shape[1])
    spread = 0.0
    for step in range(_ROBUST_STEPS):
        weighted = J * weight[:, None]
        values = np.asarray(np.linalg.solve(weighted.T @ J + prior, weighted.T @ residual_px), dtype=np.float64)
        remaining = residual_px - J @ values
        # Lower bound of the noise of a marker's centre; with a smaller one, good observations would become
        # outliers.
        spread = max(1.4826 * float(np.median(np.abs(remaining))), 0.1)
        size = np.abs(remaining) / spread
        if step < _ROBUST_STEPS // 2:
            weight = np.minimum(1.0, _HUBER / np.maximum(size, 1e-9))
        else:
            weight = np.square(np.maximum(1.0 - np.square(size / _TUKEY), 0.0))
    remaining = residual_px - J @ values
    # The information of the biweight is the derivative of its influence function, not its weight.
    inside = np.square(np.minimum(np.abs(remaining) / (_TUKEY * spread), 1.0))
    slope = max(float(np.mean((1.0 - inside) * (1.0 - 5.0 * inside))), 0.1) / float(weight.mean())
    information = slope * (J * weight[:, None]).T @ J / spread**2 + prior
    covariance = np.linalg.inv(information)
    # Sandwich estimator: scatter of the gradient between blocks, because residuals within a block are correlated.
    # Residuals within a block count as one sample for standard deviations: a marker's bias persists for many
    # frames.
    blocks = np.floor((t_s - t_s[0]) / 1.0).astype(np.intp)
    score = np.zeros((int(blocks[-1]) + 1, J.shape[1]))
    np.add.at(score, blocks, J * (weight * remaining)[:, None] / spread**2)
    scatter = covariance @ (score.T @ score) @ covariance
    variance = np.diag(scatter) + np.diag(covariance @ prior @ covariance)
    # The scatter of few blocks is unreliable: the variance is never below that of independent residuals.
    sd = np.sqrt(np.maximum(variance, np.diag(covariance)))
    alone = np.diag(np.linalg.pinv((J * weight[:, None]).T @ J / weight.sum(), hermitian=True))
    return LinearFit(
        values=values,
        sd=sd,
        effect=np.asarray(1.0 / np.sqrt(np.maximum(alone, 1e-30)), dtype=np.float64),
        systematic_px=float(np.sqrt(np.mean(np.square(J @ values)))),
        remaining_px=spread,
        weight=weight,
    )


@dataclass(frozen=True, slots=True)
class Change:
    """The largest change of the residuals within the data.

    Attributes:
        t_s: time of the best split.
        step_px: root mean square, over all observations, of the difference between the fits before and after.
        sudden: whether a step fits the residuals better than a linear drift.
    """

    t_s: float
    step_px: float
    sudden: bool


def find_change(J: FloatArray, residual_px: FloatArray, t_s: FloatArray, fit: LinearFit) -> Change | None:
    """Return the best split of the data into two constant fits; None for less than six seconds.

    Args:
        J, residual_px, t_s: as for `fit_linear`.
        fit: of all the data; gives the noise.
    """
    blocks = np.floor((t_s - t_s[0]) / _CHANGE_BLOCK_S).astype(np.intp)
    count = int(blocks[-1]) + 1
    if count < 3 * _CHANGE_MARGIN:
        return None
    # With a step, good residuals are far from the common fit; outliers are therefore sought within each block.
    weight = _weights_about_blocks(residual_px, blocks, count, fit.remaining_px)
    columns = J.shape[1]
    normal, moment, square = np.zeros((count, columns, columns)), np.zeros((count, columns)), np.zeros(count)
    np.add.at(normal, blocks, weight[:, None, None] * J[:, :, None] * J[:, None, :])
    np.add.at(moment, blocks, (weight * residual_px)[:, None] * J)
    np.add.at(square, blocks, weight * residual_px**2)
    ridge = np.eye(columns) / PRIOR_SD_RAD**2
    cumulative = np.cumsum(normal, axis=0), np.cumsum(moment, axis=0), np.cumsum(square)

    def cost(A: FloatArray, b: FloatArray, c: float) -> tuple[float, FloatArray]:
        values = np.linalg.solve(A + ridge, b)
        return float(c - b @ values), values

    whole = [array[-1] for array in cumulative]
    best, change, before, after = np.inf, 0, np.zeros(columns), np.zeros(columns)
    for split in range(_CHANGE_MARGIN - 1, count - _CHANGE_MARGIN):
        early = [array[split] for array in cumulative]
        late = [total - part for total, part in zip(whole, early, strict=True)]
        (left, v_left), (right, v_right) = cost(*early), cost(*late)
        if left + right < best:
            best, change, before, after = left + right, split, v_left, v_right
    drift = np.column_stack([J, J * ((t_s - t_s.mean()) / max(np.ptp(t_s), 1e-9))[:, None]])
    A = (drift * weight[:, None]).T @ drift + np.eye(2 * columns) / PRIOR_SD_RAD**2
    b = (drift * weight[:, None]).T @ residual_px
    steady = float(whole[2] - b @ np.linalg.solve(A, b))
    return Change(
        t_s=float(t_s[0] + (change + 1) * _CHANGE_BLOCK_S),
        step_px=float(np.sqrt(np.mean(np.square(J @ (after - before))))),
        sudden=best < steady,
    )


def _weights_about_blocks(residual_px: FloatArray, blocks: NDArray[np.intp], count: int, spread: float) -> FloatArray:
    """Return weights (N,): 1 for residuals near the median of their block of time, otherwise 0."""
    weight = np.zeros(len(residual_px))
    for block in range(count):
        chosen = blocks == block
        if chosen.any():
            off = np.abs(residual_px[chosen] - np.median(residual_px[chosen]))
            weight[chosen] = off < _TUKEY * max(spread, 1.4826 * float(np.median(off)))
    return weight


def _directions(xy: FloatArray) -> FloatArray:
    return np.column_stack([xy, np.ones(len(xy))])


# Cameras whose names or plugs were exchanged.


def are_swapped(
    first: str, second: str, tracks: Tracks, cameras: dict[str, CameraModel], periods_s: dict[str, float]
) -> bool:
    """Return whether two cameras' views fit far better when they are exchanged.

    Either their rays then meet in front of the cameras and not behind, or on their epipolar lines and not beside.
    """
    usual = _pair_fit(first, second, tracks, cameras, periods_s)
    exchanged = {first: _renormalised(tracks[second], cameras[second], cameras[first])}
    exchanged[second] = _renormalised(tracks[first], cameras[first], cameras[second])
    periods = {first: periods_s[second], second: periods_s[first]}
    other = _pair_fit(first, second, exchanged, cameras, periods)
    if usual is None or other is None:
        return False
    (residual_px, ahead), (other_px, other_ahead) = usual, other
    limit_px = 2.0
    if ahead < _BEHIND < other_ahead and other_px < residual_px + limit_px:
        return True
    return residual_px > limit_px and other_px < _SWAP_RATIO * residual_px and other_ahead > _BEHIND


def _renormalised(tracks: Mapping[str, PixelTrack], taken: CameraModel, belongs: CameraModel) -> dict[str, PixelTrack]:
    """Return tracks that were undistorted with one camera's lens as if by that of the camera that they belong to."""
    at_unit = CameraModel.from_arrays(taken.width, taken.height, taken.K, taken.distortion, np.eye(4))
    return {
        name: PixelTrack(
            track.t_s, belongs.undistort(at_unit.project(np.column_stack([track.xy, np.ones(len(track.xy))])))
        )
        for name, track in tracks.items()
    }


def _pair_fit(
    first: str, second: str, tracks: Tracks, cameras: dict[str, CameraModel], periods_s: dict[str, float]
) -> tuple[float, float] | None:
    """Return the median epipolar residual, pixels, and the share of views whose rays meet in front of both cameras.

    None with too few common views.
    """
    pair = pair_residuals(first, second, tracks, cameras, periods_s)
    if len(pair.t_s) < LEAST_OBSERVATIONS:
        return None
    ahead = rays_meet_ahead(cameras[first], cameras[second], pair.xy_first, pair.xy)
    return float(np.median(np.abs(pair.residual_px))), float(np.mean(ahead))
