"""The 1-euro filter for arrays of points, each with its own time.

Source: Casiez, Roussel, Vogel, "1€ Filter: A Simple Speed-based Low-pass Filter for Noisy Input in Interactive
Systems", CHI 2012, section "The 1€ filter". A first-order low-pass whose cut-off grows with the filtered speed:

    f_c = f_min + β |dx̂/dt|,   α = 1 / (1 + τ / T_e),   τ = 1 / (2 π f_c),   x̂ ← x̂ + α (x − x̂)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray, IndexArray


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
