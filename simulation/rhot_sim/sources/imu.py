"""The ankle sensor of the simulated walking person."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np

from rhot.arrays import FloatArray
from rhot.messages import Side
from rhot.rig import Rig
from rhot_feet.imu.samples import FusedImuConverter, ImuSamples
from rhot_sim.walker.world import WalkerWorld

_AHEAD_S: Final = 0.5
"""How much is drawn at once: a draw of 50 samples costs hardly more than one of a single sample."""


class WalkingWorld(Protocol):
    """What is needed of `rhot_sim.walker.world.WalkerWorld`."""

    def imu(self, side: Side, t0_s: float, t1_s: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return stamps, linear accelerations, orientations and rates from `t0_s` to before `t1_s`."""
        ...

    def imu_delivered_s(self, side: Side, t_s: FloatArray) -> FloatArray:
        """Return when samples with these stamps come out of the port."""
        ...


class SimulatedSource:
    """One ankle's sensor; like everything simulated a function of seed and time."""

    def __init__(self, world: WalkingWorld, side: Side) -> None:
        """Choose the world and the ankle."""
        self._world = world
        self._side: Side = side
        self._converter = FusedImuConverter()
        self._start_ns: int | None = None
        self._last_s = self._drawn_to_s = 0.0
        self._drawn = _nothing()

    def open(self, start_ns: int) -> None:
        """Let the world begin at the start of the session."""
        self._converter.reset()
        self._start_ns, self._last_s, self._drawn_to_s, self._drawn = start_ns, -1.0, 0.0, _nothing()

    def read(self, now_ns: int) -> ImuSamples:
        """Return the samples that were delivered since the last call."""
        start_ns = self._start_ns
        if start_ns is None or now_ns <= start_ns:
            return ImuSamples.none()
        now_s = (now_ns - start_ns) * 1e-9
        self._draw_to(now_s)
        t_s, delivered_s, acceleration, orientation_xyzw = self._drawn
        # Samples come out of the port in order; whoever was away for a second or more gets what it kept.
        ready = int(np.searchsorted(np.maximum.accumulate(delivered_s), now_s, side="right"))
        self._drawn = (t_s[ready:], delivered_s[ready:], acceleration[ready:], orientation_xyzw[ready:])
        # Stamps jitter; what comes out of order is left out, because the filter takes samples in order.
        last_s = np.maximum.accumulate(np.concatenate([[self._last_s], t_s[:ready]]))
        new = np.flatnonzero((t_s[:ready] > last_s[:-1]) & (t_s[:ready] >= now_s - 1.0))
        if not len(new):
            return ImuSamples.none()
        self._last_s = float(t_s[new][-1])
        t_ns = start_ns + np.rint(t_s[new] * 1e9).astype(np.int64)
        return self._converter.convert(t_ns, acceleration[new], orientation_xyzw[new])

    def _draw_to(self, now_s: float) -> None:
        """Have everything drawn that was measured until `now_s`, and some of what comes after."""
        if now_s <= self._drawn_to_s:
            return
        from_s, self._drawn_to_s = max(self._drawn_to_s, now_s - 1.0), now_s + _AHEAD_S
        t_s, acceleration, orientation_xyzw, _ = self._world.imu(self._side, from_s, self._drawn_to_s)
        drawn = (t_s, self._world.imu_delivered_s(self._side, t_s), acceleration, orientation_xyzw)
        self._drawn = tuple(np.concatenate(pair) for pair in zip(self._drawn, drawn, strict=True))

    def close(self) -> None:
        """Leave the world."""
        self._start_ns = None


def _nothing() -> tuple[FloatArray, ...]:
    return np.empty(0), np.empty(0), np.empty((0, 3)), np.empty((0, 4))


def simulated_sensors(rig: Rig, sides: Sequence[Side]) -> dict[Side, SimulatedSource]:
    """Return the sensors of a simulated walker by foot, not yet open; they share one world."""
    world = WalkerWorld.from_rig(rig)
    return {side: SimulatedSource(world, side) for side in sides}
