"""Parameters of the paired methods, each with unit and provenance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

from pydantic import Field

from rhot.rig import FusionConfig
from rhot.rig.file_model import FileModel, NotNegative, Positive
from rhot_bench.thesis.options import checked


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


class PairedOptions(FileModel):
    """`[fusion.options]` of `triangulate` and `disparity`.

    Attributes:
        depth_law: k and z of depth[cm] = k · disparity[px]^z, for `disparity`.
        one_euro: where the 1-euro filter is, each marker its own: `points` (in space), or `pixels`, as in the thesis:
            on each camera's view, and then on the depth alone.
        min_cutoff_hz, beta, derivative_cutoff_hz: of that filter in space; β in hertz per metre a second.
        pixel_min_cutoff_hz, pixel_beta: of the one on views; β in hertz per pixel a second. Tuned as its authors say:
            1 Hz at rest, then β up until a hand at 0.4 m/s no longer lags (at 30 Hz, 0.5 px and 60 Hz, 0.15 px alike).
        max_speed_m_s: fastest believable marker; published points move no faster, in depth by as much less as depth is
            noisier.
        extrapolation: longest time, as a share of a frame period, that one camera's track is carried on to meet a
            newer frame of another; 0 waits for the next frame instead (later, less noisy).
    """

    depth_law: tuple[Positive, Annotated[float, Field(ge=-10.0, le=10.0)]] = (4543.3, -1.035)
    one_euro: Literal["points", "pixels"] = "points"
    min_cutoff_hz: Positive = 4.0
    beta: NotNegative = 20.0
    derivative_cutoff_hz: Positive = 8.0
    pixel_min_cutoff_hz: Positive = 1.0
    pixel_beta: NotNegative = 0.5
    max_speed_m_s: Annotated[float, Field(gt=0.0, le=100.0)] = 4.0
    extrapolation: Annotated[float, Field(ge=0.0, le=1.0)] = 0.6


@dataclass(frozen=True, slots=True)
class PairedConfig:
    """`[fusion]` as the paired methods read it.

    Attributes:
        fusion: what all methods have in common.
        options: their own.
    """

    fusion: FusionConfig
    options: PairedOptions

    @classmethod
    def of(cls, config: FusionConfig) -> PairedConfig:
        """Return the configuration with its options checked.

        Raises:
            ConfigError: an option is unknown or out of bounds.
        """
        options: Mapping[str, Any] = config.options
        return cls(config, checked(PairedOptions, options, "fusion"))
