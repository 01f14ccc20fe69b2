"""From the point sets of a recording to `hand.json`: phases, fit, and the refusals."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.anatomy.hand import patch_outline
from rhot.anatomy.skeleton import FINGERS
from rhot.errors import CalibrationError
from rhot.messages import PointSet, Side
from rhot.rig import HandFile, Rig
from rhot.rig.calibration import WIDTH_OVER_LENGTH
from rhot_calibration.hand.evidence import Chosen, FlatDistances, PalmFrame, StraightFingers
from rhot_calibration.hand.fit import HandFit, fit
from rhot_calibration.hand.palm import palm_turns
from rhot_calibration.hand.parameters import COUNT, HUMAN_LENGTH_M, HandParameters
from rhot_calibration.hand.phases import FEWEST_FLAT, STRAIGHT_SHARE, Window, find_flat, reaches, straight_stretch
from rhot_calibration.hand.quality import Motion, hand_quality
from rhot_calibration.hand.samples import HandSamples, read_samples

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.intp]

SMALLEST_ARC_RAD: Final = np.radians(30.0)
"""A finger that bent less than this at its knuckle does not tell where the knuckle is."""
MAX_ARC_MISS_M: Final = 0.0025
"""A finger that leaves its sphere by more than this (of medians over 10° of bending) was not kept straight."""
FEWEST_COMPLYING: Final = 3
"""Where fewer fingers than these kept straight, the others did by chance."""
MOST_FLAT, MOST_BENT = 80, 360
"""More samples of a phase are thinned out evenly."""
_STRAIGHT_M: Final = (0.010, 0.006)
"""How near to straight a finger has to be, before and after its knuckle is known roughly …"""
_MOSTLY_STRAIGHT_M: Final = 0.004
"""… and most of the time in the end."""
_OUTLIER_SIGMAS: Final = 3.5
_BIN_RAD: Final = np.radians(10.0)
_BEYOND_M: Final = 0.010
_BEYOND_SHARE: Final = 0.10
_ORDER_GAP_M: Final = 0.012
"""Spread fingertips come so near to crossing, seen a little from the side; swapped paints are 15 mm or more off."""


@dataclass(frozen=True, slots=True)
class Phases:
    """When a recording shows what, as somebody says; None = to be found."""

    flat: Window | None = None
    knuckles: Window | None = None


FIND_PHASES: Final = Phases()


def measure_hand(
    points: Iterable[PointSet],
    rig: Rig,
    side: Side,
    phases: Phases = FIND_PHASES,
    typed_length_m: float | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> HandFile:
    """Return the calibrated hand, without a date; `quality` says what was measured and how surely.

    Args:
        points: of a recording that shows the hand flat and then bending.
        rig: its markers and where its cameras stand.
        side: of the hand.
        phases: when the hand is flat and when it bends at the knuckles only.
        typed_length_m: the hand's length by a ruler, where known.
        report: is told what is being done.

    Raises:
        CalibrationError: the recording cannot give a hand; says why and what to do.
    """
    parameters = HandParameters(side, rig.config.markers)
    report("reading points")
    samples = read_samples(points, parameters)
    viewpoint = _viewpoint(rig)
    report(f"looking for the flat hand in {len(samples)} samples")
    flat = phases.flat or find_flat(samples, steady=samples.has_corners)
    flat_rows = np.flatnonzero(flat.holds(samples.seconds))
    _require_flat(flat, samples.at(flat_rows))
    _require_order(samples.at(flat_rows), viewpoint, parameters)
    report("fitting the hand")
    if samples.has_corners:
        outline = patch_outline(rig.config.markers[parameters.base])
        frame = PalmFrame(parameters, samples, palm_turns(samples, outline, viewpoint), viewpoint)
        fitted, motion = _from_straight_fingers(frame, flat, phases.knuckles, typed_length_m)
    else:
        evidence = FlatDistances(parameters, samples.at(flat_rows))
        fitted = fit(evidence, parameters, np.zeros(COUNT), typed_length_m)
        motion = Motion(flat=flat, knuckles=None, frames=len(flat_rows))
    hand = parameters.hand(fitted.x)
    _require_human(hand)
    quality = hand_quality(parameters, fitted, motion, typed_length_m)
    quality |= {"samples": len(samples), "palm_from_corners": samples.has_corners}
    return hand.model_copy(update={"quality": quality})


def _from_straight_fingers(
    frame: PalmFrame, flat: Window, knuckles: Window | None, typed_length_m: float | None
) -> tuple[HandFit, Motion]:
    rows = np.flatnonzero(flat.holds(frame.seconds) & frame.known[:, 1:].any(axis=1))
    if len(rows) < FEWEST_FLAT:
        raise CalibrationError(
            f"the corners of the patch were seen in only {len(rows)} samples of the flat hand ({flat.start_s:.1f} to "
            f"{flat.end_s:.1f} s), at least {FEWEST_FLAT} are needed; hold the back of the hand towards the cameras"
        )
    rows = _thinned(rows, MOST_FLAT)
    start = Chosen(rows, np.ones(len(rows), dtype=np.bool_), frame.known[rows])
    fitted = _refitted(frame, start, np.zeros(COUNT), typed_length_m)
    window = knuckles
    for limit_m in _STRAIGHT_M:
        if knuckles is None:
            everything = np.arange(len(frame.seconds))
            deficit = frame.tips(fitted.x, everything).deficit[:, 1:]
            window = straight_stretch(frame.seconds, deficit, limit_m, flat)
        chosen = _with_knuckles(frame, start, window, _straight(frame, fitted.x, limit_m))
        fitted = _refitted(frame, chosen, fitted.x, typed_length_m)
    mostly = _share(frame, start, window, _straight(frame, fitted.x, _MOSTLY_STRAIGHT_M)) >= STRAIGHT_SHARE
    complied = _complied(frame, chosen, fitted.x) & mostly
    if complied.sum() < FEWEST_COMPLYING:
        complied[:] = False
    if not complied.all():
        use = chosen.use & (chosen.flat[:, None] | complied)
        chosen = Chosen(chosen.rows, chosen.flat, use)
        fitted = _refitted(frame, chosen, _restart(fitted, complied), typed_length_m)
    chosen = _without_outliers(frame, chosen, fitted.x)
    fitted = _refitted(frame, chosen, fitted.x, typed_length_m)
    _require_reachable(frame, fitted.x)
    flexion = frame.tips(fitted.x, chosen.rows).flexion
    arcs = {
        finger: _arc(flexion[chosen.use[:, place], place]) if complied[place] else 0.0
        for place, finger in enumerate(FINGERS)
    }
    has_knuckles = window is not None and any(arcs[finger] > 0.0 for finger in FINGERS[1:])
    return fitted, Motion(flat, window if has_knuckles else None, len(chosen.rows), arcs)


def _restart(fitted: HandFit, complied: BoolArray) -> FloatArray:
    """Return where to start again: nowhere near a fit that took bent fingers for straight ones."""
    return fitted.x if complied[1:].any() else np.zeros(COUNT)


def _refitted(frame: PalmFrame, chosen: Chosen, x: FloatArray, typed_length_m: float | None) -> HandFit:
    return fit(StraightFingers(frame, chosen, x), frame.parameters, x, typed_length_m)


def _thinned(rows: IntArray, most: int) -> IntArray:
    return rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).round().astype(np.intp)]


def _straight(frame: PalmFrame, x: FloatArray, limit_m: float) -> BoolArray:
    """Return (N, 5) which of the four fingers are seen near to straight; the thumb is not asked."""
    deficit = frame.tips(x, np.arange(len(frame.seconds))).deficit
    straight: BoolArray = np.asarray(np.abs(np.where(frame.known, deficit, np.inf)) < limit_m)
    straight[:, 0] = False
    return straight


def _with_knuckles(frame: PalmFrame, start: Chosen, window: Window | None, straight: BoolArray) -> Chosen:
    """Return the flat samples and those of a window in which fingers are straight that mostly are so in it."""
    if window is None:
        return start
    inside = _inside(frame, start, window)
    usable = straight & (_share(frame, start, window, straight) >= STRAIGHT_SHARE)
    rows = _thinned(np.flatnonzero(inside & usable.any(axis=1)), MOST_BENT)
    if len(rows) == 0:
        return start
    use = usable[rows]
    return Chosen(
        np.concatenate([start.rows, rows]),
        np.concatenate([start.flat, np.zeros(len(rows), dtype=np.bool_)]),
        np.concatenate([start.use, use]),
    )


def _inside(frame: PalmFrame, start: Chosen, window: Window) -> BoolArray:
    """Return (N,) which samples lie in a window, without the flat ones."""
    inside = window.holds(frame.seconds)
    inside[start.rows[0] : start.rows[-1] + 1] = False
    return inside


def _share(frame: PalmFrame, start: Chosen, window: Window | None, straight: BoolArray) -> FloatArray:
    """Return in which share (5,) of the samples of a window that show a finger it is straight."""
    if window is None:
        return np.zeros(5)
    inside = _inside(frame, start, window)[:, None]
    share: FloatArray = (straight & inside).sum(axis=0) / np.maximum((frame.known & inside).sum(axis=0), 1)
    return share


def _arc(flexion: FloatArray) -> float:
    return float(np.ptp(np.percentile(flexion, (3.0, 97.0)))) if len(flexion) else 0.0


def _complied(frame: PalmFrame, chosen: Chosen, x: FloatArray) -> BoolArray:
    """Return (5,) which fingers were bent far enough at the knuckle and kept straight meanwhile."""
    tips = frame.tips(x, chosen.rows)
    complied = np.zeros(5, dtype=np.bool_)
    for place in range(1, 5):
        use = chosen.use[:, place]
        flexion, deficit = tips.flexion[use, place], tips.deficit[use, place]
        if _arc(flexion) < SMALLEST_ARC_RAD:
            continue
        bins = np.floor(flexion / _BIN_RAD)
        medians = [np.median(deficit[bins == one]) for one in np.unique(bins) if (bins == one).sum() >= 4]
        complied[place] = float(np.sqrt(np.mean(np.square(medians)))) < MAX_ARC_MISS_M
    return complied


def _without_outliers(frame: PalmFrame, chosen: Chosen, x: FloatArray) -> Chosen:
    sigma_m = StraightFingers(frame, chosen, x).sigma_m
    far = np.abs(np.nan_to_num(frame.tips(x, chosen.rows).deficit)) > _OUTLIER_SIGMAS * sigma_m
    return Chosen(chosen.rows, chosen.flat, chosen.use & ~far)


def _viewpoint(rig: Rig) -> FloatArray:
    """Return the middle of the cameras (3,), metres, rig frame."""
    places: FloatArray = np.array([np.array(camera.T_rig_camera)[:3, 3] for camera in rig.cameras.values()])
    middle: FloatArray = places.mean(axis=0)
    return middle


def _require_flat(flat: Window, samples: HandSamples) -> None:
    seen = np.isfinite(reaches(samples)[:, 1:]).sum(axis=0) if len(samples) else np.zeros(4, dtype=np.intp)
    if (seen < FEWEST_FLAT).any():
        poor = FINGERS[1 + int(np.argmin(seen))]
        raise CalibrationError(
            f"flat phase {flat.start_s:.1f} to {flat.end_s:.1f} s: the {poor} finger is seen in {int(seen.min())} "
            f"samples, at least {FEWEST_FLAT} are needed; give the right seconds with --flat START-END, or record again"
        )


def _require_order(samples: HandSamples, viewpoint: FloatArray, parameters: HandParameters) -> None:
    """Refuse a flat hand whose fingertips do not follow one another across the palm."""
    middle = np.nanmedian(samples.tips[:, 1:], axis=(0, 1))
    base = np.median(samples.base, axis=0)
    across = np.cross(viewpoint - base, base - middle)
    across *= (1.0 if parameters.side == "right" else -1.0) / np.linalg.norm(across)
    place = np.nanmedian((samples.tips[:, 1:] - base[None, None]) @ across, axis=0)
    order = [FINGERS[1 + k] for k in np.argsort(place)]
    if order == list(FINGERS[1:]) or (np.diff(place) > -_ORDER_GAP_M).all():
        return
    names = ", ".join(parameters.caps[finger] for finger in order)
    if order == list(reversed(FINGERS[1:])):
        remedy = f"is it the {parameters.side} hand, and does its back face the cameras?"
    else:
        remedy = "two paints are swapped: bind them to the right joints under [markers] in rig.toml"
    raise CalibrationError(f"across the flat hand the fingertips come in the order {names}; {remedy}")


def _require_reachable(frame: PalmFrame, x: FloatArray) -> None:
    """Refuse a hand too short for what the rest of the recording shows: then it was not flat when it should be."""
    deficit = frame.tips(x, np.arange(len(frame.seconds))).deficit[:, 1:]
    share = np.nanmean(np.where(np.isnan(deficit), np.nan, deficit < -_BEYOND_M), axis=0)
    worst = int(np.argmax(share))
    if share[worst] > _BEYOND_SHARE:
        raise CalibrationError(
            f"the {FINGERS[1 + worst]} finger reaches more than {1e3 * _BEYOND_M:.0f} mm beyond its length in "
            f"{100 * share[worst]:.0f} % of the samples (at most {100 * _BEYOND_SHARE:.0f} %): it was not straight "
            "when the hand should have been flat, or the palm was not seen well; record again with 3 s of the flat "
            "hand, or say when it was flat with --flat START-END"
        )


def _require_human(hand: HandFile) -> None:
    low, high = HUMAN_LENGTH_M
    if not low <= hand.length_m <= high:
        raise CalibrationError(
            f"the hand comes out {1e3 * hand.length_m:.0f} mm long, human hands are {1e3 * low:.0f} to "
            f"{1e3 * high:.0f} mm; check the scale of cameras.json (square size of the board, distance of the cameras) "
            "and which marker is bound to which joint"
        )
    narrow, wide = WIDTH_OVER_LENGTH
    ratio = (hand.width_m or 0.0) / hand.length_m
    if not narrow <= ratio <= wide:
        raise CalibrationError(
            f"the hand comes out {ratio:.2f} times as wide as long, human hands are {narrow:g} to {wide:g}; let the "
            "cameras see the corners of the patch on its back, and check which marker is bound to which joint"
        )
