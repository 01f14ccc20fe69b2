"""An adult's hand in numbers: bones, rest directions, flesh and limits, scaled by the hand's length.

Bone lengths are the means of Buryanov & Kotiuk, "Proportions of Hand Segments", Int. J. Morphol. 28(3), 2010, tables
1–3 (metacarpals, phalanges, soft tissue beyond the distal phalanx), which were taken from end to end of each bone on
radiographs. A joint turns about a centre inside the head of its nearer bone, a head's radius before its end
(`HEAD_MM`), so a joint lies nearer to the wrist than the gap between two bones. The wrist joint lies 28 mm behind the
base of the middle metacarpal, which makes that hand 184.9 mm long from the wrist crease to the tip of the middle
finger; every length scales with it. Where the metacarpals stand and how the fingers spread at rest is a choice that
matches a flat relaxed hand; that of the little finger puts its knuckle as far from the wrist as Buchholz, Armstrong &
Goldstein, "Anthropometric data for describing the kinematics of the human hand", Ergonomics 35(3), 1992, measured it
(0.414 hand lengths; the other three agree with them to 3 mm).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import rotation_x, rotation_y, rotation_z
from rhot.types import Vector3

REFERENCE_LENGTH_M: Final = 0.18491
"""Wrist joint to the end of the middle finger of the hand that the following millimetres describe."""

HEAD_MM: Final = {
    "thumb": (0.0, 6.5, 4.0),
    "index": (7.0, 4.0, 3.0),
    "middle": (7.0, 4.0, 3.0),
    "ring": (6.5, 4.0, 3.0),
    "little": (6.0, 3.5, 2.5),
}
"""Radius of the heads that carry each finger's moving bones. Metacarpals: half of what heads are wide, 13 to 17 mm;
their surface has one centre (Unsworth & Alexander, "Dimensions of the metacarpo-phalangeal joint", Eng. Med. 8, 1979);
middle and last joints: half of the depth of such a condyle, our own estimate. The thumb's saddle joint has one axis in
each of its two bones, so its centre is the gap between them."""
_METACARPAL_END_TO_END_MM: Final = {"index": 68.12, "middle": 64.60, "ring": 58.00, "little": 53.69}
_BONES_END_TO_END_MM: Final = {
    "thumb": (46.22, 31.57, 21.67 + 5.67),
    "index": (39.78, 22.38, 15.82 + 3.84),
    "middle": (44.63, 26.33, 17.40 + 3.95),
    "ring": (41.37, 25.65, 17.30 + 3.95),
    "little": (32.74, 18.11, 15.96 + 3.73),
}
METACARPAL_MM: Final = {finger: length - HEAD_MM[finger][0] for finger, length in _METACARPAL_END_TO_END_MM.items()}
"""Base of each metacarpal to the centre of its knuckle."""
BONES_MM: Final = {
    finger: (
        a + HEAD_MM[finger][0] - HEAD_MM[finger][1],
        b + HEAD_MM[finger][1] - HEAD_MM[finger][2],
        c + HEAD_MM[finger][2],
    )
    for finger, (a, b, c) in _BONES_END_TO_END_MM.items()
}
"""Moving bones from the knuckle outwards, centre to centre; the last with its soft tissue, up to the very tip."""
CARPAL_MM: Final = {
    "thumb": (-20.0, -11.0, -14.0),
    "index": (-11.0, 3.0, -25.0),
    "middle": (0.0, 4.0, -28.0),
    "ring": (9.5, 3.0, -26.0),
    "little": (17.0, 0.0, -26.0),
}
"""Wrist joint to the base of each metacarpal, wrist frame of a right hand. Metacarpals lie above the wrist's centre,
because the back of a flat hand is straight: skin is some 17 mm above the centre of the wrist and 13 above the
knuckles' (`RADII_MM`). Our own estimates, no published figures: the 17 mm (half of a wrist's depth, and tendons), and
the index metacarpal's base, 3.5 mm nearer to the wrist so that its knuckle lies level with the middle finger's."""
METACARPAL_YAW_DEG: Final = {"index": 9.0, "middle": 0.0, "ring": -9.0, "little": -17.0}
"""Fan of the metacarpals, positive towards the thumb."""
METACARPAL_DROP_DEG: Final = {"index": 1.0, "middle": 0.0, "ring": 1.5, "little": 3.0}
"""Arch of the knuckles: how far each metacarpal points towards the palm."""
REST_DEG: Final = {
    "thumb": (42.0, 18.0, 75.0),
    "index": (5.0, 0.0, 5.0),
    "middle": (0.0, 0.0, 0.0),
    "ring": (-5.0, 0.0, -5.0),
    "little": (-12.0, 0.0, -12.0),
}
"""Rest frame F = Ry(yaw) · Rx(−drop) · Rz(roll): spread towards the thumb, drop towards the palm, roll about the
finger's own axis (positive turns the back of the finger towards the thumb's side), so that bent fingers converge."""
RADII_MM: Final = {
    "thumb": (15.0, 12.0, 10.5, 9.0),
    "index": (14.0, 11.5, 9.5, 8.2, 7.2),
    "middle": (14.0, 11.5, 9.5, 8.4, 7.4),
    "ring": (13.0, 11.0, 9.0, 8.0, 7.0),
    "little": (12.0, 10.0, 8.0, 7.2, 6.3),
}
"""Flesh around the joints of each chain, from the palm outwards."""
PALM_RADIUS_MM: Final = 14.0
WRIST_RADIUS_MM: Final = 22.0

_MOST_ABDUCTION_DEG: Final = 15.0
"""Either way from where the finger goes on straight from its metacarpal: abduction of a knuckle is the angle between
the two bones (Norkin & White, Measurement of Joint Motion). Cobos et al. 2008 have 15° for index, ring and little
finger, but 3° for the middle one, which has a muscle on either side that moves it as far as its neighbours (dorsal
interossei; American Academy of Orthopaedic Surgeons, Joint Motion, 1965: 20° for all four). That it is seldom far aside
is for the prior of the hand to say."""


def _finger_limits_deg(finger: str) -> tuple[tuple[float, float], ...]:
    straight = METACARPAL_YAW_DEG[finger] - REST_DEG[finger][0]
    abduction = (straight - _MOST_ABDUCTION_DEG, straight + _MOST_ABDUCTION_DEG)
    return ((0.0, 90.0), abduction, (0.0, 110.0), (0.0, 90.0))


ANGLE_LIMITS_DEG: Final = {
    "thumb": ((-25.0, 45.0), (-30.0, 40.0), (0.0, 60.0), (0.0, 85.0)),
    **{finger: _finger_limits_deg(finger) for finger in METACARPAL_YAW_DEG},
}
"""Lowest and highest flexion and abduction of the knuckle and flexion of the two hinges (Cobos et al. 2008)."""
COUPLING: Final = {"thumb": 1.0, "index": 2.0 / 3.0, "middle": 2.0 / 3.0, "ring": 2.0 / 3.0, "little": 2.0 / 3.0}
"""Last hinge over middle hinge: DIP ≈ ⅔ PIP (Rijpkema & Girard 1991); for the thumb both bend alike."""

KNUCKLES_OF_WIDTH: Final = 0.653
"""Of the width across the knuckles so much lies between the centres of the index and the little finger's: 0.251 and
0.402 of it on either side of the middle metacarpal (Buchholz, Armstrong & Goldstein 1992); the rest is flesh."""
SPREAD_LIMITS: Final = (0.5, 2.0)
"""The knuckles may stand this many times as far apart as the proportions have them."""


class HandMeasures(Protocol):
    """What is known of a person's hand; `rhot.rig.HandFile` is one. What is absent follows from the length."""

    @property
    def length_m(self) -> float:
        """From the wrist crease to the tip of the middle finger."""
        ...

    @property
    def width_m(self) -> float | None:
        """Across the knuckles of the four fingers, flesh included."""
        ...

    @property
    def bones_m(self) -> Mapping[str, float]:
        """Length of the bone from its parent to a joint, metres, by the joint's OpenXR name."""
        ...

    @property
    def radii_m(self) -> Mapping[str, float]:
        """Radius of the flesh around a joint, metres."""
        ...

    @property
    def marker_offsets_m(self) -> Mapping[str, Vector3]:
        """Offset from the joint to a marker's painted centre, metres, in the joint's frame, by marker."""
        ...


