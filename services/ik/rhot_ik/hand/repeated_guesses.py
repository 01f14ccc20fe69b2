"""How much a point that is partly a guess tells of a hand: less each time that the same guess is sent again.

Where no camera, or only one, sees a marker, fusion goes on with what it knew: a `predicted` point is where the last
movement would have led, and the depth of a `one_view` point follows from the rest of the hand. Both err, and they err
alike sample after sample, for it is one guess that is sent again and again. The filter takes the errors of samples for
independent, so the k-th sample of a guess counts as 1/k of one: its covariance is k times as large. That grows with
the logarithm of their number, whatever the frame rate is.

What one camera sees is a guess across its ray, too: the other camera sees nothing of the marker because it is half
hidden, and the middle of the half that is seen lies off the marker's. `HALF_HIDDEN_M` is by how much.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.geometry.covariances import stated_covariance
from rhot.messages import Point, PointState

HALF_HIDDEN_M: Final = 0.0035
"""Standard deviation, each axis, of the middle of paint that one camera alone sees. Such points are 4.3 to 4.7 mm
(rendered pictures) and 4.5 to 5.4 mm (rigs of `rhot evaluate motion`, develop seeds 0 to 30) off their ray, root mean
square, however long they last."""
_HALF_HIDDEN: Final = HALF_HIDDEN_M**2 * np.eye(3)


class RepeatedGuesses:
    """Knows, of each marker, for how many samples running it has been the same kind of guess."""

    def __init__(self) -> None:
        self._running: dict[str, tuple[PointState, int]] = {}

    def covariance(self, name: str, point: Point) -> tuple[float, ...]:
        """Return the covariance (9,) that a marker's newest point counts with, m², row by row."""
        state, before = self._running.get(name, (point.state, 0))
        times = before + 1 if state == point.state else 1
        self._running[name] = point.state, times
        stated = stated_covariance(point)
        if point.state == "measured":
            return stated
        if point.state == "predicted":
            return tuple(times * value for value in stated)
        C = np.array(stated).reshape(3, 3)
        # C·C over its trace is next to nothing but along the ray.
        along = (times - 1) / max(float(np.trace(C)), 1e-12) * (C @ C)
        return tuple((C + along + times * _HALF_HIDDEN).reshape(9).tolist())
