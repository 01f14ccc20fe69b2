"""Detects when a foot stands still, sample by sample.

`rhot_feet.filter.zero_velocity_update` corrects the filter by it.

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

from rhot.arrays import FloatArray
from rhot_feet.imu.samples import GRAVITY_M_S2

ACCELERATION_NOISE: Final = 0.01
"""σ_a, m/s²: the scale of the accelerations in the test, a convention as in the source above."""
RATE_NOISE: Final = float(np.radians(0.1))
"""σ_ω, rad/s: the scale of the angular rates in the test."""


SAMPLE_S: Final = 0.005
"""Sample interval to which `ZeroVelocity.speed_sigma` refers, seconds."""


@dataclass(frozen=True, slots=True)
class ZeroVelocity:
    """Result of the detector for one sample.

    Attributes:
        still: the sensor stands.
        speed_sigma: standard deviation of the sensor's velocity about zero, m/s, for one sample of 5 ms; None while it
            moves.
        rate: (3,) rad/s, mean over the window, once the sensor has stood long and evenly enough for it to be the bias.
        rolls_m: distance from the sensor down to the point about which the foot rolls, so that it moves at ω x r; 0
            while it stands.
    """

    still: bool
    speed_sigma: float | None
    rate: FloatArray | None
    rolls_m: float = 0.0


MOVING: Final = ZeroVelocity(still=False, speed_sigma=None, rate=None)


@dataclass(frozen=True, slots=True)
class ZeroVelocitySettings:
    """Tuning of the live detector, found on PyShoe's dev trials with motion-capture truth (`rhot evaluate steps`).

    Attributes:
        window_s: length of the window, which ends with the newest sample.
        lowest: bound of the threshold of SHOE; above it there is none, for a runner's foot is never still.
        share: the threshold is this share of the mean of the statistic over the last `memory_s`, if that is more: who
            runs never stands as still as who strolls.
        memory_s: time constant of that mean.
        speed_sigma: of the velocity of a sensor that stands still, m/s.
        lever_m: a foot on the ground rolls, about a point so far below or before its sensor: a sensor with rate ω
            moves at ω·lever. As the statistic T is at least (ω/σ_ω)², that is at most σ_ω·√T·lever. While T is above
            `lowest`, where a foot is still in its gait, the filter expects that motion instead of none: called zero,
            it makes each stride 2 to 3 % too short.
        alike_s: for so long the samples of a stance tell the same, so that n of them are worth one.
        hold_s: the foot counts as standing after so long below the lowest threshold.
        bias_s: its rate may be bias after so long, when it varies by less than `even_rad_s`.
        even_rad_s: rates that vary less come from a sensor that does not rotate.
        level_error_m_s2: what tilt and bias of a standing sensor change by; on recorded walks both together are less in
            99 % of the samples.
        level_s: how fast that error is estimated, and how long the foot must have been even before.
        level_reset_s: what lasts so long evenly is no acceleration of a foot but a larger error of the sensor.
        noticed_s: for about so long an acceleration has gone on when it is noticed.
    """

    window_s: float = 0.04
    lowest: float = 1e4
    share: float = 0.03
    memory_s: float = 1.0
    speed_sigma: float = 0.01
    lever_m: float = 0.1
    alike_s: float = 0.1
    hold_s: float = 0.05
    bias_s: float = 0.2
    even_rad_s: float = math.radians(2.0)
    level_error_m_s2: float = 0.5
    level_s: float = 0.3
    level_reset_s: float = 1.0
    noticed_s: float = 0.15


class ZeroVelocityDetector:
    """SHOE with a threshold that follows the gait, sample by sample.

    The rate enters by its mean over the window, not by its mean square: rates that are differences of a sensor's
    quaternions carry noise that cancels in the sum.
    """

    def __init__(self, settings: ZeroVelocitySettings | None = None) -> None:
        self._settings = settings or ZeroVelocitySettings()
        # Duration, specific force, angular rate, acceleration.
        self._window: deque[FloatArray] = deque()
        self._level_error = np.zeros(3)
        self._mean = 0.0
        self._even_s = self._beyond_s = self._still_s = 0.0

    def reset(self) -> None:
        """Discard the samples, after a gap."""
        self._window.clear()
        self._mean = self._even_s = self._beyond_s = self._still_s = 0.0

    def add(
        self,
        duration_s: float,
        specific_force: FloatArray,
        angular_rate: FloatArray,
        acceleration: FloatArray | None = None,
    ) -> ZeroVelocity:
        """Add the next sample and return whether the sensor stands.

        Args:
            duration_s: since the sample before.
            specific_force: (3,) m/s².
            angular_rate: (3,) rad/s, mean since the sample before.
            acceleration: (3,) m/s², level axes, of a sensor that knows up. SHOE takes a level acceleration that lasts
                longer than its window for a tilt.
        """
        settings, window = self._settings, self._window
        level = np.zeros(3) if acceleration is None else acceleration
        window.append(np.concatenate([[duration_s], specific_force, angular_rate, level]))
        while len(window) > 3 and sum(row[0] for row in window) - window[0][0] >= settings.window_s - 1e-4:
            window.popleft()
        statistic, rate, unevenness, accelerated = self._statistic()
        self._mean += (statistic - self._mean) * min(duration_s / settings.memory_s, 1.0)
        threshold = max(settings.share * self._mean, settings.lowest)
        self._even_s = self._even_s + duration_s if statistic <= settings.lowest else 0.0
        accelerates = self._accelerates(duration_s, accelerated)
        if len(window) < 3 or statistic > threshold:
            self._still_s = 0.0
            return MOVING
        # Above the lowest threshold the velocity is still corrected, with a larger sigma, but not counted as standing.
        stands = statistic <= settings.lowest and accelerates == 0.0
        self._still_s = self._still_s + duration_s if stands else 0.0
        rolls = settings.lever_m * RATE_NOISE * math.sqrt(statistic * settings.alike_s / SAMPLE_S)
        sigma = math.hypot(settings.speed_sigma, rolls) + settings.noticed_s * accelerates
        even = self._still_s >= settings.bias_s and unevenness < self._settings.even_rad_s
        rolls_m = settings.lever_m if statistic > settings.lowest else 0.0
        return ZeroVelocity(self._still_s >= settings.hold_s, sigma, rate if even else None, rolls_m)

    def _accelerates(self, duration_s: float, mean: FloatArray) -> float:
        """Return by how much the mean over the window is larger than a standing sensor's may be, m/s²."""
        beyond = max(0.0, math.dist(mean, self._level_error) - self._settings.level_error_m_s2)
        self._beyond_s = self._beyond_s + duration_s if beyond > 0.0 and self._even_s > 0.0 else 0.0
        if self._beyond_s > self._settings.level_reset_s or (beyond == 0.0 and self._even_s > self._settings.level_s):
            share = min(duration_s / self._settings.level_s, 1.0)
            self._level_error = self._level_error + share * (mean - self._level_error)
        return beyond

    def _statistic(self) -> tuple[float, FloatArray, float, FloatArray]:
        """Return SHOE over the window, the mean rate, how much the rates vary, rad/s, and the mean acceleration."""
        rows = np.array(self._window)
        _, force, rate, acceleration = np.split(rows.mean(axis=0), (1, 4, 7))
        gravity = (GRAVITY_M_S2 / max(math.sqrt(force @ force), 1e-9)) * force
        unexplained = float(((rows[:, 1:4] - gravity) ** 2).sum()) / len(rows)
        spread = float(((rows[:, 4:7] - rate) ** 2).sum()) / len(rows)
        statistic = unexplained / ACCELERATION_NOISE**2 + float(rate @ rate) / RATE_NOISE**2
        return statistic, rate, math.sqrt(spread), acceleration
