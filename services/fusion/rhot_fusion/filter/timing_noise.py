"""How noisy views are, and how far apart in time two cameras' views truly are, learnt from pairs of views.

Clocks are mapped with an error, and a rig that only stamps arrivals errs by up to a frame. From one moment to the next
the offset between two cameras' views of a marker changes little: depth moves it by a tenth of what the marker itself
moves. What it jumps by beyond that is noise, of pixels (σ) and of time (σ_t). For a marker that moves at w through the
picture, the mean square of a coordinate's jump is

    e² = 4 σ² + σ_t² w²

(four views are in it, and two errors of time in one direction of two); the line is fitted by least squares over the
last seconds, with a prior of little noise and no time error.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_MEMORY: Final = 0.998
"""Kept of what was learnt at each pair of frames: about ten seconds."""
_LARGEST_S: Final = 0.03
_CLEAR: Final = 2.0
"""A jump this many times what is expected counts as just that: a glitch is neither kind of noise."""
_PRIOR_SPEED: Final = 0.5
"""Normalised units per second; speeds below it teach little of time."""
_PRIOR_COUNT: Final = 300.0
"""Weight of the prior, in views. Cameras are believed to be well timed until it is plain that they are not: to take the
changing shape of what is seen of a marker for an error of time costs a third of the accuracy."""


class TimingNoise:
    """The noise of views and of the time between them beyond what their stamps say.

    Attributes:
        sigma: standard deviation of a coordinate of a view at rest, normalised units.
        sigma_s: standard deviation of the time between two cameras' views, seconds.
    """

    def __init__(self, sigma: float) -> None:
        """Begin with the noise of a view at rest."""
        self.sigma = sigma
        self.sigma_s = 0.0
        # Sums of 1, w², w⁴, e² and e² w².
        self._sums = [_PRIOR_COUNT, 0.0, 0.0, _PRIOR_COUNT * 4.0 * sigma**2, 0.0]

    def learn(self, jump2: FloatArray, speed2: FloatArray) -> None:
        """Take squared jumps of a coordinate (N,) and squared speeds (N,), normalised units (per second)."""
        if not len(jump2):
            return
        expected = 4.0 * self.sigma**2 + max(self.sigma_s, 0.1 * _LARGEST_S) ** 2 * speed2
        jump2 = np.minimum(jump2, _CLEAR**2 * expected)
        new = (len(jump2), speed2.sum(), speed2 @ speed2, jump2.sum(), jump2 @ speed2)
        self._sums = [_MEMORY * old + float(one) for old, one in zip(self._sums, new, strict=True)]
        count, w2, w4, e2, e2w2 = self._sums
        w4 += _PRIOR_SPEED**4
        slope = (count * e2w2 - e2 * w2) / max(count * w4 - w2 * w2, 1e-300)
        slope = min(max(slope, 0.0), _LARGEST_S**2)
        self.sigma_s = slope**0.5
        self.sigma = 0.5 * max((e2 - slope * w2) / count, 1e-12) ** 0.5
