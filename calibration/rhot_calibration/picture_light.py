"""Whether a picture is lit so that colours can be told apart in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import ImageArray

CLIPPED_LEVEL: Final = 250
MAX_CLIPPED: Final = 0.02
"""Share of pixels with a channel at its end; a marker that is clipped has lost its colour."""
MIN_BRIGHT: Final = 70.0
"""Level that the brightest hundredth of a picture reaches; below, noise makes colours uncertain."""
BLACK: Final = 16.0
"""Below this, nothing but noise is in the picture: a lens cap, or a camera that had not started."""


@dataclass(frozen=True, slots=True)
class PictureLight:
    """How a picture is lit.

    Attributes:
        bright: level that its brightest hundredth reaches, 0 to 255.
        clipped: share of its pixels with a channel at its end.
    """

    bright: float
    clipped: float

    @classmethod
    def of(cls, image: ImageArray) -> PictureLight:
        """Measure a picture (H, W, 3)."""
        brightest = image.max(axis=2)
        return cls(float(np.percentile(brightest, 99.0)), float(np.mean(brightest >= CLIPPED_LEVEL)))

    @property
    def problem(self) -> str:
        """What is wrong and what to do about it; empty when nothing is."""
        if self.clipped > MAX_CLIPPED:
            return (
                f"{100 * self.clipped:.0f} % of the picture is overexposed (at most {100 * MAX_CLIPPED:.0f} % are "
                "good): lower the gain, then the exposure"
            )
        if self.bright < MIN_BRIGHT:
            return (
                f"the picture is dark (its brightest parts reach {self.bright:.0f} of 255, {MIN_BRIGHT:.0f} are good): "
                "more light, or raise the gain"
            )
        return ""
