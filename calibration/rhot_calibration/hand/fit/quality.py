"""Which lengths of a calibrated hand were measured, which follow from proportions, and how surely each is known."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from rhot.anatomy.skeleton import CHAINS, FINGERS
from rhot.arrays import FloatArray
from rhot.rig import HandFile
from rhot_calibration.hand.fit.fit import HandFit, fit
from rhot_calibration.hand.fit.parameters import BONE_SD, COUNT, HandParameters
from rhot_calibration.hand.samples.phases import Window

MEASURED_SHARE: Final = 0.6
"""A length counts as measured when its uncertainty is below this share of what is known without a recording …"""
MEASURED_SD_M, ROUGHLY_SD_M = 0.001, 0.002
"""… and below the first of these, so that 95 of 100 are within 2 mm; below the second it is roughly measured."""
_STEP: Final = 1e-5
METACARPAL_JOINTS: Final = tuple(CHAINS[finger][1] for finger in FINGERS[1:])
"""Metacarpals of the four fingers, by the joint at their end."""


@dataclass(frozen=True, slots=True)
class Motion:
    """What a recording showed.

    Attributes:
        flat, knuckles: when the hand was flat, and when straight fingers bent at their knuckles, if ever.
        frames: samples used.
        arcs_rad: finger to how far it bent at its knuckle while straight.
    """

    flat: Window
    knuckles: Window | None
    frames: int
    arcs_rad: dict[str, float] = field(default_factory=dict)


def hand_quality(
    parameters: HandParameters, fitted: HandFit, motion: Motion, typed_length_m: float | None
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
