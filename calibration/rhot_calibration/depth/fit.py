"""Laws that turn disparity into depth, fitted to measured distances.

Two cameras that look in parallel see a point at depth D with the disparity d = f·B / D. A rig is never quite parallel:
turned towards or away from each other by a small angle θ, all disparities are off by f·tan θ, so

    D = a / (d − o),    a = f·B,    o = f·tan θ          (physical law)

The 2018 system fitted D = k · d^z instead (power law), by a straight line through the logarithms.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError

LEAST_ROWS = 3


@dataclass(frozen=True, slots=True)
class PowerLaw:
    """D = k · d^z.

    Attributes:
        k: metres at a disparity of one pixel.
        z: exponent, near −1.
    """

    k: float
    z: float

    def depth_m(self, disparity_px: FloatArray) -> FloatArray:
        """Return depths (N,), metres, of disparities (N,), pixels."""
        depth: FloatArray = self.k * disparity_px**self.z
        return depth


@dataclass(frozen=True, slots=True)
class PhysicalLaw:
    """D = a / (d − o).

    Attributes:
        a: focal length times baseline, pixel metres.
        offset_px: disparity of a point infinitely far away: the cameras' turn against each other.
    """

    a: float
    offset_px: float

    def depth_m(self, disparity_px: FloatArray) -> FloatArray:
        """Return depths (N,), metres, of disparities (N,), pixels."""
        depth: FloatArray = self.a / (disparity_px - self.offset_px)
        return depth


def fit_power_law(distance_m: FloatArray, disparity_px: FloatArray) -> PowerLaw:
    """Fit the power law by least squares of the logarithms.

    Args:
        distance_m: (N,) measured, metres.
        disparity_px: (N,) pixels, positive.

    Raises:
        CalibrationError: too few or impossible rows.
    """
    check_rows(distance_m, disparity_px)
    A = np.column_stack([np.ones(len(disparity_px)), np.log(disparity_px)])
    (log_k, z), *_ = np.linalg.lstsq(A, np.log(distance_m), rcond=None)
    return PowerLaw(float(np.exp(log_k)), float(z))


def fit_physical_law(distance_m: FloatArray, disparity_px: FloatArray) -> PhysicalLaw:
    """Fit the physical law by least squares of the relative error (started from the linear solution in 1/D).

    Args:
        distance_m: (N,) measured, metres.
        disparity_px: (N,) pixels, positive.

    Raises:
        CalibrationError: too few or impossible rows.
    """
    from scipy.optimize import least_squares  # noqa: PLC0415  # half a second, and reports of a trial load this too

    check_rows(distance_m, disparity_px)
    A = np.column_stack([1.0 / distance_m, np.ones(len(distance_m))])
    start, *_ = np.linalg.lstsq(A, disparity_px, rcond=None)

    def relative_error(law: FloatArray) -> FloatArray:
        error: FloatArray = law[0] / (disparity_px - law[1]) / distance_m - 1.0
        return error

    law = least_squares(relative_error, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12).x
    a, offset = law.tolist()
    if not np.isfinite(law).all() or a <= 0.0 or (disparity_px - offset).min() <= 0.0:
        raise CalibrationError(
            f"no physical law fits these rows (it would need a = {a:.4g} and an offset of {offset:.4g} px); are "
            "distances and disparities in the right columns?"
        )
    return PhysicalLaw(a, offset)


def check_rows(distance_m: FloatArray, disparity_px: FloatArray) -> None:
    """Refuse rows that no camera pair can have measured.

    Raises:
        CalibrationError: says which and why.
    """
    if len(distance_m) < LEAST_ROWS:
        raise CalibrationError(
            f"{len(distance_m)} rows are too few, {LEAST_ROWS} are the least; measure from near to far, ten or more"
        )
    if (distance_m <= 0.0).any():
        raise CalibrationError(f"a distance of {distance_m.min():g} m cannot be; all must be positive")
    if (disparity_px <= 0.0).any():
        raise CalibrationError(
            f"a disparity of {disparity_px.min():g} px cannot be: a point before both cameras lies further right in "
            "the left camera's picture (left_x − right_x > 0); are the cameras swapped?"
        )
    if np.ptp(distance_m) < 0.1 * distance_m.max():
        raise CalibrationError(
            f"all distances lie between {distance_m.min():g} and {distance_m.max():g} m; measure over a wider range"
        )
    if np.corrcoef(np.log(distance_m), np.log(disparity_px))[0, 1] > -0.5:
        raise CalibrationError("disparity does not fall with distance; are the columns or some rows mixed up?")


def relative_rms(law: PowerLaw | PhysicalLaw, distance_m: FloatArray, disparity_px: FloatArray) -> float:
    """Return the root mean square of the relative depth error."""
    return float(np.sqrt(np.mean(np.square(law.depth_m(disparity_px) / distance_m - 1.0))))