@dataclass(frozen=True, slots=True)
class RestGeometry:
    """The bones of a hand with all angles zero, and the ranges of its angles; see `rhot.anatomy.hand` for frames.

    With the default length of 189 mm the knuckles of a right hand stand, in millimetres of the wrist frame, at index
    (−21, 2, −87), middle (0, 4, −87), ring (18, 2, −79), little (32, −3, −73), and the thumb's carpometacarpal joint
    at (−20, −11, −14).

    Attributes:
        metacarpals: (5, 3) metres, wrist frame: each finger's first joint (the thumb's is its first moving one).
        knuckles: (5, 3) metres, wrist frame: each finger's two-axis joint (MCP; thumb: carpometacarpal).
        frames: (5, 3, 3) rest frames F_f in the wrist frame.
        metacarpal_frames: (5, 3, 3) axes of the metacarpal joints in the wrist frame (thumb: its rest frame).
        bones: (5, 3) metres: lengths of the moving bones from the knuckle outwards, the last up to the tip joint.
        palm: (3,) metres, wrist frame: the palm joint, the middle of the middle metacarpal.
        radii: (26,) metres: flesh around each joint.
        angle_min, angle_max: (5, 4) radians, limits of the angles.
        coupling: (5,) last hinge = coupling · middle hinge, in a hand at ease.
    """

    metacarpals: FloatArray
    knuckles: FloatArray
    frames: FloatArray
    metacarpal_frames: FloatArray
    bones: FloatArray
    palm: FloatArray
    radii: FloatArray
    angle_min: FloatArray
    angle_max: FloatArray
    coupling: FloatArray


