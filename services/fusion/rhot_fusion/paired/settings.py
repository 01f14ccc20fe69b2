"""Parameters of the paired methods, each with unit and provenance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class PairedSettings:
    """Gates and limits of the paired methods; where nothing else is said, chosen on simulated hands.

    Attributes:
        maneuver_m_s: standard deviation of what the predicted velocity may miss; times the interval it widens gates.
        maneuver_limit_m: hands turn back: however long nothing was seen, a marker is not expected further than this
            from its prediction.
        view_gate_sigmas: a view further than this from its marker's prediction does not belong to it.
        view_gate_slack_px: added to that gate: a prediction is never as good as its figures.
        point_gate_sigmas: a point further than this from its prediction, along any axis of its noise, does not count.
        full_weight_sigmas: beyond this a point pulls no harder (Huber).
        smallest_noise_px: noise of a coordinate is never taken to be less.
        depth_sigma_m: what a depth may be wrong by the moment after it was last measured.
        damping_s: a marker out of sight loses its speed with this time constant.
        quiet_sigma_m: noise below which the 1-euro filter trusts the speed of an axis in full.
        elongated: depth noise counts as such above this multiple of the lateral noise.
        slowest_cutoff: share of the 1-euro filter's cut-off at rest that is left along the noisiest axis.
        open_cutoff: factor on the cut-off of an axis that is not to be smoothed; lets pass 0.99999 of a step.
        slowest_glide: share of the fastest believable speed that a marker may have along its noisiest axis.
        fewest_siblings: so many markers of a hand must move for an unseen one to be carried along.
        agreement_s: points further apart in time do not confirm each other.
        confirmations: points that must agree one after another before a marker starts, or goes where it was not
            expected.
    """

    maneuver_m_s: float = 0.8
    maneuver_limit_m: float = 0.1
    view_gate_sigmas: float = 5.0
    view_gate_slack_px: float = 4.0
    point_gate_sigmas: float = 4.0
    full_weight_sigmas: float = 2.0
    smallest_noise_px: float = 0.05
    depth_sigma_m: float = 0.01
    damping_s: float = 0.1
    quiet_sigma_m: float = 0.002
    elongated: float = 3.0
    slowest_cutoff: float = 0.5
    open_cutoff: float = 1e6
    slowest_glide: float = 0.2
    fewest_siblings: int = 2
    agreement_s: float = 0.2
    confirmations: int = 3


PAIRED: Final = PairedSettings()
