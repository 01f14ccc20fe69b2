"""Online estimate of a rig's systematic epipolar residuals since its calibration.

When cameras rotate in their mounts, the epipolar residual of two views of a point becomes some pixels that vary slowly
over the image. For each camera but the first, the signed distance of its observation from the epipolar line of the
first camera's observation is modelled as

    r(x, y) = a + b·x + c·y        normalised coordinates,

(an offset, and to first order a roll and a change of scale). The parameters are estimated by recursive least squares
with slow exponential forgetting, a zero-mean prior, Huber weights and a bound. Observations are corrected across the
epipolar lines only: an error along them cannot be distinguished from depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.geometry.camera import CameraModel, essential_matrix

# Short histories of the observations per camera and marker, evaluated at a common time.
#
# Cameras are not synchronised and the rows of an image are not exposed together, so every observation has its own
# time. A track is interpolated linearly between two observations and extrapolated for a bounded time after the newest
# one, from its last three.

DEPTH = 4
"""Observations kept per camera and marker."""
ROWS_SHARE = 0.5
"""Additional extrapolation, as a share of a frame period: the rows of an image are exposed at different times."""
LONGEST_GAP = 3.5
"""No interpolation between observations further apart than this many frame periods."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """All tracks at one time.

    Attributes:
        xy: (C, M, 2) normalised image coordinates; NaN where not valid.
        valid: (C, M) which tracks have a value.
    """

    xy: FloatArray
    valid: BoolArray


class Tracks:
    """Histories of C cameras and M markers; normalised image coordinates and seconds."""

    def __init__(self, cameras: int, markers: int) -> None:
        # (C, DEPTH, M), the newest last: operations over all markers then access contiguous memory.
        self._t: FloatArray = np.full((cameras, DEPTH, markers), -np.inf)
        self._xy: FloatArray = np.full((cameras, DEPTH, markers, 2), np.nan)
        self._linked: BoolArray = np.zeros((cameras, DEPTH, markers), dtype=bool)
        self._camera: IndexArray = np.arange(cameras)[:, None]
        self._marker: IndexArray = np.arange(markers)

    @property
    def last_t_s(self) -> FloatArray:
        """(C, M) time of the newest observation, −∞ before the first."""
        return self._t[:, -1]

    def append(self, camera: int, markers: IndexArray, t_s: FloatArray, xy: FloatArray, max_rate: float) -> None:
        """Add one frame's observations.

        Args:
            camera: index.
            markers: (K,) indices, ascending.
            t_s: (K,) times, later than the newest of their tracks.
            xy: (K, 2) normalised coordinates.
            max_rate: highest plausible image speed, normalised units per second. A faster step splits the track: it is
                neither interpolated nor used for a velocity.
        """
        rows = slice(None) if len(markers) == len(self._marker) else markers
        past_t, past_xy, past_linked = self._t[camera], self._xy[camera], self._linked[camera]
        way = max_rate * (t_s - past_t[-1, rows])
        step = xy - past_xy[-1, rows]
        step *= step
        for past in (past_t, past_xy, past_linked):
            past[:-1, rows] = past[1:, rows]
        past_t[-1, rows] = t_s
        past_xy[-1, rows] = xy
        past_linked[-1, rows] = step[:, 0] + step[:, 1] <= way * way

    def at(self, t_s: float, max_extrapolation_s: float, max_gap_s: float) -> Snapshot:
        """Return all tracks at a time.

        Args:
            t_s: the time.
            max_extrapolation_s: a track whose newest observation is older than this has no value.
            max_gap_s: observations further apart are neither interpolated nor used for a velocity.
        """
        ahead = t_s - self._t[:, -1]
        with np.errstate(invalid="ignore", divide="ignore"):
            extrapolated = (ahead >= 0.0) & (ahead <= max_extrapolation_s)
            xy = self._extrapolated(ahead, max_gap_s)
            valid = extrapolated
            if (ahead < 0.0).any():
                between_xy, between = self._interpolated(t_s, max_gap_s)
                xy = np.where(between[:, :, None], between_xy, xy)
                valid = extrapolated | between
        if not valid.all():
            xy[~valid] = np.nan
        return Snapshot(xy, valid)

    def _interpolated(self, t_s: float, max_gap_s: float) -> tuple[FloatArray, BoolArray]:
        """Return tracks (C, M, 2) interpolated between the observations before and after t_s, and which are valid."""
        late = np.count_nonzero(self._t <= t_s, axis=1)
        known = (late > 0) & (late < DEPTH)
        late = np.minimum(np.maximum(late, 1), DEPTH - 1)
        before, after = (self._camera, late - 1, self._marker), (self._camera, late, self._marker)
        early_s, gap = self._t[before], self._t[after] - self._t[before]
        known &= self._linked[after] & (gap <= max_gap_s)
        share = ((t_s - early_s) / gap)[:, :, None]
        return (1.0 - share) * self._xy[before] + share * self._xy[after], known

    def _extrapolated(self, ahead_s: FloatArray, max_gap_s: float) -> FloatArray:
        """Return tracks (C, M, 2) extrapolated by (C, M) seconds after their newest observations.

        Uses Newton's form of the parabola through the last three observations, with half its quadratic term; after a
        split or a gap, a line or a constant. A line errs by ½·a·t·(t + T) for a marker with acceleration a, in one
        camera only, and a short baseline amplifies this tenfold in depth. The whole parabola amplifies noise 2.5 times.
        Half had the smallest error over slow and fast motion with cameras 7 ms out of phase.
        """
        t, xy, linked = self._t, self._xy, self._linked
        interval = t[:, -2:] - t[:, -3:-1]
        joined = linked[:, -2:] & (interval <= max_gap_s)
        rate = (xy[:, -2:] - xy[:, -3:-1]) / interval[:, :, :, None]
        earlier, last = interval[:, 0], interval[:, 1]
        bend = (rate[:, 1] - rate[:, 0]) * (0.5 * ahead_s * (ahead_s + last) / (last + earlier))[:, :, None]
        way = rate[:, 1] * ahead_s[:, :, None]
        way += np.where((joined[:, 0] & joined[:, 1])[:, :, None], bend, 0.0)
        extrapolated: FloatArray = xy[:, -1] + np.where(joined[:, 1, :, None], way, 0.0)
        return extrapolated

    def clear(self) -> None:
        """Discard all observations."""
        self._t.fill(-np.inf)
        self._xy.fill(np.nan)
        self._linked.fill(False)


_MEMORY_S = 20.0
"""Time constant of the forgetting: mounts creep over minutes."""
_PRIOR_SLOPE = 0.03
"""Prior standard deviation of b and c: about 1.7° of roll."""
_WINDOW = 256
"""Number of recent residuals kept for the statistics."""


class EpipolarModel:
    """Residual models of C cameras relative to the first, and statistics of the corrected residuals.

    Attributes:
        coefficients: (C, 3) a, b, c of each camera; 0 for the first.
        spread_px: robust standard deviation of the corrected residuals, pixels.
    """

    def __init__(self, cameras: Sequence[CameraModel], limit_px: float) -> None:
        reference = cameras[0]
        self._focal_px = float(np.mean([camera.K[0, 0] for camera in cameras]))
        self._limit = limit_px / self._focal_px
        self._t: FloatArray = np.stack([camera.to_camera(reference.center[None])[0] for camera in cameras])
        # The epipolar line of (x, y, 1) of the first camera is E · (x, y, 1).
        self._essential: FloatArray = np.stack([essential_matrix(reference, camera) for camera in cameras])
        # Prior standard deviation of a. Chosen on the 2018 streams, whose cameras had moved since the
        # calibration.
        prior = np.array([(8.0 / self._focal_px) ** -2, _PRIOR_SLOPE**-2, _PRIOR_SLOPE**-2])
        # In units of the information of an observation with a standard deviation of one pixel.
        self._prior: FloatArray = np.diag(prior) / self._focal_px**2
        self._information: FloatArray = np.zeros((len(cameras), 3, 3))
        self._moment: FloatArray = np.zeros((len(cameras), 3))
        self.coefficients: FloatArray = np.zeros((len(cameras), 3))
        # Initial noise. Chosen on the 2018 streams.
        self.spread_px = 5.0
        self._recent: FloatArray = np.full(_WINDOW, np.nan)
        self._place = 0

    def set_limit(self, limit_px: float) -> None:
        """Change the bound of the correction, pixels."""
        self._limit = limit_px / self._focal_px

    def correct(self, xy: FloatArray) -> FloatArray:
        """Return observations (C, M, 2) corrected across their epipolar lines by the model; NaN stays NaN."""
        return np.stack([self.correct_one(camera, views) for camera, views in enumerate(xy)])

    def correct_one(self, camera: int, xy: FloatArray) -> FloatArray:
        """Return the observations (N, 2) of one camera corrected across their epipolar lines; NaN stays NaN."""
        if camera == 0:
            return xy
        a, b, c = self.coefficients[camera]
        e0, e1, e2 = self._t[camera]
        x, y = xy.T
        error = np.clip(a + b * x + c * y, -self._limit, self._limit)
        # Normals of the lines through epipole and observations: the first two entries of e × (x, y, 1).
        normal = np.column_stack([e1 - e2 * y, e2 * x - e0])
        length = np.maximum(np.sqrt((normal * normal).sum(axis=1)), 1e-9)
        corrected: FloatArray = xy - normal * (error / length)[:, None]
        return corrected

    def residual(self, xy: FloatArray) -> FloatArray:
        """Return the signed distances (C, M) of observations (C, M, 2) from their epipolar lines, normalised units.

        The lines are those of the first camera's observations; row 0 is NaN.
        """
        count = xy.shape[1]
        residual = np.full((len(xy), count), np.nan)
        first = np.ones((count, 3))
        first[:, :2] = xy[0]
        for camera in range(1, len(xy)):
            a, b, c = self._essential[camera] @ first.T
            x, y = xy[camera].T
            residual[camera] = (a * x + b * y + c) / np.maximum(np.sqrt(a * a + b * b), 1e-12)
        return residual

    def learn(self, xy: FloatArray, accepted: BoolArray, interval_s: float) -> None:
        """Update the models with the uncorrected observations (C, M, 2) that were accepted (C, M) at one time.

        `interval_s` is the time since the last update.
        """
        usable = accepted & accepted[0]
        if not usable[1:].any():
            return
        forget = float(np.exp(-min(max(interval_s, 0.0), 1.0) / _MEMORY_S))
        residual = self.residual(xy)
        remaining: list[FloatArray] = []
        for camera in range(1, len(xy)):
            chosen = usable[camera]
            if not chosen.any():
                continue
            views = xy[camera][chosen]
            features = np.ones((len(views), 3))
            features[:, 1:] = views
            values = residual[camera][chosen]
            error_px = (values - features @ self.coefficients[camera]) * self._focal_px
            weight = np.minimum(1.0, 2.0 * self.spread_px / np.maximum(np.abs(error_px), 1e-9))
            self._information[camera] *= forget
            self._moment[camera] *= forget
            weighted = features * weight[:, None]
            self._information[camera] += weighted.T @ features
            self._moment[camera] += weighted.T @ values
            self.coefficients[camera] = np.linalg.solve(self._information[camera] + self._prior, self._moment[camera])
            remaining.append(error_px)
        self._measure(np.concatenate(remaining))

    def _measure(self, error_px: FloatArray) -> None:
        self._recent[(self._place + np.arange(len(error_px))) % _WINDOW] = error_px
        self._place += len(error_px)
        # The median is robust against single bad pairs; 1.4826 scales it to the standard deviation of normal noise.
        spread = 1.4826 * median(np.abs(error_px).tolist())
        gain = 0.2 if self._place < 60 else 0.02
        # Lower bound of the noise of a marker's centre.
        self.spread_px = max(0.1, self.spread_px + gain * (spread - self.spread_px))

    @property
    def correction_px(self) -> float:
        """RMS of the modelled residuals over recent observations, pixels, of the camera with the largest.

        It measures how far the cameras have moved since their calibration, as far as epipolar lines can show it.
        """
        largest = 0.0
        for information, coefficients in zip(self._information, self.coefficients, strict=True):
            if information[0, 0] > 0.0:
                # The information matrix holds weighted sums of the products of 1, x and y.
                largest = max(largest, float(coefficients @ information @ coefficients) / float(information[0, 0]))
        return float(np.sqrt(largest)) * self._focal_px

    @property
    def figures_px(self) -> tuple[float, float]:
        """Mean and 95th percentile of the absolute recent corrected residuals, pixels; 0 if there are none."""
        sizes = np.abs(self._recent[np.isfinite(self._recent)])
        return (float(sizes.mean()), float(np.percentile(sizes, 95))) if len(sizes) else (0.0, 0.0)
