"""Figures with their uncertainty, from samples that are not independent.

What a tracker publishes at 60 Hz is correlated: filters and slow light make neighbours alike, and n samples tell less
than n independent ones. With ρ_k the correlation over k samples, the mean of n samples is as uncertain as one of

    n / (1 + 2 Σ ρ_k)

independent ones (Priestley, Spectral Analysis and Time Series, 1981, section 5.3), and their variance as one of

    n / (1 + 2 Σ ρ_k²)

(Bartlett, 1946, for a normal process); tails heavier than a normal's add their kurtosis over the former. Intervals hold
the truth with a probability of `COVERAGE`, by Student's t; those of a deviation are symmetric on a logarithmic scale,
so that none reaches below zero. Below `LEAST_INDEPENDENT` there is none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import stdtrit

from rhot.arrays import FloatArray
from rhot_tools.measures.rows import Row

COVERAGE: Final = 0.95
LEAST_INDEPENDENT: Final = 30.0
"""With fewer, the correlation itself is not known well enough. Of 300 simulated records each with 33 to 3,500
independent samples, 92 to 98 % of the intervals held the truth; with 12 to 16, 55 to 85 %."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A value and where it lies with a probability of `COVERAGE`.

    Attributes:
        value: of all samples.
        low, high: ends of the interval; NaN where too few samples tell none.
        independent: how many independent samples would tell as much.
        samples: how many there are.
        error: standard error of the value.
    """

    value: float
    low: float
    high: float
    independent: float
    samples: int
    error: float = float("nan")

    @property
    def half_width(self) -> float:
        """Half the interval: what stands after ±."""
        return 0.5 * (self.high - self.low)

    def holds(self, truth: float) -> bool:
        """Tell whether a true value lies within the interval."""
        return self.low <= truth <= self.high

    def scaled(self, factor: float) -> Figure:
        """Return the same figure in another unit."""
        value, low, high, error = (factor * each for each in (self.value, self.low, self.high, self.error))
        return Figure(value, low, high, self.independent, self.samples, error)


def mean(values: FloatArray) -> Figure:
    """Return the mean of samples (N,), equally spaced."""
    count = len(values)
    if count < 2:
        return _without_interval(float(values.mean()) if count else float("nan"), count)
    length, _ = _lengths(values)
    independent = count / length
    error = float(np.sqrt(_variance(values, length) / independent))
    return _figure(float(values.mean()), error, independent, count)


def root_mean_square(values: FloatArray) -> Figure:
    """Return the root of the mean square of samples (N,), equally spaced."""
    square = mean(values**2)
    if not square.value > 0.0:
        return _without_interval(square.value, square.samples)
    root = float(np.sqrt(square.value))
    return _figure(root, 0.5 * square.error / root, square.independent, square.samples, positive=True)


def spread_of_stretches(stretches: Sequence[FloatArray]) -> Figure:
    """Return the deviation within stretches (N_k, D) of residuals, which are independent of one another.

    It is the root of the axes' summed mean squares. How far it may be off follows from how the stretches differ, or
    from their correlation, whichever is more.
    """
    counts = np.array([len(each) for each in stretches], dtype=np.float64)
    variances = np.array([(each**2).mean(axis=0).sum() for each in stretches])
    samples, variance = int(counts.sum()), float(np.average(variances, weights=counts))
    if variance <= 0.0:
        return Figure(0.0, 0.0, 0.0, float(samples), samples)
    length, square_length = _lengths_within(stretches)
    independent = samples / length
    if len(stretches) < 2:
        return _without_interval(float(np.sqrt(variance)), samples)
    differ = float(np.sqrt(np.average((variances - variance) ** 2, weights=counts) / (len(stretches) - 1)))
    shares = np.mean([(each**2).mean(axis=0) for each in stretches], axis=0)
    correlated = variance * float(np.sqrt(2.0 * square_length * (shares**2).sum() / shares.sum() ** 2 / samples))
    found = float(np.sqrt(variance))
    return _figure(found, 0.5 * max(differ, correlated) / found, independent, samples, positive=True)


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
    return _figure(found, 0.5 * found * float(np.sqrt(uncertainty)) / variance, independent, count, positive=True)


def _figure(value: float, error: float, independent: float, count: int, *, positive: bool = False) -> Figure:
    if independent < LEAST_INDEPENDENT:
        return Figure(value, float("nan"), float("nan"), independent, count, error)
    reach = float(stdtrit(independent - 1.0, 0.5 + 0.5 * COVERAGE)) * error
    low, high = value - reach, value + reach
    if positive and value > 0.0:
        low, high = value * float(np.exp(-reach / value)), value * float(np.exp(reach / value))
    return Figure(value, low, high, independent, count, error)


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
    return _summed(_covariance(centred))


def _lengths_within(stretches: Sequence[FloatArray]) -> tuple[float, float]:
    """Return the same over stretches (N_k, D) of one process, all axes together, up to a third of the shortest."""
    shortest = min(len(each) for each in stretches)
    covariance = np.zeros(shortest)
    for each in stretches:
        for column in each.T:
            covariance += _covariance(column)[:shortest]
    return _summed(covariance, shortest // 3)


def _covariance(centred: FloatArray) -> FloatArray:
    """Return the sums of products over each lag (N,), each as if all N samples were there."""
    count = len(centred)
    power = np.abs(np.fft.rfft(centred, 2 * count)) ** 2
    # Divided by what is there at each lag: by n throughout, long correlations would read short.
    covariance: FloatArray = np.fft.irfft(power)[:count] * count / np.arange(count, 0, -1)
    return covariance


def _summed(covariance: FloatArray, most: int | None = None) -> tuple[float, float]:
    if covariance[0] <= 0.0:
        return 1.0, 1.0
    count = len(covariance)
    rho = covariance / covariance[0]
    pairs = rho[1 : 2 * ((count - 1) // 2) + 1].reshape(-1, 2).sum(axis=1)[: (most or count // 2) // 2]
    ended = np.flatnonzero(pairs <= 0.0)
    kept = rho[1 : 1 + 2 * (int(ended[0]) if ended.size else len(pairs))]
    return max(1.0, 1.0 + 2.0 * float(kept.sum())), 1.0 + 2.0 * float((kept**2).sum())


# Figures with intervals as rows of a report.

TOO_FEW = f"fewer than {LEAST_INDEPENDENT:.0f} independent samples tell no interval; measure for longer"


def figure_row(name: str, figure: Figure, unit: str, *, peer: str = "", note: str = "", digits: int = 3) -> Row:
    """Return a row whose note tells the interval and what it rests on."""
    if math.isnan(figure.low):
        told = f"{TOO_FEW} ({figure.samples} samples)"
    else:
        told = (
            f"95 %: {figure.low:.{digits}g} to {figure.high:.{digits}g} {unit}; {figure.samples} samples, "
            f"{figure.independent:.0f} independent"
        )
    return Row(name, figure.value, unit, peer=peer, note=f"{told}. {note}" if note else told)


def truth_row(name: str, figure: Figure, truth: float, unit: str) -> Row:
    """Return how a figure stands to what is true: 1 where the truth lies within its interval, 0 where it does not.

    NaN where no interval could be told.
    """
    told = math.isfinite(figure.low) and math.isfinite(truth)
    note = f"measured {figure.value:.4g} ({figure.low:.4g} to {figure.high:.4g}) {unit}, true {truth:.4g} {unit}"
    return Row(name, float(figure.holds(truth)) if told else float("nan"), least=1.0, note=note)
