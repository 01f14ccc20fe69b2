"""Probability that a detection is correct: a logistic model fitted to simulated pictures.

Correct means: it is that marker, and its centre is within `RIGHT_PX` of the centre of the unoccluded paint. Paint
beyond the image border counts as unoccluded, so markers clipped by the border are rarely correct. With the evidence x
(more of each entry never decreases the score, hence w ≥ 0) the score is

    p = 1 / (1 + exp(−(b + w·x))).

Solidity, size, thinness, neighbouring markers, and distance and size relative to the track were tried, too, and got
weight 0: they are criteria for candidates, and give no further information about those that remain.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

RIGHT_PX: Final = 1.0
"""Chosen: at 85 cm and with a baseline of 75 mm it causes a depth error of up to 19 mm if the other view is exact."""

# Output of `python -m rhot_bench.score_fit`, which also prints the reliability on other seeds.
BIAS: Final = 3.081
WEIGHTS: Final = (4.327, 11.682, 5.145)


class Evidence(NamedTuple):
    """Features of a detection; each is at most 0, larger is better.

    Attributes:
        colour: logarithm of the colour's likelihood relative to a typical one.
        inside: minus the share of its outline on the image border.
        alone: logarithm of its weight's share of the sum of the two best blobs' weights.
    """

    colour: float
    inside: float
    alone: float


def probability(evidence: Evidence) -> float:
    """Return the score of a detection, 0 to 1."""
    colour, inside, alone = WEIGHTS
    log_odds = BIAS + colour * evidence.colour + inside * evidence.inside + alone * evidence.alone
    return 1.0 / (1.0 + math.exp(min(30.0, -log_odds)))
