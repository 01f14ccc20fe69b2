"""Figures with their uncertainty, from samples that are not independent.

What a tracker publishes at 60 Hz is correlated: filters and slow light make neighbours alike, and n samples tell less
than n independent ones. With ρ_k the correlation over k samples, the mean of n samples is as uncertain as one of

    n / (1 + 2 Σ ρ_k)

independent ones (Priestley, Spectral Analysis and Time Series, 1981, section 5.3), and their variance as one of

    n / (1 + 2 Σ ρ_k²)

(Bartlett, 1946, for a normal process); tails heavier than a normal's add their kurtosis over the former. Intervals hold
the truth with a probability of `COVERAGE`, by Student's t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import t as student

from rhot.arrays import FloatArray

COVERAGE: Final = 0.95
LEAST_INDEPENDENT: Final = 30.0
"""With fewer, the correlation itself is not known well enough. Of 300 simulated records each with 33 to 3,500
independent samples, 92 to 98 % of the intervals held the truth; with 12 to 16, 55 to 85 %."""

_LEAST_STRETCHES: Final = 5
"""Fewer tell nothing of how stretches differ: with four degrees of freedom Student's t is 2.8 already."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A value and where it lies with a probability of `COVERAGE`.

    Attributes:
        value: of all samples.
        low, high: ends of the interval; NaN where too few samples tell none.
        independent: how many independent samples would tell as much.
        samples: how many there are.
    """

    value: float
    low: float
    high: float
    independent: float
    samples: int

    @property
    def half_width(self) -> float:
        """Half the interval: what stands after ±."""
        return 0.5 * (self.high - self.low)

    def holds(self, truth: float) -> bool:
        """Tell whether a true value lies within the interval."""
        return self.low <= truth <= self.high

    def scaled(self, factor: float) -> Figure:
        """Return the same figure in another unit."""
        return Figure(self.value * factor, self.low * factor, self.high * factor, self.independent, self.samples)


def mean(values: FloatArray) -> Figure:
    """Return the mean of samples (N,), equally spaced."""
    count = len(values)
    if count < 2:
        return _without_interval(float(values.mean()) if count else float("nan"), count)
    length, _ = _lengths(values)
    independent = count / length
    error = float(np.sqrt(_variance(values, length) / independent))
    return _figure(float(values.mean()), error, independent, count)


def mean_of_independent(values: FloatArray) -> Figure:
    """Return the mean of independent samples (N,), such as figures of separate stretches."""
    count = len(values)
    if count < _LEAST_STRETCHES:
        return _without_interval(float(values.mean()) if count else float("nan"), count)
    middle = float(values.mean())
    reach = float(student.ppf(0.5 + 0.5 * COVERAGE, count - 1)) * float(values.std(ddof=1)) / np.sqrt(count)
    return Figure(middle, middle - reach, middle + reach, float(count), count)


def deviation(values: FloatArray) -> Figure:
    """Return the standard deviation of samples (N,) or (N, D), equally spaced: root of the axes' summed variances."""
    count = len(values)
    if count < 3:
        return _without_interval(float("nan"), count)
    columns = values.reshape(count, -1)
    variance, uncertainty, independent = 0.0, 0.0, float(count)
    for column in columns.T:
        length, square_length = _lengths(column)
        own = _variance(column, length)
        centred = column - column.mean()
        kurtosis = max(float(np.mean(centred**4) / max(np.mean(centred**2) ** 2, 1e-300)) - 3.0, 0.0)
        variance += own
        uncertainty += own**2 * (2.0 * square_length + kurtosis * length) / count
        independent = min(independent, count / length)
    if variance <= 0.0:
        return Figure(0.0, 0.0, 0.0, independent, count)
    found = float(np.sqrt(variance))
    return _figure(found, 0.5 * found * float(np.sqrt(uncertainty)) / variance, independent, count)


def _figure(value: float, error: float, independent: float, count: int) -> Figure:
    if independent < LEAST_INDEPENDENT:
        return Figure(value, float("nan"), float("nan"), independent, count)
    reach = float(student.ppf(0.5 + 0.5 * COVERAGE, independent - 1.0)) * error
    return Figure(value, value - reach, value + reach, independent, count)


def _without_interval(value: float, count: int) -> Figure:
    return Figure(value, float("nan"), float("nan"), float(count), count)


def _variance(values: FloatArray, length: float) -> float:
    """Return the variance, made whole for what the mean of correlated samples takes away."""
    count = len(values)
    return float(values.var()) * count / max(count - length, 1.0)


def _lengths(values: FloatArray) -> tuple[float, float]:
    """Return 1 + 2 Σ ρ_k and 1 + 2 Σ ρ_k² over the lags until pairs of ρ are no longer positive.

    That end is Geyer's (Statistical Science 7(4), 1992): beyond it there is nothing but the noise of the estimate.
    """
    centred = values - values.mean()
    count = len(centred)
    power = np.abs(np.fft.rfft(centred, 2 * count)) ** 2
    covariance = np.fft.irfft(power)[:count]
    if covariance[0] <= 0.0:
        return 1.0, 1.0
    # Divided by what is there at each lag: by n throughout, long correlations would read short.
    rho = covariance / covariance[0] * count / np.arange(count, 0, -1)
    pairs = rho[1 : 2 * ((count - 1) // 2) + 1].reshape(-1, 2).sum(axis=1)[: count // 4]
    ended = np.flatnonzero(pairs <= 0.0)
    kept = rho[1 : 1 + 2 * (int(ended[0]) if ended.size else len(pairs))]
    return max(1.0, 1.0 + 2.0 * float(kept.sum())), 1.0 + 2.0 * float((kept**2).sum())
