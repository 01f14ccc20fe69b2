"""From states to what is published: a pure function of them."""

from __future__ import annotations

import numpy as np

from rhot_fusion.filter.systematic import Systematic
from rhot_fusion.filter.tracks import state_of
from rhot_fusion.views.sightings import BoolArray, FloatArray, Outcome


def outcome_of(
    t_s: float, position: FloatArray, covariance: FloatArray, seen: BoolArray, systematic: Systematic
) -> Outcome:
    """Return markers at positions (M, 3), NaN = absent, with covariances (M, 3, 3), seen by cameras (C, M)."""
    covariance = covariance + systematic.covariance(position)
    views = seen.sum(axis=0)
    measured = (views >= 2) & np.isfinite(position[:, 0])
    variance = covariance.reshape(-1, 9)[:, ::4].sum(axis=1)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    counts = views.tolist()
    return Outcome(
        t_s,
        position.tolist(),
        sigma.tolist(),
        counts,
        measured.tolist(),
        seen.tolist(),
        covariance,
        [state_of(count) for count in counts],
    )
