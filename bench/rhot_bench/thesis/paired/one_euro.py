"""The 1-euro filter for arrays of points, each with its own time.

Source: Casiez, Roussel, Vogel, "1€ Filter: A Simple Speed-based Low-pass Filter for Noisy Input in Interactive
Systems", CHI 2012, section "The 1€ filter". A first-order low-pass whose cut-off grows with the filtered speed:

    f_c = f_min + β |dx̂/dt|,   α = 1 / (1 + τ / T_e),   τ = 1 / (2 π f_c),   x̂ ← x̂ + α (x − x̂)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Final, Literal

import numpy as np
from pydantic import Field

from rhot.arrays import FloatArray, IndexArray
from rhot.rig import FusionConfig
from rhot.rig.file_model import FileModel, NotNegative, Positive
from rhot_bench.thesis.options import checked

# Parameters of the paired methods, each with unit and provenance.


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


@dataclass(frozen=True, slots=True)
class OneEuroSettings:
    """Parameters of the filter.

    Attributes:
        min_cutoff_hz: f_min, cut-off at rest; lower = less jitter.
        beta: β, hertz per metre per second; higher = less lag in motion.
        derivative_cutoff_hz: cut-off of the speed's low-pass.
    """

    min_cutoff_hz: float
    beta: float
    derivative_cutoff_hz: float


def smoothing_factor(cutoff_hz: FloatArray | float, interval_s: FloatArray) -> FloatArray:
    """Return α (K,) of first-order low-passes for cut-offs and sampling intervals (K,), s; 0 for an interval of 0."""
    angle = 2.0 * np.pi * np.asarray(cutoff_hz, dtype=np.float64) * interval_s
    factor: FloatArray = angle / (1.0 + angle)
    return factor


@dataclass(frozen=True, slots=True)
class Axes:
    """Axes along which K points are filtered.

    Attributes:
        basis: (K, 3, 3) orthonormal, axes as columns.
        beta_scale: (K, 3) multiplies β per axis; below 1 for axes whose speed is mostly noise.
        cutoff_scale: (K, 3) multiplies f_min per axis.
    """

    basis: FloatArray
    beta_scale: FloatArray
    cutoff_scale: FloatArray


class OneEuroFilter:
    """1-euro filters of N points, one per point and axis, updated in any subsets at any times.

    The axes may change with each sample (`Axes`): a point's depth is much noisier than its lateral position, and the
    direction of depth depends on its position. The state is in world axes.

    Attributes:
        value: (N, 3) filtered points; NaN before the first sample.
        speed: (N, 3) filtered derivative, per second.
        t_s: (N,) time of the last sample.
    """

    def __init__(self, count: int, settings: OneEuroSettings) -> None:
        self.settings = settings
        self.value: FloatArray = np.full((count, 3), np.nan)
        self.speed: FloatArray = np.zeros((count, 3))
        self.t_s: FloatArray = np.full(count, -np.inf)
        self._raw: FloatArray = np.full((count, 3), np.nan)

    def start(self, index: IndexArray, value: FloatArray, t_s: float) -> None:
        """Restart points (K,) at values (K, 3), at rest."""
        self.value[index] = value
        self._raw[index] = value
        self.speed[index] = 0.0
        self.t_s[index] = t_s

    def forget(self, index: IndexArray) -> None:
        """Discard the state of points (K,)."""
        self.start(index, np.full((len(index), 3), np.nan), -np.inf)

    def update(
        self,
        index: IndexArray,
        value: FloatArray,
        t_s: float | FloatArray,
        axes: Axes | None = None,
        *,
        advance: FloatArray | float = 0.0,
    ) -> None:
        """Update some points with a sample each; samples not later than the last one are ignored.

        Args:
            index: (K,) which points.
            value: (K, 3) samples.
            t_s: their time, or the time (K, 1) of each.
            axes: axes of the filter and their scales; by default world axes and 1.
            advance: (K, 3) predicted displacement since the last samples. The low-pass then acts on the innovation, so
                that uniform motion does not lag. 0 is the published filter.
        """
        interval = t_s - self.t_s[index][:, None]
        later = interval > 0.0
        # A sample that is not later must not change the state: α(0) = 0.
        step_s = np.where(later, interval, 0.0)
        derivative = (value - self._raw[index]) / np.where(later, interval, np.inf)
        speed = self.speed[index]
        speed += smoothing_factor(self.settings.derivative_cutoff_hz, step_s) * (derivative - speed)
        expected = self.value[index] + np.where(later, advance, 0.0)
        innovation = value - expected
        if axes is None:
            correction = (
                smoothing_factor(self.settings.min_cutoff_hz + self.settings.beta * np.abs(speed), step_s) * innovation
            )
        else:
            along = np.abs(np.einsum("kji,kj->ki", axes.basis, speed))
            cutoff_hz = self.settings.min_cutoff_hz * axes.cutoff_scale + self.settings.beta * axes.beta_scale * along
            along = smoothing_factor(cutoff_hz, step_s) * np.einsum("kji,kj->ki", axes.basis, innovation)
            correction = np.einsum("kij,kj->ki", axes.basis, along)
        self.value[index] = expected + correction
        self.speed[index] = speed
        self._raw[index] = np.where(later, value, self._raw[index])
        self.t_s[index] = np.maximum(self.t_s[index], np.reshape(t_s, -1))
