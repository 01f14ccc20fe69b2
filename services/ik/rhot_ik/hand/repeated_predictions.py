"""Weights of points that are partly predicted: repeating a prediction adds little information.

Where no camera, or only one, sees a marker, fusion extrapolates: a `predicted` point continues the last motion, and the
depth of a `one_view` point follows from the rest of the hand. A single view is also biased across its ray: a marker
that the other camera does not see is usually half hidden, and the centre of the visible half is not that of the marker.
These errors are part of the stated covariance, but they are correlated from sample to sample. The filter assumes
independent errors, so the k-th consecutive sample is weighted by 1/k: its covariance is multiplied by k. The
information then grows with the logarithm of the number of samples, whatever the frame rate. A point that two cameras
see is never treated as a prediction, whatever its state and however poor the views.
"""

from __future__ import annotations

from rhot.geometry.covariances import stated_covariance
from rhot.messages import Point


class RepeatedPredictions:
    """Counts, for each marker, the consecutive samples that are the same kind of prediction."""

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
