"""From the point sets of a recording to `hand.json`: finds the phases and the straight fingers, and fits the hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

import numpy as np

from rhot.anatomy.hand import patch_outline
from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.errors import CalibrationError
from rhot.messages import PointSet, Side
from rhot.rig import HandFile, Rig
from rhot_calibration.hand.fit.fit import HandFit, fit
from rhot_calibration.hand.fit.palm_rotations import palm_rotations
from rhot_calibration.hand.fit.parameters import COUNT, HandParameters
from rhot_calibration.hand.fit.quality import Motion, hand_quality
from rhot_calibration.hand.fit.residuals import Chosen, FlatDistances, PalmFrame, StraightFingers
from rhot_calibration.hand.refusals import (
    refuse_bent_flat_hand,
    refuse_inhuman,
    refuse_unseen_fingers,
    refuse_unseen_tips,
    refuse_wrong_order,
)
from rhot_calibration.hand.samples.phases import (
    FEWEST_FLAT,
    FIND_PHASES,
    STRAIGHT_SHARE,
    Phases,
    Window,
    find_flat,
    straight_stretch,
)
from rhot_calibration.hand.samples.samples import read_samples

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
    refuse_unseen_tips(samples, parameters)
    viewpoint = _viewpoint(rig)
    report(f"looking for the flat hand in {len(samples)} samples")
    flat = phases.flat or find_flat(samples, steady=samples.has_corners)
    flat_rows = np.flatnonzero(flat.holds(samples.seconds))
    refuse_unseen_fingers(flat, samples.at(flat_rows))
    refuse_wrong_order(samples.at(flat_rows), viewpoint, parameters)
    report("fitting the hand")
    if samples.has_corners:
        outline = patch_outline(rig.config.markers[parameters.base])
        frame = PalmFrame(parameters, samples, palm_rotations(samples, outline, viewpoint), viewpoint)
        fitted, motion = _from_straight_fingers(frame, flat, phases.knuckles, typed_length_m)
    else:
        evidence = FlatDistances(parameters, samples.at(flat_rows))
        fitted = fit(evidence, parameters, np.zeros(COUNT), typed_length_m)
        motion = Motion(flat=flat, knuckles=None, frames=len(flat_rows))
    hand = parameters.hand(fitted.x)
    refuse_inhuman(hand)
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
    refuse_bent_flat_hand(frame, fitted.x)
    flexion = frame.tips(fitted.x, chosen.rows).flexion
    arcs = {
        finger: _arc(flexion[chosen.use[:, index], index]) if complied[index] else 0.0
        for index, finger in enumerate(FINGERS)
    }
    has_knuckles = window is not None and any(arcs[finger] > 0.0 for finger in FINGERS[1:])
    return fitted, Motion(flat, window if has_knuckles else None, len(chosen.rows), arcs)


def _restart(fitted: HandFit, complied: BoolArray) -> FloatArray:
    """Return where to start again: nowhere near a fit that took bent fingers for straight ones."""
    return fitted.x if complied[1:].any() else np.zeros(COUNT)


def _refitted(frame: PalmFrame, chosen: Chosen, x: FloatArray, typed_length_m: float | None) -> HandFit:
    return fit(StraightFingers(frame, chosen, x), frame.parameters, x, typed_length_m)


def _thinned(rows: IndexArray, most: int) -> IndexArray:
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
    for index in range(1, 5):
        use = chosen.use[:, index]
        flexion, deficit = tips.flexion[use, index], tips.deficit[use, index]
        if _arc(flexion) < SMALLEST_ARC_RAD:
            continue
        bins = np.floor(flexion / _BIN_RAD)
        medians = [np.median(deficit[bins == one]) for one in np.unique(bins) if (bins == one).sum() >= 4]
        complied[index] = float(np.sqrt(np.mean(np.square(medians)))) < MAX_ARC_MISS_M
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
