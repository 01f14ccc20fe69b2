"""From the point sets of a recording to `hand.json`: finds the phases and the straight fingers, and fits the hand."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from rhot.anatomy.hand import patch_outline
from rhot.anatomy.hand_proportions import width_across_knuckles
from rhot.anatomy.skeleton import CHAINS, FINGERS
from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot.errors import CalibrationError
from rhot.messages import PointSet, Side
from rhot.rig import HandFile, Rig
from rhot.rig.calibration import WIDTH_OVER_LENGTH
from rhot_calibration.hand.fit.parameters import BONE_SD, COUNT, HUMAN_LENGTH_M, HandParameters
from rhot_calibration.hand.fit.residuals import (
    Chosen,
    FlatDistances,
    HandFit,
    PalmFrame,
    StraightFingers,
    fit,
    palm_rotations,
)
from rhot_calibration.hand.samples import (
    FEWEST_FLAT,
    FEWEST_SAMPLES,
    FIND_PHASES,
    STRAIGHT_SHARE,
    HandSamples,
    Phases,
    PoseWindow,
    find_flat,
    reaches,
    read_samples,
    straight_stretch,
)

# A hand from two typed-in measures.


def typed_hand(length_m: float, width_m: float | None) -> HandFile:
    """Return the hand of average proportions with this length and width, without a date.

    Args:
        length_m: from the wrist crease to the tip of the middle finger.
        width_m: across the knuckles of the four fingers; none = as the length has it.

    Raises:
        CalibrationError: no human hand has these measures.
    """
    low, high = HUMAN_LENGTH_M
    if not low <= length_m <= high:
        raise CalibrationError(
            f"--length-mm {1e3 * length_m:g}: human hands are {1e3 * low:.0f} to {1e3 * high:.0f} mm long from the "
            "wrist crease to the tip of the middle finger; measure in millimetres, palm up, fingers straight"
        )
    narrow, wide = (share * length_m for share in WIDTH_OVER_LENGTH)
    if width_m is not None and not narrow <= width_m <= wide:
        raise CalibrationError(
            f"--width-mm {1e3 * width_m:g}: a hand of {1e3 * length_m:g} mm is {1e3 * narrow:.0f} to {1e3 * wide:.0f} "
            "mm wide; measure across the knuckles of the four fingers, without the thumb"
        )
    hand = HandFile(length_m=length_m, width_m=width_m)
    shown = width_across_knuckles(hand) if width_m is None else width_m
    quality: dict[str, Any] = {
        "source": "typed in",
        "length": {"mm": round(1e3 * length_m, 1), "source": "typed in"},
        "width": {"mm": round(1e3 * shown, 1), "source": "from proportions" if width_m is None else "typed in"},
        "bones": "from proportions",
    }
    return hand.model_copy(update={"quality": quality})


# What a hand's samples may not lack and what a calibrated hand may not be: the reasons to refuse it.
#
# Every function raises a `CalibrationError` that says what is wrong and what to do.

_BEYOND_M: Final = 0.010
_BEYOND_SHARE: Final = 0.10
"""A finger that is further than this from its knuckle in more than this share of the samples was bent when the hand
should have been flat. Chosen on simulated hands."""


def refuse_unseen_tips(samples: HandSamples, parameters: HandParameters) -> None:
    """Refuse samples in which a fingertip is hardly ever seen."""
    share = np.isfinite(samples.tips).all(axis=2).mean(axis=0)
    # Each fingertip has to be seen in this share of the samples. Chosen on simulated hands.
    least = max(0.10, FEWEST_SAMPLES / 2 / len(samples))
    poor = [index for index in range(len(FINGERS)) if share[index] < least]
    if not poor:
        return
    unpainted = [FINGERS[place] for place in poor if FINGERS[place] not in parameters.caps]
    if unpainted:
        raise CalibrationError(
            f"rig.toml binds no marker to the {', '.join(unpainted)} finger of the {parameters.side} hand; "
            "add one under [markers] for this calibration"
        )
    names = ", ".join(f"{parameters.caps[FINGERS[place]]} ({100 * share[place]:.0f} %)" for place in poor)
    raise CalibrationError(
        f"seen in too few samples: {names}, at least {100 * least:.0f} % are needed; keep every painted fingertip in "
        "view of two cameras, and check its colour with `rhot calibrate colors`"
    )


def refuse_unseen_fingers(flat: PoseWindow, samples: HandSamples) -> None:
    """Refuse a flat phase in which one of the four fingers is hardly ever seen."""
    seen = np.isfinite(reaches(samples)[:, 1:]).sum(axis=0) if len(samples) else np.zeros(4, dtype=np.intp)
    if (seen < FEWEST_FLAT).any():
        poor = FINGERS[1 + int(np.argmin(seen))]
        raise CalibrationError(
            f"flat phase {flat.start_s:.1f} to {flat.end_s:.1f} s: the {poor} finger is seen in {int(seen.min())} "
            f"samples, at least {FEWEST_FLAT} are needed; give the right seconds with --flat START-END, or record again"
        )


def refuse_wrong_order(samples: HandSamples, viewpoint: FloatArray, parameters: HandParameters) -> None:
    """Refuse a flat hand whose fingertips do not follow one another across the palm."""
    middle = np.nanmedian(samples.tips[:, 1:], axis=(0, 1))
    base = np.median(samples.base, axis=0)
    across = np.cross(viewpoint - base, base - middle)
    across *= (1.0 if parameters.side == "right" else -1.0) / np.linalg.norm(across)
    place = np.nanmedian((samples.tips[:, 1:] - base[None, None]) @ across, axis=0)
    order = [FINGERS[1 + k] for k in np.argsort(place)]
    # Spread fingertips come so near to crossing, seen a little from the side; swapped paints are 15 mm or more
    # off.
    if order == list(FINGERS[1:]) or (np.diff(place) > -0.012).all():
        return
    names = ", ".join(parameters.caps[finger] for finger in order)
    if order == list(reversed(FINGERS[1:])):
        remedy = f"is it the {parameters.side} hand, and does its back face the cameras?"
    else:
        remedy = "two paints are swapped: bind them to the right joints under [markers] in rig.toml"
    raise CalibrationError(f"across the flat hand the fingertips come in the order {names}; {remedy}")


def refuse_bent_flat_hand(frame: PalmFrame, x: FloatArray) -> None:
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


def refuse_inhuman(hand: HandFile) -> None:
    """Refuse a hand of a length or width that no human hand has."""
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


# Which lengths of a calibrated hand were measured, which follow from proportions, and how surely each is known.

MEASURED_SHARE: Final = 0.6
"""A length counts as measured when its uncertainty is below this share of what is known without a recording …"""
MEASURED_SD_M, ROUGHLY_SD_M = 0.001, 0.002
"""… and below the first of these, so that 95 of 100 are within 2 mm; below the second it is roughly measured."""
_STEP: Final = 1e-5
METACARPAL_JOINTS: Final = tuple(CHAINS[finger][1] for finger in FINGERS[1:])
"""Metacarpals of the four fingers, by the joint at their end."""


@dataclass(frozen=True, slots=True)
class FingerMotion:
    """What a recording showed.

    Attributes:
        flat, knuckles: when the hand was flat, and when straight fingers bent at their knuckles, if ever.
        frames: samples used.
        arcs_rad: finger to how far it bent at its knuckle while straight.
    """

    flat: PoseWindow
    knuckles: PoseWindow | None
    frames: int
    arcs_rad: dict[str, float] = field(default_factory=dict)


def hand_quality(
    parameters: HandParameters, fitted: HandFit, motion: FingerMotion, typed_length_m: float | None
) -> dict[str, Any]:
    """Return the figures of a fitted hand for `hand.json`: each length in mm, its standard deviation and source."""
    unmeasured = fit(lambda _: np.zeros(0), parameters, np.zeros(COUNT), None)
    values, sd = _spread(parameters, fitted)
    prior = _spread(parameters, unmeasured)[1]
    figures = [_figure(*row) for row in zip(values, sd, prior, strict=True)]
    reach, fingers, metacarpals, (length, width) = figures[:5], figures[5:10], figures[10:14], figures[14:]
    if typed_length_m is not None:
        length["source"] = "typed in"
    hand = parameters.hand(fitted.x)
    bones = dict(zip(METACARPAL_JOINTS, metacarpals, strict=True))
    for finger, finger_sd in zip(FINGERS, sd[5:10], strict=True):
        bones |= _split(hand, finger, float(finger_sd))
    return {
        "source": "recording",
        "length": length,
        "width": width,
        "reach": dict(zip(FINGERS, reach, strict=True)),
        "fingers": dict(zip(FINGERS, fingers, strict=True)),
        "bones": bones,
        "frames": motion.frames,
        "flat_s": [round(motion.flat.start_s, 2), round(motion.flat.end_s, 2)],
        "knuckles_s": [round(motion.knuckles.start_s, 2), round(motion.knuckles.end_s, 2)] if motion.knuckles else None,
        "arc_deg": {finger: round(float(np.degrees(arc)), 1) for finger, arc in motion.arcs_rad.items()},
    }


def _lengths(parameters: HandParameters, x: FloatArray) -> FloatArray:
    """Return reaches (5), fingers (5), metacarpals (4), length and width, metres."""
    hand, shape = parameters.hand(x), parameters.shape(x)
    reach = np.linalg.norm(shape.knuckles - shape.straight[:, None] * shape.frames[..., 2] - shape.base, axis=1)
    fingers = [sum(hand.bones_m[joint] for joint in CHAINS[finger][-3:]) for finger in FINGERS]
    metacarpals = [hand.bones_m[joint] for joint in METACARPAL_JOINTS]
    return np.array([*reach, *fingers, *metacarpals, hand.length_m, hand.width_m or np.nan])


def _spread(parameters: HandParameters, fitted: HandFit) -> tuple[FloatArray, FloatArray]:
    """Return the lengths and their standard deviations, metres."""
    values = _lengths(parameters, fitted.x)
    J = np.empty((len(values), COUNT))
    for column in range(COUNT):
        moved = fitted.x.copy()
        moved[column] += _STEP
        J[:, column] = (_lengths(parameters, moved) - values) / _STEP
    return values, np.sqrt(np.einsum("ij,jk,ik->i", J, fitted.covariance, J))


def _split(hand: HandFile, finger: str, finger_sd_m: float) -> dict[str, dict[str, Any]]:
    """Return the figures of a finger's three bones: independent about their proportions, but for their sum."""
    joints = CHAINS[finger][-3:]
    lengths = np.array([hand.bones_m[joint] for joint in joints])
    share = lengths / lengths.sum()
    own = (BONE_SD * lengths) ** 2 * (1.0 - lengths**2 / (lengths**2).sum())
    sd = np.sqrt(own + (share * finger_sd_m) ** 2)
    return {
        joint: {**_figure(length, one, one), "source": "from proportions"}
        for joint, length, one in zip(joints, lengths, sd, strict=True)
    }


