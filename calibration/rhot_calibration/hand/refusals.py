"""What a hand's samples may not lack and what a calibrated hand may not be: the reasons to refuse it.

Every function raises a `CalibrationError` that says what is wrong and what to do.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.anatomy.skeleton import FINGERS
from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.rig import HandFile
from rhot.rig.calibration import WIDTH_OVER_LENGTH
from rhot_calibration.hand.fit.parameters import HUMAN_LENGTH_M, HandParameters
from rhot_calibration.hand.fit.residuals import PalmFrame
from rhot_calibration.hand.samples.phases import FEWEST_FLAT, Window, reaches
from rhot_calibration.hand.samples.samples import FEWEST_SAMPLES, HandSamples

_SEEN_SHARE: Final = 0.10
"""Each fingertip has to be seen in this share of the samples. Chosen on simulated hands."""
_BEYOND_M: Final = 0.010
_BEYOND_SHARE: Final = 0.10
"""A finger that is further than this from its knuckle in more than this share of the samples was bent when the hand
should have been flat. Chosen on simulated hands."""
_ORDER_GAP_M: Final = 0.012
"""Spread fingertips come so near to crossing, seen a little from the side; swapped paints are 15 mm or more off."""


def refuse_unseen_tips(samples: HandSamples, parameters: HandParameters) -> None:
    """Refuse samples in which a fingertip is hardly ever seen."""
    share = np.isfinite(samples.tips).all(axis=2).mean(axis=0)
    least = max(_SEEN_SHARE, FEWEST_SAMPLES / 2 / len(samples))
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


def refuse_unseen_fingers(flat: Window, samples: HandSamples) -> None:
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
    if order == list(FINGERS[1:]) or (np.diff(place) > -_ORDER_GAP_M).all():
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
