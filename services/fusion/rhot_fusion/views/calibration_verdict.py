"""From the residuals of all pairs of cameras to a verdict: does the calibration still hold?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel
from rhot.rig.quality import epipolar_limit_px, pair_epipolar_p95_px
from rhot_fusion.views.calibration_check import (
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
"""What a good calibration leaves in the residuals as a turn might, added to the uncertainty of every turn: so many
pixels, or this share of the 95th percentile at the calibration."""
_OBSERVED_SD_RAD = np.radians(0.5)
"""A turn counts as observed where its standard deviation is below."""
_SIGNIFICANT = 4.0
"""Standard deviations from which what a fit explains is no chance: 1 in 16,000 of normal noise."""
_BUMPED_RAD, _DRIFTING_RAD = np.radians(0.3), np.radians(0.1)
"""A turn by more, three standard deviations or more, counts as well, however few pixels it makes where the hand was."""
_TURN_SIGMAS = 3.0
_NAMED_SHARE = 0.25
"""One camera is named when its turn alone leaves less than this share of what the next best leaves, noise apart."""
_LINE_PRIOR = np.array([100.0, 0.2, 0.2])
"""Standard deviations of offset (px) and slopes of the residuals' line: wide, they only keep the fit solvable."""


@dataclass(frozen=True, slots=True)
class Turn:
    """How a camera has turned since the calibration, in its own axes (x right, y down, z forward).

    Attributes:
        degrees: (3,) pitch, yaw, roll.
        sd_degrees: (3,) standard deviations.
        observed: which of them the data tell, rather than the assumption that turns are small.
    """

    degrees: FloatArray
    sd_degrees: FloatArray
    observed: tuple[bool, bool, bool]


@dataclass(frozen=True, slots=True)
class PairReport:
    """What one pair of cameras says.

    Attributes:
        first, second: names.
        observations: how many residuals.
        median_px, rms_px, p95_px: of the signed residual, its square, its size.
        line: a (px), b, c of r = a + b·x + c·y, with x and y in pixels from the second camera's middle.
        line_sd: their standard deviations.
        turn: of the second camera if the first stood still.
        systematic_px: root mean square of what the turn or the line explains of the residuals; 0 = nothing for sure.
        noise_px: robust standard deviation of what the turn does not explain.
        calibrated_p95_px: epipolar error at the calibration, where recorded.
        limit_px: for `systematic_px`.
        thirds_px: median residual of the first and the last third of the time.
        change: the moment of the largest change; None for less than six seconds.
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
    turn: Turn
    systematic_px: float
    noise_px: float
    calibrated_p95_px: float | None
    limit_px: float
    thirds_px: tuple[float, float]
    change: Change | None
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class CalibrationReport:
    """The whole answer.

    Attributes:
        pairs: those with enough in common.
        skipped: names of pairs without, and how many observations they had.
        verdict: the worst of all pairs.
        moved: the camera that moved, where three or more cameras tell which; else empty.
        moved_turn: its turn.
    """

    pairs: tuple[PairReport, ...]
    skipped: Mapping[str, int]
    verdict: Verdict
    moved: str = ""
    moved_turn: Turn | None = None


def judge_calibration(
    tracks: Tracks, cameras: Mapping[str, CameraModel], periods_s: Mapping[str, float], quality: Any
) -> CalibrationReport:
    """Judge a calibration by what its cameras see.

    Args:
        tracks: marker tracks of each camera.
        cameras: the calibration.
        periods_s: time between two frames of each camera.
        quality: of `cameras.json`, for the epipolar errors at the calibration.

    Raises:
        CalibrationError: no two cameras saw enough of the same markers at the same time.
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
            "are the least); move the hand where at least two cameras see it, slowly, for ten seconds or more"
        )
    fits = [fit_linear(pair.J_second, pair.residual_px, pair.t_s, np.full(3, PRIOR_SD_RAD)) for pair in residuals]
    reports = tuple(_report(pair, fit, quality) for pair, fit in zip(residuals, fits, strict=True))
    verdict: Verdict = max((report.verdict for report in reports), key=("good", "drifting", "bumped").index)
    moved = "" if verdict == "good" else _moved(residuals, fits)
    turn = _turn_of(moved, residuals, fits) if moved else None
    return CalibrationReport(reports, skipped, verdict, moved, turn)


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
    turn = _turn(fit, calibrated)
    turned_rad = np.radians(_certain_degrees(turn))
    verdict: Verdict = "good"
    if size_px > limit_px or turned_rad > _BUMPED_RAD:
        verdict = "bumped"
    elif size_px > 0.5 * limit_px or turned_rad > _DRIFTING_RAD:
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
        turn=turn,
        systematic_px=systematic_px,
        noise_px=fit.remaining_px,
        calibrated_p95_px=calibrated,
        limit_px=limit_px,
        thirds_px=(float(np.median(pair.residual_px[early])), float(np.median(pair.residual_px[late]))),
        change=change,
        verdict=verdict,
    )


def _is_certain(fit: LinearFit) -> bool:
    return bool((np.abs(fit.values) > _SIGNIFICANT * fit.sd).any())


def _turn(fit: LinearFit, calibrated_p95_px: float | None) -> Turn:
    lens_px = max(_LENS_ERROR_PX, _LENS_SHARE * (calibrated_p95_px or 0.0))
    sd = np.hypot(fit.sd, lens_px / fit.effect)
    pitch, yaw, roll = (sd < _OBSERVED_SD_RAD).tolist()
    return Turn(np.degrees(fit.values), np.degrees(sd), (pitch, yaw, roll))


def _certain_degrees(turn: Turn) -> float:
    """Return the largest observed turn that its uncertainty cannot explain, degrees; 0 = none."""
    sizes = np.abs(turn.degrees)
    certain = np.array(turn.observed) & (sizes > _TURN_SIGMAS * turn.sd_degrees)
    return float(sizes[certain].max(initial=0.0))


def _moved(residuals: Sequence[PairResiduals], fits: Sequence[LinearFit]) -> str:
    """Return the camera whose turn alone explains the residuals of all pairs, empty when that cannot be told."""
    names = list(dict.fromkeys(name for pair in residuals for name in (pair.first, pair.second)))
    if len(names) < 3:
        return ""
    excess = {}
    for name in names:
        information, moment, square = np.eye(3) / PRIOR_SD_RAD**2, np.zeros(3), 0.0
        for pair, fit in zip(residuals, fits, strict=True):
            # Weights of the pair's own fit: a pair with a moved camera must not pass for a heap of outliers. What that
            # fit leaves is noise, whoever moved.
            noise = pair.residual_px - pair.J_second @ fit.values
            square += float(fit.weight @ (np.square(pair.residual_px) - np.square(noise)))
            J = pair.derivative(name)
            if J is not None:
                information += (J * fit.weight[:, None]).T @ J
                moment += (J * fit.weight[:, None]).T @ pair.residual_px
        excess[name] = square - float(moment @ np.linalg.solve(information, moment))
    best, second, *_ = sorted(names, key=lambda name: excess[name])
    return best if excess[best] < _NAMED_SHARE * excess[second] else ""


def _turn_of(camera: str, residuals: Sequence[PairResiduals], fits: Sequence[LinearFit]) -> Turn:
    """Return how a camera has turned by all pairs that it is in."""
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
    return _turn(fit_linear(np.concatenate(J)[order], np.concatenate(r)[order], t_s, np.full(3, PRIOR_SD_RAD)), None)
