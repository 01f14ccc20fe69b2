"""What one sensor felt lately, sample by sample."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from operator import attrgetter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import rotation_cosine
from rhot_feet.filter.history import Felt
from rhot_feet.imu.inertial import LONGEST_STEP_S, nearest_sample
from rhot_feet.imu.strapdown import InertialStep
from rhot_feet.imu.zero_velocity import GRAVITY, StillnessDetector, StillnessSettings

FloatArray = NDArray[np.float64]

_GAP_S: Final = 0.03
"""Samples further apart than this have others missing between them."""
_BRIDGED_NS: Final = 10_000_000
_SAME_FORCE: Final = 0.5
"""m/s²"""
_GRAVITY: Final = np.array([0.0, 0.0, GRAVITY])
_SAME_TURN_COSINE: Final = math.cos(math.radians(1.5))


class SampleTrack:
    """The last samples of a sensor."""

    def __init__(self, stillness: StillnessSettings, kept_ns: int) -> None:
        """Begin.

        Args:
            stillness: of the detector of stand-stills.
            kept_ns: how long samples are kept.
        """
        self._detector = StillnessDetector(stillness)
        self._kept_ns = kept_ns
        self._felt: deque[Felt] = deque()
        self._last: tuple[int, FloatArray] | None = None

    def __len__(self) -> int:
        return len(self._felt)

    def add(self, t_ns: int, force: FloatArray, rate: FloatArray, R_world: FloatArray) -> Felt | None:
        """Take a sample; return what was felt since the one before, None when the sensor was away meanwhile.

        Args:
            t_ns: of the sample.
            force: (3,) m/s², sensor frame.
            rate: (3,) rad/s, sensor frame.
            R_world: (3, 3) from the sensor to its own level world.
        """
        last, self._last = self._last, (t_ns, force)
        if last is None or not 0 < t_ns - last[0] <= LONGEST_STEP_S * 1e9:
            self._detector.reset()
            self._felt.clear()
            return None
        h = (t_ns - last[0]) * 1e-9
        rest = self._detector.add(h, force, rate, R_world @ force - _GRAVITY)
        felt = Felt(t_ns, last[0], InertialStep(h, last[1], force, h * rate, h > _GAP_S), rate, rest, R_world)
        self._felt.append(felt)
        while t_ns - self._felt[0].t_ns > self._kept_ns:
            self._felt.popleft()
        return felt

    def missing(self, t_ns: int, force: FloatArray, R_world: FloatArray) -> range:
        """Return the times of samples that were lost before a sample, while the foot stood.

        It did when it stood before and is turned and borne alike afterwards: no step is over so soon.

        Args:
            t_ns: of the sample.
            force: (3,) m/s², sensor frame.
            R_world: (3, 3) from the sensor to its own level world.
        """
        before = self._felt[-1] if self._felt else None
        if before is None or not before.rest.still or not _GAP_S < 1e-9 * (t_ns - before.t_ns) <= LONGEST_STEP_S:
            return range(0)
        changed = force - before.step.force_after
        if float(changed @ changed) > _SAME_FORCE**2 or rotation_cosine(R_world, before.R_world) < _SAME_TURN_COSINE:
            return range(0)
        return range(before.t_ns + _BRIDGED_NS, t_ns - _BRIDGED_NS // 2, _BRIDGED_NS)

    def is_silent(self, t_ns: int) -> bool:
        """Tell whether the sensor had gone away at a moment."""
        return not self._felt or t_ns - self._felt[-1].t_ns > LONGEST_STEP_S * 1e9

    def at(self, t_ns: int) -> Felt | None:
        """Return the sample nearest to a moment, if one is near."""
        return nearest_sample(self._felt, t_ns, attrgetter("t_ns"))

    def since(self, t_ns: int) -> Iterator[Felt]:
        """Return what was felt from a moment on."""
        return (felt for felt in self._felt if felt.start_ns >= t_ns)
