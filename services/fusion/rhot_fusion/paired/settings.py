"""Parameters of the paired methods, each with unit and provenance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class PairedSettings:
    """Gates and limits of the paired methods; chosen on simulated hands unless stated otherwise.

    Attributes:
        maneuver_m_s: standard deviation of the predicted velocity; times the interval, it widens the gates.
        maneuver_limit_m: upper bound of that uncertainty, because hands reverse their motion.
        view_gate_sigmas: gate of a view's distance from the prediction of its marker.
        view_gate_slack_px: added to that gate for errors of the prediction that its covariance does not contain.
        point_gate_sigmas: gate of a point's distance from its prediction along each axis of its noise.
        full_weight_sigmas: the innovation of a point is clipped at this (Huber).
        least_noise_px: lower bound of a coordinate's noise.
        depth_sigma_m: standard deviation of a depth just after its last measurement.
        damping_s: time constant with which the velocity of an unseen marker decays.
        quiet_sigma_m: noise up to which the 1-euro filter uses the full speed of an axis.
        elongated: ratio of depth noise to lateral noise above which a point may fail the gate in depth alone.
        slowest_cutoff: lower bound of the factor on the 1-euro filter's cut-off at rest, along noisy axes.
        open_cutoff: factor on the cut-off of an axis that is not smoothed; passes 0.99999 of a step.
        slowest_share: lower bound of a marker's permitted speed along noisy axes, as a share of the highest.
        fewest_siblings: number of measured markers of a hand required to move an unseen one with them.
        agreement_s: longest time between two points that confirm each other.
        confirmations: number of consecutive agreeing points required to start a marker, or to move it outside its gate.
    """

    maneuver_m_s: float = 0.8
    maneuver_limit_m: float = 0.1
    view_gate_sigmas: float = 5.0
    view_gate_slack_px: float = 4.0
    point_gate_sigmas: float = 4.0
    full_weight_sigmas: float = 2.0
    least_noise_px: float = 0.05
    depth_sigma_m: float = 0.01
    damping_s: float = 0.1
    quiet_sigma_m: float = 0.002
    elongated: float = 3.0
    slowest_cutoff: float = 0.5
    open_cutoff: float = 1e6
    slowest_share: float = 0.2
    fewest_siblings: int = 2
    agreement_s: float = 0.2
    confirmations: int = 3


PAIRED: Final = PairedSettings()
