"""A hand from two typed-in measures."""

from __future__ import annotations

from typing import Any

from rhot.anatomy.hand_proportions import width_across_knuckles
from rhot.errors import CalibrationError
from rhot.rig import HandFile
from rhot.rig.calibration import WIDTH_OVER_LENGTH
from rhot_calibration.hand.fit.parameters import HUMAN_LENGTH_M


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
