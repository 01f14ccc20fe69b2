"""What is unknown of a person's hand, what is believed of it before anything is measured, and the hand it makes.

The unknowns are a vector of deviations from an average hand: zero is the belief's mean, `PRIOR_SD` its standard
deviation. Lengths deviate by a factor (natural logarithm), angles in radians, offsets in metres. Some of them are not
kept in `hand.json` and only keep the others honest: where a knuckle stands beside its proportional place, how crookedly
the patch sits, how far from straight a "straight" finger is.

The standard deviations are our estimates: adults' hands are 189 ± 12 mm long, each bone differs from the proportions
of its hand by about 5 %, a painted patch sits within 5 mm and 4° of where it belongs, paint ends within 1 mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.anatomy.hand import HandModel
from rhot.anatomy.hand_proportions import (
    BONES_MM,
    CARPAL_MM,
    METACARPAL_MM,
    RADII_MM,
    REFERENCE_LENGTH_M,
    width_across_knuckles,
)
from rhot.anatomy.skeleton import CHAINS, FINGERS
from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.messages import Side
from rhot.rig import HandFile, MarkerConfig
from rhot.rig.file_model import Vector3

LENGTH: Final = 0
SPREAD: Final = 1
BONES: Final = slice(2, 7)
"""The moving bones of each finger, by one factor: markers on the tips do not tell them apart."""
METACARPALS: Final = slice(7, 10)
"""Index, ring, little; the middle one is what the length of the hand leaves."""
KNUCKLES: Final = slice(10, 25)
"""Where each finger's knuckle is beside the place that lengths and proportions give, wrist frame."""
BASE: Final = slice(25, 28)
TILT: Final = slice(28, 31)
CAPS: Final = slice(31, 36)
SLACK: Final = slice(36, 41)
"""By how much the straight finger is shorter than its bones."""
SLACK_BENT: Final = slice(41, 46)
"""By how much more, for every 60° at the knuckle."""
ABDUCTION: Final = slice(46, 51)
"""Mean abduction while the knuckles bend."""
COUNT: Final = 51

MEAN_LENGTH_M: Final = 0.189
LENGTH_SD_M: Final = 0.012
TYPED_SD_M: Final = 0.002
HUMAN_LENGTH_M: Final = (0.14, 0.24)
"""Wrist crease to middle tip, from small teenagers to the largest adults; an estimate with room on both sides."""
MEAN_SPREAD: Final = 1.01
"""Estimate: hands are about 0.43 times as wide as long, a little wider than the proportional knuckles make them."""
BONE_SD: Final = 0.05
"""Of a bone's length about the proportional one of a hand of the same length."""
SLACK_M: Final = np.array([0.0006, 0.00015, 0.00015, 0.00015, 0.00015])
"""Mean of `SLACK`: hinges bent by b, two thirds of it and so on shorten a finger by about 0.004·(b/8°)² of its length,
here with 5° (root mean square); the thumb's by 10°."""

_LENGTHS = [np.array(BONES_MM[finger]) for finger in FINGERS]
PRIOR_SD: Final = np.zeros(COUNT)
PRIOR_SD[LENGTH] = LENGTH_SD_M / MEAN_LENGTH_M
PRIOR_SD[SPREAD] = 0.07
PRIOR_SD[BONES] = [BONE_SD * np.linalg.norm(lengths) / lengths.sum() for lengths in _LENGTHS]
PRIOR_SD[METACARPALS] = BONE_SD
PRIOR_SD[KNUCKLES] = [0.003, 0.003, 0.003, *([0.0015, 0.0015, 0.0005] * 4)]
PRIOR_SD[BASE] = 0.005, 0.003, 0.005
PRIOR_SD[TILT] = np.radians(4.0)
PRIOR_SD[CAPS] = 0.0005
PRIOR_SD[SLACK] = 0.0006, 0.0002, 0.0002, 0.0002, 0.0002
PRIOR_SD[SLACK_BENT] = 0.0003
PRIOR_SD[ABDUCTION] = np.radians([8.0, 6.0, 3.0, 6.0, 6.0])
PRIOR_SD.setflags(write=False)

LENGTHS: Final = slice(0, 10)
"""The parameters that make the model; all others only move things about it."""


@dataclass(frozen=True, slots=True)
class Shape:
    """What the fit needs of a hand with straight fingers, wrist frame, metres.

    Attributes:
        knuckles: (5, 3).
        frames: (5, 3, 3) rest frames of the fingers.
        straight: (5,) knuckle to tip marker.
        base: (3,) the base marker.
        length: of the hand.
        middle_metacarpal: logarithm of the middle metacarpal over the one that the proportions give.
    """

    knuckles: FloatArray
    frames: FloatArray
    straight: FloatArray
    base: FloatArray
    length: float
    middle_metacarpal: float