def _figure(value_m: float, sd_m: float, prior_sd_m: float) -> dict[str, Any]:
    source = "from proportions"
    if sd_m <= min(MEASURED_SHARE * prior_sd_m, ROUGHLY_SD_M):
        source = "measured" if sd_m <= MEASURED_SD_M else "roughly measured"
    return {"mm": round(1e3 * float(value_m), 2), "sd_mm": round(1e3 * float(sd_m), 2), "source": source}


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
        motion = FingerMotion(flat=flat, knuckles=None, frames=len(flat_rows))
    hand = parameters.hand(fitted.x)
    refuse_inhuman(hand)
    quality = hand_quality(parameters, fitted, motion, typed_length_m)
    quality |= {"samples": len(samples), "palm_from_corners": samples.has_corners}
    return hand.model_copy(update={"quality": quality})


def _from_straight_fingers(
    frame: PalmFrame, flat: PoseWindow, knuckles: PoseWindow | None, typed_length_m: float | None
) -> tuple[HandFit, FingerMotion]:
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
    # … and most of the time in the end.
    mostly = _share(frame, start, window, _straight(frame, fitted.x, 0.004)) >= STRAIGHT_SHARE
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
    return fitted, FingerMotion(flat, window if has_knuckles else None, len(chosen.rows), arcs)


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


