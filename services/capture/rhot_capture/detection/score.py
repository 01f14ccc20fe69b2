"""How surely a detection is right, as a probability: a logistic model fitted to simulated pictures.

Right means: it is that marker, and its centre lies within `RIGHT_PX` of the centre of the paint that nothing hides;
paint beyond the picture's border counts as not hidden, so a marker that the border cuts is rarely right. With the
evidence x (each entry oriented so that more of it never makes a detection less sure, hence w ≥ 0) the score is

    p = 1 / (1 + exp(−(b + w·x))).

Solidity, size, thinness, neighbouring markers and the distance and size against the track were tried beside these
three and got weight 0: they decide which blobs are candidates at all, and say nothing more about those that remain.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

RIGHT_PX: Final = 1.0
"""Chosen: beside one good view it is up to 19 mm of depth, at 85 cm and with 75 mm between the cameras."""

# Made by `python -m rhot_bench.detection.score_fit`, which prints these lines and the reliability on other seeds.
BIAS: Final = 3.081
WEIGHTS: Final = (4.327, 11.682, 5.145)


class Evidence(NamedTuple):
    """What speaks for a detection; each entry is at most 0, more is better.

    Attributes:
        colour: logarithm of how typical the blob's colour is of its marker.
        inside: minus the share of its outline on the picture's border.
        alone: logarithm of its share against a second blob of the same colour.
    """

    colour: float
    inside: float
    alone: float


def probability(evidence: Evidence) -> float:
    """Return the score of a detection, 0 to 1."""
    colour, inside, alone = WEIGHTS
    log_odds = BIAS + colour * evidence.colour + inside * evidence.inside + alone * evidence.alone
    return 1.0 / (1.0 + math.exp(min(30.0, -log_odds)))
