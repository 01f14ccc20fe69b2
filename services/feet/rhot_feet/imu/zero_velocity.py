"""When a foot stands still, told sample by sample.

It is the test of SHOE, over a window of specific force f (m/s²) and angular rate ω (rad/s); small means still:

    SHOE = mean(|f − g·f̄/|f̄||²/σ_a² + |ω|²/σ_ω²)      (generalised likelihood ratio test)

Source: Skog, Händel, Nilsson and Rantakokko, "Zero-velocity detection: an algorithm evaluation", IEEE Transactions on
Biomedical Engineering 57 (11), 2010.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

GRAVITY: Final = 9.81
"""m/s²; the quantity that sensors scale to, whatever the place."""
ACCELERATION_NOISE: Final = 0.01
"""σ_a, m/s²: the scale of the accelerations in the test, a convention as in the source above."""
RATE_NOISE: Final = float(np.radians(0.1))
"""σ_ω, rad/s: the scale of the angular rates in the test."""


@dataclass(frozen=True, slots=True)
class Rest:
    """What a sample says about standing still.

    Attributes:
        still: the foot stands, as far as the sensor can tell.
        speed_sigma: standard deviation of the sensor's velocity about zero, m/s, for one sample of 5 ms; None while it
            moves.
        rate: (3,) rad/s, mean over the window, when the sensor has stood so long and evenly that this may be its bias.
    """

    still: bool
    speed_sigma: float | None
    rate: FloatArray | None


@dataclass(frozen=True, slots=True)
class StillnessSettings:
    """Tuning of the live detector; found on the dev trials of the foot-mounted data with motion-capture truth.

    Attributes:
        window_s: length of the window, which ends with the newest sample.
        lowest, highest: bounds of the threshold of SHOE.
        share: the threshold is this share of the mean of the statistic over the last `memory_s`, within the bounds: who
            runs never stands as still as who strolls.
        memory_s: time constant of that mean.
        speed_sigma, scale: a sample with statistic T tells the velocity to speed_sigma·(1 + T/scale).
        hold_s: the foot counts as standing after so long below the lowest threshold.
        bias_s: its rate may be bias after so long.
    """

    window_s: float = 0.04
    lowest: float = 1e4
    highest: float = 3e5
    share: float = 0.03
    memory_s: float = 1.0
    speed_sigma: float = 0.01
    scale: float = 1e3
    hold_s: float = 0.05
    bias_s: float = 0.2


class StillnessDetector:
    """SHOE with a threshold that follows the gait, sample by sample.

    The rate enters by its mean over the window, not by its mean square: rates that are differences of a sensor's
    quaternions carry noise that cancels in the sum.
    """

    def __init__(self, settings: StillnessSettings | None = None) -> None:
        self._settings = settings or StillnessSettings()
        # Duration, specific force, angular rate, acceleration.
        self._window: deque[tuple[float, float, float, float, float, float, float, float, float, float]] = deque()
        self._level_error = (0.0, 0.0, 0.0)
        self._mean = 0.0
        self._even_s = self._beyond_s = self._still_s = 0.0

    def reset(self) -> None:
        """Forget the samples: there was a gap."""
        self._window.clear()
        self._mean = self._even_s = self._beyond_s = self._still_s = 0.0

    def add(
        self,
        duration_s: float,
        specific_force: FloatArray,
        angular_rate: FloatArray,
        acceleration: FloatArray | None = None,
    ) -> Rest:
        """Take the next sample and say what it tells.

        Args:
            duration_s: since the sample before.
            specific_force: (3,) m/s².
            angular_rate: (3,) rad/s, mean since the sample before.
            acceleration: (3,) m/s², level axes, of a sensor that knows up. SHOE takes a level acceleration that lasts
                longer than its window for a tilt.
        """
        settings, window = self._settings, self._window
        fx, fy, fz = specific_force.tolist()
        wx, wy, wz = angular_rate.tolist()
        ax, ay, az = (0.0, 0.0, 0.0) if acceleration is None else acceleration.tolist()
        window.append((duration_s, fx, fy, fz, wx, wy, wz, ax, ay, az))
        while len(window) > 3 and sum(row[0] for row in window) - window[0][0] >= settings.window_s - 1e-4:
            window.popleft()
        statistic, rate, unevenness, accelerated = self._statistic()
        self._mean += (statistic - self._mean) * min(duration_s / settings.memory_s, 1.0)
        threshold = min(max(settings.share * self._mean, settings.lowest), settings.highest)
        self._even_s = self._even_s + duration_s if statistic <= settings.lowest else 0.0
        accelerates = self._accelerates(duration_s, accelerated)
        if len(window) < 3 or statistic > threshold:
            self._still_s = 0.0
            return MOVES
        # Between both bounds the velocity is corrected, softly, though nobody would call that standing.
        stands = statistic <= settings.lowest and accelerates == 0.0
        self._still_s = self._still_s + duration_s if stands else 0.0
        sigma = settings.speed_sigma * (1.0 + statistic / settings.scale) + _GAINS_S * accelerates
        even = self._still_s >= settings.bias_s and unevenness < _EVEN
        return Rest(self._still_s >= settings.hold_s, sigma, rate if even else None)

    def _accelerates(self, duration_s: float, mean: tuple[float, float, float]) -> float:
        """Return by how much the mean over the window is larger than a standing sensor's may be, m/s²."""
        beyond = max(0.0, math.dist(mean, self._level_error) - _LEVEL_ERROR)
        self._beyond_s = self._beyond_s + duration_s if beyond > 0.0 and self._even_s > 0.0 else 0.0
        if self._beyond_s > _ERROR_S or (beyond == 0.0 and self._even_s > _EVEN_S):
            share = min(duration_s / _EVEN_S, 1.0)
            x, y, z = (old + share * (new - old) for old, new in zip(self._level_error, mean, strict=True))
            self._level_error = (x, y, z)
        return beyond

    def _statistic(self) -> tuple[float, FloatArray, float, tuple[float, float, float]]:
        """Return SHOE over the window, the mean rate, how much the rates vary, rad/s, and the mean acceleration.

        In plain arithmetic, which for a handful of samples is several times faster than arrays.
        """
        rows, count = self._window, len(self._window)
        _, fx, fy, fz, wx, wy, wz, ax, ay, az = (sum(column) / count for column in zip(*rows, strict=True))
        scale = GRAVITY / max(math.sqrt(fx * fx + fy * fy + fz * fz), 1e-9)
        gx, gy, gz = scale * fx, scale * fy, scale * fz
        force = sum((x - gx) ** 2 + (y - gy) ** 2 + (z - gz) ** 2 for _, x, y, z, *_ in rows) / count
        spread = sum((x - wx) ** 2 + (y - wy) ** 2 + (z - wz) ** 2 for _, _, _, _, x, y, z, *_ in rows) / count
        statistic = force / ACCELERATION_NOISE**2 + (wx * wx + wy * wy + wz * wz) / RATE_NOISE**2
        return statistic, np.array([wx, wy, wz]), math.sqrt(spread), (ax, ay, az)


_LEVEL_ERROR: Final = 0.5
"""m/s²: what tilt and bias of a standing sensor change by; on recorded walks both together are less in 99 % of the
samples."""
_EVEN_S: Final = 0.3
"""How fast the error is learnt, and how long a foot has to be without any unevenness before."""
_ERROR_S: Final = 1.0
"""What lasts so long without any unevenness is no acceleration of a foot but a larger error of the sensor."""
_GAINS_S: Final = 0.15
"""For about so long an acceleration has gone on when it is noticed."""
MOVES: Final = Rest(still=False, speed_sigma=None, rate=None)
_EVEN: Final = float(np.radians(2.0))
"""Rates that vary less than this, rad/s, come from a sensor that does not turn."""