def _with_knuckles(frame: PalmFrame, start: Chosen, window: PoseWindow | None, straight: BoolArray) -> Chosen:
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


def _inside(frame: PalmFrame, start: Chosen, window: PoseWindow) -> BoolArray:
    """Return (N,) which samples lie in a window, without the flat ones."""
    inside = window.holds(frame.seconds)
    inside[start.rows[0] : start.rows[-1] + 1] = False
    return inside


def _share(frame: PalmFrame, start: Chosen, window: PoseWindow | None, straight: BoolArray) -> FloatArray:
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
        bin_rad = np.radians(10.0)
        bins = np.floor(flexion / bin_rad)
        medians = [np.median(deficit[bins == one]) for one in np.unique(bins) if (bins == one).sum() >= 4]
        complied[index] = float(np.sqrt(np.mean(np.square(medians)))) < MAX_ARC_MISS_M
    return complied


def _without_outliers(frame: PalmFrame, chosen: Chosen, x: FloatArray) -> Chosen:
    sigma_m = StraightFingers(frame, chosen, x).sigma_m
    outlier_sigmas = 3.5
    far = np.abs(np.nan_to_num(frame.tips(x, chosen.rows).deficit)) > outlier_sigmas * sigma_m
    return Chosen(chosen.rows, chosen.flat, chosen.use & ~far)


def _viewpoint(rig: Rig) -> FloatArray:
    """Return the middle of the cameras (3,), metres, rig frame."""
    places: FloatArray = np.array([np.array(camera.T_rig_camera)[:3, 3] for camera in rig.cameras.values()])
    middle: FloatArray = places.mean(axis=0)
    return middle