class HandParameters:
    """Turns parameter vectors (COUNT,) into hands that wear a rig's markers.

    Args:
        side: of the hand.
        markers: all markers of the rig.

    Attributes:
        caps: finger to the name of the marker on its tip, for the fingers that have one.
        base: name of the marker on wrist or palm.

    Raises:
        CalibrationError: nothing marks the palm.
    """

    def __init__(self, side: Side, markers: Mapping[str, MarkerConfig]) -> None:
        self.side = side
        self.markers = markers
        worn = {marker.joint: name for name, marker in markers.items() if marker.hand == side}
        self.caps = {finger: worn[f"{finger}_tip"] for finger in FINGERS if f"{finger}_tip" in worn}
        base = worn.get("wrist", worn.get("palm"))
        if base is None:
            raise CalibrationError(
                f"rig.toml gives the {side} hand no marker on wrist or palm: nothing tells where its palm is; "
                "add one under [markers]"
            )
        self.base = base
        self._shapes: dict[bytes, Shape] = {}

    def shape(self, parameters: FloatArray) -> Shape:
        """Return the hand as the fit needs it."""
        key = parameters[LENGTHS].tobytes()
        if key not in self._shapes:
            # A derivative moves one parameter at a time: most of them leave the lengths as they are.
            kept_shapes = 64
            if len(self._shapes) >= kept_shapes:
                self._shapes.clear()
            self._shapes[key] = self._shape(np.where(np.arange(COUNT) < LENGTHS.stop, parameters, 0.0))
        found = self._shapes[key]
        shift = parameters[KNUCKLES].reshape(5, 3)
        return replace(
            found,
            knuckles=found.knuckles + shift,
            straight=found.straight - parameters[CAPS],
            base=found.base + parameters[BASE],
        )

    def _shape(self, x: FloatArray) -> Shape:
        hand = self.hand(x)
        model = HandModel.from_file(hand, self.side)
        behind = [model.marker_offset(name, self.markers[name])[2] for name in map(self.caps.__getitem__, FINGERS)]
        joint = model.palm if self.markers[self.base].joint == "palm" else np.zeros(3)
        return Shape(
            knuckles=model.knuckles,
            frames=model.frames,
            straight=model.bones.sum(axis=1) - np.array(behind),
            base=joint + model.marker_offset(self.base, self.markers[self.base]),
            length=hand.length_m,
            middle_metacarpal=_middle_metacarpal_deviation(hand),
        )

    def hand(self, parameters: FloatArray) -> HandFile:
        """Return the hand, without date and quality."""
        largest_deviation = 5.0
        most = largest_deviation * PRIOR_SD
        x = np.clip(parameters, -most, most)
        length_m = MEAN_LENGTH_M * float(np.exp(x[LENGTH]))
        scale = length_m / REFERENCE_LENGTH_M / 1000.0
        bones: dict[str, float] = {}
        for finger, ratio in zip(FINGERS, np.exp(x[BONES]), strict=True):
            flesh = np.array([0.0, 0.0, RADII_MM[finger][-1]])
            lengths = (np.array(BONES_MM[finger]) - flesh) * scale * ratio
            bones |= {joint: float(length) for joint, length in zip(CHAINS[finger][-3:], lengths, strict=True)}
        for finger, ratio in zip(("index", "ring", "little"), np.exp(x[METACARPALS]), strict=True):
            bones[CHAINS[finger][1]] = METACARPAL_MM[finger] * scale * float(ratio)
        shortest_bone_m = 0.004
        bones["middle_proximal"] = max(_middle_metacarpal(length_m, bones), shortest_bone_m)
        hand = HandFile(length_m=length_m, bones_m=bones)
        return hand.model_copy(
            update={
                "width_m": width_across_knuckles(hand, MEAN_SPREAD * float(np.exp(x[SPREAD]))),
                "marker_offsets_m": self._offsets(HandModel.from_file(hand, self.side), x),
            }
        )

    def _offsets(self, model: HandModel, x: FloatArray) -> dict[str, Vector3]:
        moved = {name: np.array([0.0, 0.0, x[CAPS][FINGERS.index(finger)]]) for finger, name in self.caps.items()}
        moved[self.base] = x[BASE]
        offsets: dict[str, Vector3] = {}
        for name, shift in moved.items():
            across, up, along = (model.marker_offset(name, self.markers[name]) + shift).tolist()
            offsets[name] = (across, up, along)
        return offsets


def _middle_metacarpal(length_m: float, bones: Mapping[str, float]) -> float:
    """Return what wrist, fingers' bones and fingertip leave of the length of the hand for the middle metacarpal."""
    scale = length_m / REFERENCE_LENGTH_M / 1000.0
    ends = (-CARPAL_MM["middle"][2] + RADII_MM["middle"][-1]) * scale
    return length_m - ends - sum(bones[joint] for joint in CHAINS["middle"][-3:])


def _middle_metacarpal_deviation(hand: HandFile) -> float:
    """Return the logarithm of the middle metacarpal over the one that the proportions give."""
    proportional = METACARPAL_MM["middle"] * hand.length_m / REFERENCE_LENGTH_M / 1000.0
    return float(np.log(hand.bones_m["middle_proximal"] / proportional))
