"""The samples of one hand: what a calibration keeps of a stream of point sets."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.messages import Point, PointSet
from rhot_calibration.hand.fit.parameters import HandParameters

FEWEST_SAMPLES: Final = 60
_SMALLEST_SIGMA_M: Final = 0.0003
"""Points are not believed to be better than this, whatever they say."""
_NOWHERE: Final = np.full(3, np.nan)


@dataclass(frozen=True, slots=True)
class HandSamples:
    """Markers of one hand at N moments, rig frame, metres; only what was measured at that moment.

    Attributes:
        t_ns: (N,) rig clock.
        base: (N, 3) centre of the base marker.
        corners: (N, 4, 3) of its patch in cyclic order; NaN = not seen.
        tips: (N, 5, 3) fingertip markers; NaN rows = not seen.
        sigma_m: typical standard deviation of a tip, metres (root of the sum of three variances), as published.
        began_ns: rig clock at the first point set, also where it showed no base.
    """

    t_ns: NDArray[np.int64]
    base: FloatArray
    corners: FloatArray
    tips: FloatArray
    sigma_m: float
    began_ns: int

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def seconds(self) -> FloatArray:
        """Times (N,) since the first point set."""
        return np.asarray((self.t_ns - self.began_ns) * 1e-9)

    @property
    def has_corners(self) -> bool:
        """Whether the patch's corners are seen often enough to tell how the palm is turned."""
        return len(self) > 0 and float(np.isfinite(self.corners).all(axis=(1, 2)).mean()) >= 0.5

    def at(self, index: NDArray[np.intp]) -> HandSamples:
        """Return some of the samples."""
        return HandSamples(
            self.t_ns[index], self.base[index], self.corners[index], self.tips[index], self.sigma_m, self.began_ns
        )


def read_samples(points: Iterable[PointSet], parameters: HandParameters) -> HandSamples:
    """Return the samples of a hand in which its base marker was measured.

    Raises:
        CalibrationError: too few of them; says what to do.
    """
    base_name = parameters.base
    times, bases, corners, tips, sigmas = [], [], [], [], []
    sets, began_ns = 0, 0
    for one in points:
        sets += 1
        began_ns = one.t_ns if sets == 1 else began_ns
        base = one.points.get(base_name)
        if base is None or base.state != "measured":
            continue
        times.append(one.t_ns)
        bases.append(base.position)
        corners.append(np.full((4, 3), np.nan) if base.corners is None else np.array(base.corners))
        tips.append([_measured(one.points.get(parameters.caps.get(finger, ""))) for finger in FINGERS])
        sigmas.append(base.sigma)
    if len(times) < FEWEST_SAMPLES:
        what = f"{base_name} was never seen" if not times else f"{base_name} was measured in only {len(times)} samples"
        raise CalibrationError(
            f"{what} ({sets} point sets in all), at least {FEWEST_SAMPLES} are needed; record 20 s or more with the "
            f"{parameters.side} hand in view of two cameras, and check with `rhot doctor` that the rig tracks"
        )
    sigma_m = max(float(np.median(sigmas)), _SMALLEST_SIGMA_M)
    arrays = np.array(times), np.array(bases), np.array(corners), np.array(tips)
    samples = _without_spikes(HandSamples(*arrays, sigma_m, began_ns))
    return samples.at(np.flatnonzero(np.isfinite(samples.base).all(axis=1)))


def _measured(point: Point | None) -> FloatArray:
    return np.array(point.position) if point is not None and point.state == "measured" else _NOWHERE


def _without_spikes(samples: HandSamples) -> HandSamples:
    """Return the samples without positions that lie far from both the sample before and the one after."""
    points = np.concatenate([samples.tips, samples.base[:, None]], axis=1)
    middle = np.median(np.stack([points[:-2], points[1:-1], points[2:]]), axis=0)
    spike_m = 0.008
    spike = np.linalg.norm(points[1:-1] - middle, axis=-1) > spike_m
    points[1:-1][spike] = np.nan
    return HandSamples(samples.t_ns, points[:, 5], samples.corners, points[:, :5], samples.sigma_m, samples.began_ns)