def rest_geometry(hand: HandMeasures) -> RestGeometry:
    """Return the rest geometry of a right hand; lengths in `hand.bones_m` replace the proportional ones.

    A length given for a metacarpal joint stretches the carpal bone before it, one for a proximal joint the
    metacarpal, one for `palm` the way from the wrist to the palm joint. A width fans the metacarpals of the four
    fingers wider or narrower and keeps their lengths.

    Raises:
        CalibrationError: width and bones contradict one another.
    """
    scale = hand.length_m / REFERENCE_LENGTH_M / 1000.0
    given = hand.bones_m
    radii = _radii(hand, scale)
    spread = 1.0 if hand.width_m is None else _spread(hand, hand.width_m)
    metacarpals, knuckles, frames, metacarpal_frames, bones = [], [], [], [], []
    for finger in FINGERS:
        chain = CHAINS[finger]
        rest = _frame(*REST_DEG[finger])
        if finger == "thumb":
            base = knuckle = _stretched(np.array(CARPAL_MM[finger]) * scale, given.get(chain[0]))
            metacarpal_frame = rest
        else:
            base, knuckle, metacarpal_frame = _metacarpal(finger, given, scale, spread)
        tip_radius = radii[JOINTS.index(chain[-1])]
        lengths = np.array(BONES_MM[finger]) * scale - (0.0, 0.0, tip_radius)
        moving = chain[-3:]
        metacarpals.append(base)
        knuckles.append(knuckle)
        frames.append(rest)
        metacarpal_frames.append(metacarpal_frame)
        bones.append([given.get(joint, float(length)) for joint, length in zip(moving, lengths, strict=True)])
    middle = FINGERS.index("middle")
    limits = np.radians([ANGLE_LIMITS_DEG[finger] for finger in FINGERS])
    return RestGeometry(
        metacarpals=np.array(metacarpals),
        knuckles=np.array(knuckles),
        frames=np.array(frames),
        metacarpal_frames=np.array(metacarpal_frames),
        bones=np.array(bones),
        palm=_stretched((metacarpals[middle] + knuckles[middle]) / 2.0, given.get("palm")),
        radii=radii,
        angle_min=limits[..., 0],
        angle_max=limits[..., 1],
        coupling=np.array([COUPLING[finger] for finger in FINGERS]),
    )


