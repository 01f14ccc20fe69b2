"""The last samples of one inertial sensor, as intervals from sample to sample."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_cosine
from rhot_feet.imu.samples import GRAVITY_M_S2, LONGEST_STEP_S, nearest_sample
from rhot_feet.imu.zero_velocity_detector import ZeroVelocity, ZeroVelocityDetector, ZeroVelocitySettings

_GAP_S: Final = 0.03
"""Samples farther apart than this have others missing between them."""
_SPACING_NS: Final = 10_000_000
"""Of the samples that are filled in while the foot stands."""
HELD_NS: Final = 30_000_000
"""The newest sample holds for so long; then nothing is known."""

_GRAVITY: Final = np.array([0.0, 0.0, GRAVITY_M_S2])


@dataclass(frozen=True, slots=True)
class InertialStep:
    """What a sensor measured between two of its samples.

    Attributes:
        duration_s: between the samples.
        force_before, force_after: (3,) specific force at the samples, m/s², sensor frame.
        rotation_rad: (3,) rotation vector of the rotation in between, sensor frame.
        dropout: samples are missing, so what happened in between is a guess.
    """

    duration_s: float
    force_before: FloatArray
    force_after: FloatArray
    rotation_rad: FloatArray
    dropout: bool = False

    def part(self, from_s: float, to_s: float) -> InertialStep:
        """Return the part between two moments of the step, seconds after its beginning."""
        slope = (self.force_after - self.force_before) / self.duration_s
        return InertialStep(
            to_s - from_s,
            self.force_before + from_s * slope,
            self.force_before + to_s * slope,
            self.rotation_rad * ((to_s - from_s) / self.duration_s),
            self.dropout,
        )


@dataclass(frozen=True, slots=True)
class ImuInterval:
    """One sample, and what was measured since the one before.

    Attributes:
        t_ns: of the sample.
        start_ns: of the sample before.
        step: what was measured in between.
        rate: (3,) rad/s in between.
        zero_velocity: what the detector says of the sample.
        R_world: (3, 3) from the sensor to its own level world.
    """

    t_ns: int
    start_ns: int
    step: InertialStep
    rate: FloatArray
    zero_velocity: ZeroVelocity
    R_world: FloatArray

    def between(self, from_ns: int, to_ns: int) -> InertialStep | None:
        """Return what was measured between two moments; None where the sensor does not say."""
        if from_ns < self.start_ns or to_ns > self.t_ns + HELD_NS:
            return None
        if to_ns <= self.t_ns:
            return self.step.part((from_ns - self.start_ns) * 1e-9, (to_ns - self.start_ns) * 1e-9)
        h = (to_ns - from_ns) * 1e-9
        return InertialStep(h, self.step.force_after, self.step.force_after, h * self.rate)


class ImuTrack:
    """The last intervals of a sensor.

    Args:
        settings: of the zero-velocity detector.
        kept_ns: how long intervals are kept.
    """

    def __init__(self, settings: ZeroVelocitySettings, kept_ns: int) -> None:
        self._detector = ZeroVelocityDetector(settings)
        self._kept_ns = kept_ns
        self._intervals: deque[ImuInterval] = deque()
        self._last: tuple[int, FloatArray] | None = None

    def __len__(self) -> int:
        return len(self._intervals)

    def add(self, t_ns: int, force: FloatArray, rate: FloatArray, R_world: FloatArray) -> ImuInterval | None:
        """Add a sample; return the interval since the one before, None after a dropout.

        Args:
            t_ns: of the sample.
            force: (3,) m/s², sensor frame.
            rate: (3,) rad/s, sensor frame.
            R_world: (3, 3) from the sensor to its own level world.
        """
        last, self._last = self._last, (t_ns, force)
        if last is None or not 0 < t_ns - last[0] <= LONGEST_STEP_S * 1e9:
            self._detector.reset()
            self._intervals.clear()
            return None
        h = (t_ns - last[0]) * 1e-9
        zero_velocity = self._detector.add(h, force, rate, R_world @ force - _GRAVITY)
        step = InertialStep(h, last[1], force, h * rate, h > _GAP_S)
        interval = ImuInterval(t_ns, last[0], step, rate, zero_velocity, R_world)
        self._intervals.append(interval)
        while t_ns - self._intervals[0].t_ns > self._kept_ns:
            self._intervals.popleft()
        return interval

    def missing(self, t_ns: int, force: FloatArray, R_world: FloatArray) -> range:
        """Return the times of samples that were lost before a sample (see `add`) while the foot stood."""
        before = self._intervals[-1] if self._intervals else None
        if before is None or not before.zero_velocity.still:
            return range(0)
        if not _GAP_S < 1e-9 * (t_ns - before.t_ns) <= LONGEST_STEP_S:
            return range(0)
        change = force - before.step.force_after
        # A foot that stood before a gap stood throughout when force and
        # orientation have not changed by more than this: no step is over so soon.
        if float(change @ change) > 0.5**2:
            return range(0)
        if rotation_cosine(R_world, before.R_world) < math.cos(math.radians(1.5)):
            return range(0)
        return range(before.t_ns + _SPACING_NS, t_ns - _SPACING_NS // 2, _SPACING_NS)

    def is_silent(self, t_ns: int) -> bool:
        """Return whether the sensor had gone away at a moment."""
        return not self._intervals or t_ns - self._intervals[-1].t_ns > LONGEST_STEP_S * 1e9

    def at(self, t_ns: int) -> ImuInterval | None:
        """Return the interval whose sample is nearest to a moment, if one is near."""
        return nearest_sample(self._intervals, t_ns, attrgetter("t_ns"))

    def since(self, t_ns: int) -> Iterator[ImuInterval]:
        """Return the intervals that begin at a moment or later."""
        return (interval for interval in self._intervals if interval.start_ns >= t_ns)
