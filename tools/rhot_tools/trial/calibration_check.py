"""Judge from the residuals of all pairs of cameras whether the calibration is still valid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel
from rhot.quality import epipolar_limit_px, pair_epipolar_p95_px
from rhot_tools.trial.epipolar_residuals import (
    LEAST_OBSERVATIONS,
    PRIOR_SD_RAD,
    Change,
    LinearFit,
    PairResiduals,
    Tracks,
    find_change,
    fit_linear,
    pair_residuals,
)

Verdict = Literal["good", "drifting", "bumped"]

AXES = ("pitch", "yaw", "roll")
_LENS_ERROR_PX = 0.1
_LENS_SHARE = 1.0 / 3.0
"""Systematic residuals of a good calibration that resemble a rotation: this many pixels, or this share of the 95th
percentile at the calibration. Added to the standard deviation of every rotation."""
_BUMPED_RAD, _DRIFTING_RAD = np.radians(0.3), np.radians(0.1)
"""Larger rotations count even if they cause few pixels where the hand was."""
_LINE_PRIOR = np.array([100.0, 0.2, 0.2])
"""Prior standard deviations of offset (px) and slopes of the line; wide, only to keep the fit solvable."""


@dataclass(frozen=True, slots=True)
class CameraRotation:
    """Rotation of a camera since the calibration, in its own axes (x right, y down, z forward).

    Attributes:
        degrees: (3,) pitch, yaw, roll.
        sd_degrees: (3,) standard deviations.
        observed: which of them the data determine; the others are determined by the prior only.
    """

    degrees: FloatArray
    sd_degrees: FloatArray
    observed: tuple[bool, bool, bool]


@dataclass(frozen=True, slots=True)
class PairReport:
    """Result of one pair of cameras.

    Attributes:
        first, second: names.
        observations: number of residuals.
        median_px, rms_px, p95_px: median of the signed residual, RMS, 95th percentile of the absolute residual.
        line: a (px), b, c of r = a + b·x + c·y, with x and y in pixels from the second camera's principal point.
        line_sd: their standard deviations.
        rotation: of the second camera, assuming that the first did not move.
        systematic_px: RMS of the part of the residuals that the rotation or the line explains; 0 if not significant.
        noise_px: robust standard deviation of the residuals after fitting the rotation.
        calibrated_p95_px: epipolar error at the calibration; None if not recorded.
        limit_px: of `systematic_px`.
        thirds_px: median residual of the first and the last third of the time.
        change: the largest change; None for less than six seconds.
        verdict: of this pair.
    """

    first: str
    second: str
    observations: int
    median_px: float
    rms_px: float
    p95_px: float
    line: FloatArray
    line_sd: FloatArray
    rotation: CameraRotation
    systematic_px: float
    noise_px: float
    calibrated_p95_px: float | None
    limit_px: float
    thirds_px: tuple[float, float]
    change: Change | None
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class CalibrationReport:
    """Result of all pairs of cameras.

    Attributes:
        pairs: those with enough common observations.
        skipped: number of common observations of the other pairs, by name.
        verdict: the worst of all pairs.
        moved: the camera that moved, if it can be identified (three cameras or more); otherwise empty.
        moved_rotation: its rotation.
    """

    pairs: tuple[PairReport, ...]
    skipped: Mapping[str, int]
    verdict: Verdict
    moved: str = ""
    moved_rotation: CameraRotation | None = None


def judge_calibration(
    tracks: Tracks, cameras: Mapping[str, CameraModel], periods_s: Mapping[str, float], quality: Any
) -> CalibrationReport:
    """Judge a calibration from its cameras' marker tracks.

    Args:
        tracks: marker tracks of each camera.
        cameras: the calibration.
        periods_s: frame period of each camera, seconds.
        quality: `quality` of `cameras.json`, with the epipolar errors at the calibration.

    Raises:
        CalibrationError: no two cameras observed the same markers at the same time often enough.
    """
    residuals: list[PairResiduals] = []
    skipped: dict[str, int] = {}
    for first, second in combinations(cameras, 2):
        pair = pair_residuals(first, second, tracks, cameras, periods_s)
        if len(pair.t_s) < LEAST_OBSERVATIONS:
            skipped[pair.name] = len(pair.t_s)
        else:
            residuals.append(pair)
    if not residuals:
        most = max(skipped.values(), default=0)
        raise CalibrationError(
            f"no two cameras saw the same markers at the same time often enough ({most} times, {LEAST_OBSERVATIONS} "
            "needed); move the hand slowly for ten seconds or more where at least two cameras see it"
        )
    fits = [fit_linear(pair.J_second, pair.residual_px, pair.t_s, np.full(3, PRIOR_SD_RAD)) for pair in residuals]
    reports = tuple(_report(pair, fit, quality) for pair, fit in zip(residuals, fits, strict=True))
    verdict: Verdict = max((report.verdict for report in reports), key=("good", "drifting", "bumped").index)
    moved = "" if verdict == "good" else _moved(residuals, fits)
    rotation = _rotation_of(moved, residuals, fits) if moved else None
    return CalibrationReport(reports, skipped, verdict, moved, rotation)


def _report(pair: PairResiduals, fit: LinearFit, quality: Any) -> PairReport:
    calibrated = pair_epipolar_p95_px(quality, pair.first, pair.second)
    limit_px = epipolar_limit_px(calibrated)
    pixels = np.column_stack([np.ones(len(pair.xy)), pair.focal_px * pair.xy])
    line = fit_linear(pixels, pair.residual_px, pair.t_s, _LINE_PRIOR)
    change = find_change(pair.J_second, pair.residual_px, pair.t_s, fit)
    third = np.ptp(pair.t_s) / 3.0
    early, late = pair.t_s <= pair.t_s[0] + third, pair.t_s >= pair.t_s[-1] - third
    systematic_px = max(one.systematic_px if _is_certain(one) else 0.0 for one in (fit, line))
    size_px = max(systematic_px, change.step_px if change is not None else 0.0)
    rotation = _rotation(fit, calibrated)
    rotated_rad = np.radians(_certain_degrees(rotation))
    verdict: Verdict = "good"
    if size_px > limit_px or rotated_rad > _BUMPED_RAD:
        verdict = "bumped"
    elif size_px > 0.5 * limit_px or rotated_rad > _DRIFTING_RAD:
        verdict = "drifting"
    sizes = np.abs(pair.residual_px)
    return PairReport(
        first=pair.first,
        second=pair.second,
        observations=len(pair.t_s),
        median_px=float(np.median(pair.residual_px)),
        rms_px=float(np.sqrt(np.mean(np.square(sizes)))),
        p95_px=float(np.percentile(sizes, 95)),
        line=line.values,
        line_sd=line.sd,
        rotation=rotation,
        systematic_px=systematic_px,
        noise_px=fit.remaining_px,
        calibrated_p95_px=calibrated,
        limit_px=limit_px,
        thirds_px=(float(np.median(pair.residual_px[early])), float(np.median(pair.residual_px[late]))),
        change=change,
        verdict=verdict,
    )


def _is_certain(fit: LinearFit) -> bool:
    # Standard deviations beyond which a fitted parameter is significant: 1 in 16,000 of normal noise.
    return bool((np.abs(fit.values) > 4.0 * fit.sd).any())


def _rotation(fit: LinearFit, calibrated_p95_px: float | None) -> CameraRotation:
    lens_px = max(_LENS_ERROR_PX, _LENS_SHARE * (calibrated_p95_px or 0.0))
    sd = np.hypot(fit.sd, lens_px / fit.effect)
    # A rotation is observable if its standard deviation is below this.
    pitch, yaw, roll = (sd < np.radians(0.5)).tolist()
    return CameraRotation(np.degrees(fit.values), np.degrees(sd), (pitch, yaw, roll))


def _certain_degrees(rotation: CameraRotation) -> float:
    """Return the largest significant rotation about an observable axis, degrees; 0 = none."""
    sizes = np.abs(rotation.degrees)
    # Standard deviations that such a rotation must exceed.
    certain = np.array(rotation.observed) & (sizes > 3.0 * rotation.sd_degrees)
    return float(sizes[certain].max(initial=0.0))


def _moved(residuals: Sequence[PairResiduals], fits: Sequence[LinearFit]) -> str:
    """Return the camera whose rotation alone explains the residuals of all pairs; empty if it is ambiguous."""
    names = list(dict.fromkeys(name for pair in residuals for name in (pair.first, pair.second)))
    if len(names) < 3:
        return ""
    excess = {}
    for name in names:
        information, moment, square = np.eye(3) / PRIOR_SD_RAD**2, np.zeros(3), 0.0
        for pair, fit in zip(residuals, fits, strict=True):
            # Weights of the pair's own fit, so that all views of a moved camera are not rejected as outliers. The
            # residuals of that fit are noise, whichever camera moved.
            noise = pair.residual_px - pair.J_second @ fit.values
            square += float(fit.weight @ (np.square(pair.residual_px) - np.square(noise)))
            J = pair.derivative(name)
            if J is not None:
                information += (J * fit.weight[:, None]).T @ J
                moment += (J * fit.weight[:, None]).T @ pair.residual_px
        excess[name] = square - float(moment @ np.linalg.solve(information, moment))
    best, second, *_ = sorted(names, key=lambda name: excess[name])
    # A camera is reported as moved if its rotation alone leaves less than this share of the residuals (squared,
    # less noise) that the next best camera leaves.
    return best if excess[best] < 0.25 * excess[second] else ""


def _rotation_of(camera: str, residuals: Sequence[PairResiduals], fits: Sequence[LinearFit]) -> CameraRotation:
    """Return a camera's rotation, from all its pairs."""
    J, r, t = [], [], []
    for pair, fit in zip(residuals, fits, strict=True):
        derivative = pair.derivative(camera)
        if derivative is not None:
            used = fit.weight > 0.0
            J.append(derivative[used])
            r.append(pair.residual_px[used])
            t.append(pair.t_s[used])
    order = np.argsort(np.concatenate(t), kind="stable")
    t_s = np.concatenate(t)[order]
    fit = fit_linear(np.concatenate(J)[order], np.concatenate(r)[order], t_s, np.full(3, PRIOR_SD_RAD))
    return _rotation(fit, None)
