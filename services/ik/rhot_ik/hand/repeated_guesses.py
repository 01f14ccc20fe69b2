"""How much a point that is partly a guess tells of a hand: less each time that the same guess is sent again.

Where no camera, or only one, sees a marker, fusion goes on with what it knew: a `predicted` point is where the last
movement would have led, and the depth of a `one_view` point follows from the rest of the hand. What one camera sees is
a guess across its ray, too: the other camera sees nothing of the marker because it is half hidden, and the middle of
the half that is seen lies off the marker's. Such errors are stated, but they are alike sample after sample, for it is
one guess that is sent again and again. The filter takes the errors of samples for independent, so the k-th sample of a
guess counts as 1/k of one: its covariance is k times as large. That grows with the logarithm of their number, whatever
the frame rate is. A point that two cameras see is no guess, however badly they do and whatever fusion calls it.
"""

from __future__ import annotations

from rhot.geometry.covariances import stated_covariance
from rhot.messages import Point


class RepeatedGuesses:
    """Knows, of each marker, for how many samples running it has been the same kind of guess."""

    def __init__(self) -> None:
        self._running: dict[str, tuple[int, int]] = {}

    def covariance(self, name: str, point: Point) -> tuple[float, ...]:
        """Return the covariance (9,) that a marker's newest point counts with, m², row by row."""
        views = 2 if point.state == "measured" else min(point.views, 2)
        earlier, before = self._running.get(name, (views, 0))
        times = before + 1 if earlier == views else 1
        self._running[name] = views, times
        stated = stated_covariance(point)
        return stated if views == 2 else tuple(times * value for value in stated)
