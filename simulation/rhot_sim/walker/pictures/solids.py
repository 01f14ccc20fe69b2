"""What the camera sees of the person: trousers and shoes as rounded cones, and the card that carries each marker."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot_sim.walker.person import Person, PersonSample
from rhot_sim.walker.plan import SIDES

CARD_SHARE: Final = 1.3
"""Side of the white card over that of the marker's black square."""
REFERENCE_HEIGHT_M: Final = 1.75
SHOE_M: Final = (
    # Ends (x, y over the floor, z from the ankle) and radii, metres, of a person of the reference height.
    (((0.0, 0.040, 0.032), 0.036), ((0.0, 0.034, -0.060), 0.036)),
    (((0.0, 0.036, -0.040), 0.036), ((0.0, 0.026, -0.130), 0.026)),
    (((0.0, 0.030, -0.110), 0.034), ((0.0, 0.026, -0.165), 0.024)),
)
SHANK_RADII_M: Final = (0.054, 0.038)
THIGH_RADII_M: Final = (0.078, 0.058)
TRUNK_RADII_M: Final = (0.125, 0.120)
HEM_OVER_ANKLE_M: Final = 0.085
"""Trousers end this far over the ankle."""
SHOE, TROUSERS, SHIRT = "shoe", "trousers", "shirt"


@dataclass(frozen=True, slots=True)
class Cone:
    """A cone with round ends, in the picture of one moment.

    Attributes:
        ends: (2, 3) centres of the two balls, metres, rig frame.
        radii: (2,) of these, metres.
        paint: what it is made of.
    """

    ends: FloatArray
    radii: FloatArray
    paint: str


@dataclass(frozen=True, slots=True)
class Limbs:
    """A person's solids at one moment.

    Attributes:
        shoes: side to the cones of the shoe.
        legs: side to trousers, shank before thigh.
        trunk: the upper body.
    """

    shoes: dict[Side, list[Cone]]
    legs: dict[Side, list[Cone]]
    trunk: Cone

    @property
    def cones(self) -> list[Cone]:
        """All of them."""
        return [cone for part in (self.shoes, self.legs) for side in SIDES for cone in part[side]] + [self.trunk]


def limbs_at(person: Person, sample: PersonSample, moment: int) -> Limbs:
    """Return the solids of a person at one of a sample's moments."""
    scale = person.body.height_m / REFERENCE_HEIGHT_M
    shoes: dict[Side, list[Cone]] = {}
    legs: dict[Side, list[Cone]] = {}
    for side in SIDES:
        T, leg, hip = sample.ankles[side][moment], sample.legs[side], sample.hip_joints[side][moment]
        shoes[side] = [_shoe_part(T, ends, scale, person.sole.ankle_height_m) for ends in SHOE_M]
        knee = leg.knee[moment]
        hem = T[:3, 3] + HEM_OVER_ANKLE_M * leg.R_shank[moment, :, 1]
        legs[side] = [
            Cone(np.stack([knee, hem]), np.array(SHANK_RADII_M) * scale, TROUSERS),
            Cone(np.stack([hip, knee]), np.array(THIGH_RADII_M) * scale, TROUSERS),
        ]
    hips, neck = sample.hips[moment, :3, 3], sample.neck[moment]
    # Ends of the trunk between hips and neck, as shares of the way.
    trunk = hips + np.outer((0.12, 0.75), neck - hips)
    return Limbs(shoes, legs, Cone(trunk, np.array(TRUNK_RADII_M) * scale, SHIRT))


def _shoe_part(
    T: FloatArray, part: tuple[tuple[tuple[float, float, float], float], ...], scale: float, ankle_height_m: float
) -> Cone:
    local = scale * np.array([center for center, _ in part])
    radii = scale * np.array([radius for _, radius in part])
    local[:, 1] -= ankle_height_m
    ends = local @ T[:3, :3].T + T[:3, 3]
    # Soles bend: a foot on its ball does not push its toes through the floor.
    ends[:, 1] = np.maximum(ends[:, 1], radii)
    return Cone(ends, radii, SHOE)
