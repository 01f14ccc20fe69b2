"""What somebody whose hand is measured live is told to do, and when."""

from __future__ import annotations

from typing import Final

from rhot_calibration.hand.measure import Phases
from rhot_calibration.hand.phases import Window

_PROMPTS: Final = (
    (0.0, 4.0, "get ready: back of the hand to the cameras, fingers straight, a little spread"),
    (4.0, 7.0, "hold the hand flat and still"),
    (7.0, 9.0, "get ready: bend at the knuckles only, fingers kept straight"),
    (9.0, 19.0, "knuckles: straight fingers down as far as they go and up again, three times"),
    (19.0, 21.0, "get ready: bend everything"),
    (21.0, 27.0, "bend the fingers freely, fist and open"),
)
"""Seconds from and to, and what to do meanwhile."""
LIVE_PHASES: Final = Phases(flat=Window(4.3, 7.0), knuckles=Window(9.0, 19.5))
LIVE_S: Final = _PROMPTS[-1][1]


def prompt_at(passed_s: float) -> tuple[float, str]:
    """Return how long it lasts still, seconds, and what to do, so many seconds after the start."""
    _, end_s, doing = next(one for one in reversed(_PROMPTS) if passed_s >= one[0])
    return end_s - passed_s, doing