def width_across_knuckles(hand: HandMeasures, spread: float = 1.0) -> float:
    """Return the width, metres, of a hand with these lengths, whatever `hand.width_m` says.

    Args:
        hand: lengths.
        spread: factor on the knuckles' distances across the hand that its proportions give.
    """
    scale = hand.length_m / REFERENCE_LENGTH_M / 1000.0
    index, little = (_metacarpal(finger, hand.bones_m, scale, 1.0)[1] for finger in ("index", "little"))
    return float(spread * (little[0] - index[0]) / KNUCKLES_OF_WIDTH)


def _spread(hand: HandMeasures, width_m: float) -> float:
    """Return the factor on the knuckles' distances that gives the hand this width."""
    spread = width_m / width_across_knuckles(hand)
    low, high = SPREAD_LIMITS
    if not low <= spread <= high:
        raise CalibrationError(
            f"hand.json: width_m {width_m:g} puts the knuckles {spread:.2f} times as far apart as its lengths do, must "
            f"be {low:g} to {high:g}; measure again with `rhot calibrate hand`"
        )
    return spread


def _metacarpal(
    finger: str, given: Mapping[str, float], scale: float, spread: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return base (3,) and head (3,), metres, wrist frame, and frame (3, 3) of the metacarpal of one of four fingers.

    `spread` multiplies every distance across the hand (x): of the bases, and of the heads by turning the bones.
    """
    chain = CHAINS[finger]
    base = _stretched(np.array(CARPAL_MM[finger]) * scale, given.get(chain[0])) * (spread, 1.0, 1.0)
    yaw_deg = METACARPAL_YAW_DEG[finger]
    if spread != 1.0:
        yaw_deg = float(np.degrees(np.arcsin(spread * np.sin(np.radians(yaw_deg)))))
    frame = _frame(yaw_deg, METACARPAL_DROP_DEG[finger], REST_DEG[finger][2])
    head: FloatArray = base - given.get(chain[1], METACARPAL_MM[finger] * scale) * frame[:, 2]
    return base, head, frame


def _frame(yaw_deg: float, drop_deg: float, roll_deg: float) -> FloatArray:
    """Return F = Ry(yaw) · Rx(−drop) · Rz(roll), (3, 3)."""
    yaw, drop, roll = np.radians([yaw_deg, drop_deg, roll_deg])
    frame: FloatArray = rotation_y(yaw) @ rotation_x(-drop) @ rotation_z(roll)
    return frame


def _stretched(vector: FloatArray, length_m: float | None) -> FloatArray:
    if length_m is None:
        return vector
    stretched: FloatArray = vector * (length_m / float(np.linalg.norm(vector)))
    return stretched


def _radii(hand: HandMeasures, scale: float) -> FloatArray:
    radii = {"palm": PALM_RADIUS_MM * scale, "wrist": WRIST_RADIUS_MM * scale}
    for finger in FINGERS:
        radii |= {joint: radius * scale for joint, radius in zip(CHAINS[finger], RADII_MM[finger], strict=True)}
    return np.array([hand.radii_m.get(joint, radii[joint]) for joint in JOINTS])
