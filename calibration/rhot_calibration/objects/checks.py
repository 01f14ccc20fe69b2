"""What a registration must stand: places that determine it, and a result that can be true."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import nearest_rotation
from rhot_calibration.objects.fit import LEVER, Places, RegistrationFit, free_scale

# The last moments of live streams, in which a tracked device and something else have to be held still.

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


LEAST_PLACES = 3
_LEAST_SPREAD_M = 0.03
"""Root mean square distance of the places from their middle, along their longest direction."""
_LEAST_WIDTH_M = 0.015
"""The same across that direction: below, they are as good as on a line, about which the rotation is free."""
_LARGEST_ROTATION_SD_RAD = np.radians(1.5)
_LARGEST_RMS_M = 0.015
_SCALE_NOTED = 0.02
_SCALE_REFUSED = 0.05
_LARGEST_LEVER_SD_M = 0.0025
"""Above, along any direction, the lever arm counts as open."""


def check_places(places: Places) -> None:
    """Refuse places that cannot determine a registration.

    Raises:
        CalibrationError: too few, too near to each other, or on a line; says what to do.
    """
    if len(places) < LEAST_PLACES:
        raise CalibrationError(
            f"{len(places)} places are too few, {LEAST_PLACES} are the least and ten are good; hold the marker still "
            "at more places (an earlier registration can be corrected with fewer: --realign)"
        )
    longest_m, width_m, _ = _extent_m(places.x_rig)
    if longest_m < _LEAST_SPREAD_M:
        raise CalibrationError(
            f"the places are too near to each other: {1e3 * longest_m:.0f} mm RMS from their middle, "
            f"{1e3 * _LEAST_SPREAD_M:.0f} mm is the least; spread them over all of what the cameras see"
        )
    if width_m < _LEAST_WIDTH_M:
        raise CalibrationError(
            f"the places lie on a line, within {1e3 * width_m:.0f} mm RMS ({1e3 * _LEAST_WIDTH_M:.0f} mm is the "
            "least): how the tracker's space is turned about that line cannot be told; add places well beside it"
        )


def check_fit(fit: RegistrationFit) -> None:
    """Refuse a registration that the residuals or the uncertainty speak against.

    Raises:
        CalibrationError: places that do not agree, or leave the rotation open.
    """
    if fit.rms_m > _LARGEST_RMS_M:
        raise CalibrationError(
            f"the places do not fit: {1e3 * fit.rms_m:.1f} mm RMS, {1e3 * _LARGEST_RMS_M:.0f} mm is the limit; is it "
            "the marker on this very device, fixed to it, and are the device's axes in the right columns?"
        )
    left_out = int(np.count_nonzero(~fit.kept))
    if left_out > len(fit.kept) // 3:
        raise CalibrationError(
            f"{left_out} of {len(fit.kept)} places contradict the others; a third at most may be left out. Hold the "
            "marker still at each place, in sight of the cameras and of the base stations"
        )
    sd_deg = np.degrees(fit.estimate.rotation_sd_rad)
    if sd_deg > np.degrees(_LARGEST_ROTATION_SD_RAD):
        raise CalibrationError(
            f"the places leave the rotation open to ± {sd_deg:.1f}°, {np.degrees(_LARGEST_ROTATION_SD_RAD):.1f}° is "
            "the limit; add places, further apart in all directions"
        )


def scale_note(places: Places, fit: RegistrationFit) -> str:
    """Return what a wrong scale says, empty when the scale is right or cannot be told.

    Raises:
        CalibrationError: cameras and tracker disagree about the metre beyond repair.
    """
    if np.count_nonzero(fit.kept) < LEAST_PLACES + 1:
        return ""
    scale, sd = free_scale(places, fit)
    off = scale - 1.0
    if abs(off) < _SCALE_NOTED or abs(off) < 3.0 * sd:
        return ""
    text = (
        f"the cameras measure lengths {100 * abs(off):.1f} % {'longer' if off > 0 else 'shorter'} than the tracking "
        f"system (± {100 * sd:.1f} %): was --square-mm right in `rhot calibrate cameras`, and is it this device?"
    )
    if abs(off) > _SCALE_REFUSED:
        raise CalibrationError(text)
    return text


def lever_note(fit: RegistrationFit) -> str:
    """Return which motion would determine the lever arm, empty when it is determined."""
    variances, axes = np.linalg.eigh(fit.estimate.covariance[LEVER, LEVER])
    open_axes = np.sqrt(np.maximum(variances, 0.0)) > _LARGEST_LEVER_SD_M
    if not open_axes.any():
        return ""
    sd_mm = 1e3 * float(np.sqrt(variances[-1]))
    if open_axes.all():
        return (
            f"where the marker sits on the device is known to ± {sd_mm:.0f} mm only, and all positions with it: turn "
            "the tracker by 45° or more between places, about two different axes, or measure it (--lever X,Y,Z)"
        )
    names = " and ".join(_axis_text(axes[:, place]) for place in np.flatnonzero(open_axes))
    return (
        f"where the marker sits on the device along {names} is known to ± {sd_mm:.0f} mm only: the tracker was turned "
        "about that axis alone; tilt it across it at some places, or measure the lever arm (--lever X,Y,Z)"
    )


def _axis_text(axis: FloatArray) -> str:
    place = int(np.argmax(np.abs(axis)))
    return f"its own {'xyz'[place]} axis" if abs(axis[place]) > 0.95 else f"its own direction ({_numbers(axis)})"


def _numbers(axis: FloatArray) -> str:
    return ", ".join(f"{value:.2f}" for value in axis)


def _extent_m(x: FloatArray) -> FloatArray:
    """Return the RMS extents (3,) of points (N, 3) along their principal directions, falling."""
    sizes: FloatArray = np.linalg.svd(x - x.mean(axis=0), compute_uv=False) / np.sqrt(len(x))
    return np.concatenate([sizes, np.zeros(3 - len(sizes))])
