"""What touches must stand: enough of them to tell where the object is, and no face mistaken for another."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.messages import BoxShape, CylinderShape, FacedShape
from rhot_calibration.objects.touch.faces import faces_of, gaps
from rhot_calibration.objects.touch.fit import OffsetFit, Touch, fit_offset

# The faces of a shape that a finger can touch, and how far a fingertip stands off each.
#
# Axes are the object's own, see `rhot.messages.tracked`. A box has six faces: top and bottom at +y and −y, right and
# left at +x and −x, front and back at +z and −z. A cylinder has two ends, top and bottom at +z and −z, and a side all
# round. A sphere is touched anywhere.


LARGEST_OFF_M = 0.006
"""A touch further from its face contradicts: eight standard deviations of a fingertip, and less than half the edge of
anything that a hand takes hold of."""
_LARGEST_ROTATION_SD_RAD = np.radians(1.5)
_LARGEST_POSITION_SD_M = 0.0025
_OTHER_SOLUTION_COST = 12.0
"""A second offset whose cost is this little above the best one's cannot be excluded: 3.5 standard deviations."""
_MOST_LEFT_OUT = 0.2
_LEAST_ON_FACE = 2
"""So many touches of a face must remain when others of it are left out."""


@dataclass(frozen=True, slots=True)
class Judged:
    """An offset that stands.

    Attributes:
        fit: of the touches that were kept; its residuals are theirs alone.
        kept: numbers of these touches, from 0.
    """

    fit: OffsetFit
    kept: tuple[int, ...]


def least_touches(shape: FacedShape) -> int:
    """Return how many touches determine the offset when they are well placed, one more than its unknowns."""
    if isinstance(shape, BoxShape):
        return 7
    return 6 if isinstance(shape, CylinderShape) else 5


def missing_faces(shape: FacedShape, faces: Sequence[str]) -> str:
    """Return in words which faces must be touched, too; empty where those touched suffice."""
    there = set(faces)
    if isinstance(shape, BoxShape):
        pairs = (("top", "bottom"), ("front", "back"), ("left", "right"))
        return ", ".join(f"{a} or {b}" for a, b in pairs if not there & {a, b})
    if isinstance(shape, CylinderShape):
        words = [] if there & {"top", "bottom"} else ["top or bottom"]
        return ", ".join(words if "side" in there else [*words, "side (all round)"])
    return ""


def judged(shape: FacedShape, touches: Sequence[Touch], R_before: FloatArray) -> Judged:
    """Return the offset that touches tell.

    Args:
        shape: of the object.
        touches: all that were taken.
        R_before: (3, 3) R_device_object so far, for what the shape leaves free.

    Raises:
        CalibrationError: too few touches or faces, touches that contradict one another, or more than one offset that
            would explain them; names the face and says what to do.
    """
    missing = missing_faces(shape, [touch.face for touch in touches])
    if missing:
        raise CalibrationError(f"the touches cannot tell where the {shape.kind} is: touch {missing}, too")
    if len(touches) < least_touches(shape):
        raise CalibrationError(
            f"{len(touches)} touches are too few, {least_touches(shape)} are the least for a {shape.kind} and four a "
            "face are good; touch each face near its corners"
        )
    fits, kept = _without_contradictions(shape, touches, R_before)
    fit = fits[0]
    if len(fits) > 1 and fits[1].cost - fit.cost < _OTHER_SOLUTION_COST:
        raise CalibrationError(
            f"the touches fit the {shape.kind} in more than one way; touch more places, far from one another, also "
            f"{_least_touched(shape, touches)}"
        )
    if fit.rotation_sd_rad > _LARGEST_ROTATION_SD_RAD or fit.position_sd_m > _LARGEST_POSITION_SD_M:
        raise CalibrationError(
            f"the touches leave the offset open to ± {1e3 * fit.position_sd_m:.1f} mm and ± "
            f"{np.degrees(fit.rotation_sd_rad):.1f}°; {1e3 * _LARGEST_POSITION_SD_M:.1f} mm and "
            f"{np.degrees(_LARGEST_ROTATION_SD_RAD):.1f}° are the limits. Touch more places, near the corners, also "
            f"{_least_touched(shape, touches)}"
        )
    return Judged(fit, kept)


