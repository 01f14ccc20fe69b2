"""From states to what is published: a pure function of them."""

from __future__ import annotations

import numpy as np

from rhot_fusion.filter.settings import DEFAULT, TrackSettings
from rhot_fusion.filter.systematic import Systematic
from rhot_fusion.filter.tracks import state_of
from rhot_fusion.views.sightings import BoolArray, FloatArray, Outcome


def outcome_of(
    t_s: float,
    position: FloatArray,
    covariance: FloatArray,
    seen: BoolArray,
    systematic: Systematic,
    settings: TrackSettings = DEFAULT.track,
) -> Outcome:
    """Return markers at positions (M, 3), NaN = absent, with covariances (M, 3, 3), seen by cameras (C, M).

    Two cameras that see a marker measure it if its place has become certain by that.
    """
    sharp = np.trace(covariance, axis1=1, axis2=2) <= settings.measured_m**2
    covariance = covariance + systematic.covariance(position)
    views = seen.sum(axis=0)
    measured = (views >= 2) & sharp & np.isfinite(position[:, 0])
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
        [state_of(count, certain) for count, certain in zip(counts, sharp.tolist(), strict=True)],
    )