def flesh_note(fit: OffsetFit) -> str:
    """Return what a finger that is much thicker or thinner than the hand's model says; empty where it is not."""
    flesh_noted_m = 0.0025
    if abs(fit.flesh_m) < flesh_noted_m:
        return ""
    much = f"{1e3 * abs(fit.flesh_m):.1f} mm {'more' if fit.flesh_m > 0 else 'less'}"
    return f"the finger keeps {much} distance than its radius says: do the sizes in rig.toml and hand.json hold?"


def face_at(shape: FacedShape, fit: OffsetFit, touch: Touch) -> str:
    """Return the face on which a touch lies by an offset; empty where it lies on none."""
    q = fit.in_object(touch.tip_device)[None]
    off: dict[str, float] = {}
    for face in faces_of(shape):
        found = gaps(shape, face, q)
        off[face] = max(abs(float(found.distance_m[0]) - touch.radius_m - fit.flesh_m), float(found.beside_m.max()))
    nearest = min(off, key=lambda face: off[face])
    return nearest if off[nearest] < LARGEST_OFF_M else ""


def _without_contradictions(
    shape: FacedShape, touches: Sequence[Touch], R_before: FloatArray
) -> tuple[list[OffsetFit], tuple[int, ...]]:
    """Return the fits and the numbers of their touches after leaving out the few that contradict."""
    kept = list(range(len(touches)))
    first = fits = fit_offset(shape, touches, R_before)
    while np.abs(fits[0].residual_m).max() > LARGEST_OFF_M:
        worst = kept[int(np.argmax(np.abs(fits[0].residual_m)))]
        kept.remove(worst)
        counts = Counter(touches[place].face for place in kept)
        too_many = len(touches) - len(kept) > max(1, int(_MOST_LEFT_OUT * len(touches)))
        if too_many or counts[touches[worst].face] < _LEAST_ON_FACE or len(kept) < least_touches(shape):
            raise CalibrationError(_contradiction(shape, touches, first[0], R_before))
        fits = fit_offset(shape, [touches[place] for place in kept], R_before)
    return fits, tuple(kept)


def _contradiction(shape: FacedShape, touches: Sequence[Touch], fit: OffsetFit, R_before: FloatArray) -> str:
    """Return which face was mistaken, as far as the others can tell."""
    best: tuple[float, str] | None = None
    for face in dict.fromkeys(touch.face for touch in touches):
        rest = [touch for touch in touches if touch.face != face]
        if len(rest) < least_touches(shape) or missing_faces(shape, [touch.face for touch in rest]):
            continue
        without = fit_offset(shape, rest, R_before)[0]
        places = Counter(face_at(shape, without, touch) for touch in touches if touch.face == face)
        where, count = places.most_common(1)[0]
        if np.abs(without.residual_m).max() < LARGEST_OFF_M and (best is None or without.cost < best[0]):
            on = f"{count} of {places.total()} lie on {where}" if where else "they lie on no face"
            best = (without.cost, f"the touches of {face} contradict all others: {on}. Touch {face} again")
    if best is not None:
        return best[1]
    place = int(np.argmax(np.abs(fit.residual_m)))
    return (
        f"the touches contradict one another by up to {1e3 * float(np.abs(fit.residual_m).max()):.0f} mm, "
        f"{1e3 * LARGEST_OFF_M:.0f} mm is the limit; the worst is touch {place + 1}, {touches[place].face}. Touch the "
        f"faces that are named, hold the object still meanwhile, and measure the size in rig.toml again"
    )


def _least_touched(shape: FacedShape, touches: Sequence[Touch]) -> str:
    counts = Counter(touch.face for touch in touches)
    return min(faces_of(shape), key=lambda face: counts[face])
