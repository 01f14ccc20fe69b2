"""Jumps of a tracked position: found by what bodies cannot do, and bridged at a speed that they can.

A tracker that loses its map goes on at another position, and may come back. Between two samples its increment i should
be about v·Δt, with v the velocity that was last believed, τ ago; a body changes its velocity by no more than A·τ. An
increment is a jump when

    |i − v·Δt| > n + A·τ·Δt    or    |i| > V·Δt + n,

with noise n, largest acceleration A and largest speed V. τ grows while increments are refused, so that a real kick is
believed at the next sample, while a position that is merely elsewhere costs that one increment. What was jumped is kept
as an offset that shrinks at a speed at which the body could have gone there. When the tracker comes back, so does the
offset, to nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray


@dataclass(frozen=True, slots=True)
class JumpLimits:
    """What a part of the body can do.

    Attributes:
        acceleration: m/s², largest.
        speed: m/s, largest.
        bridging: m/s, at most, at which an offset shrinks.
        noise_m: of a tracker, between two samples.
    """

    acceleration: float
    speed: float
    bridging: float
    noise_m: float = 0.02


FOOT: Final = JumpLimits(acceleration=150.0, speed=8.0, bridging=2.0)
"""The ankle markers of three real walks (`../shared/data/vive_tracker`, motion capture) reach 52 m/s² and 3.1 m/s;
thrice that leaves room for running and kicks. 8 m/s is the swing of a sprinting foot."""
HEAD: Final = JumpLimits(acceleration=60.0, speed=4.0, bridging=1.0)
"""The waists of the same walks reach 11 m/s² and 0.6 m/s; five times that leaves room for nods and dodges."""

_LONGEST_GAP_S: Final = 0.3
"""After a longer pause nothing is known about where a body went."""
_FORGET_S: Final = 0.1
"""A velocity that was believed so long ago says nothing about now."""
_SLOWEST_BRIDGE: Final = 0.25
"""m/s: an offset shrinks at least so fast, however fast the body moves."""


@dataclass(frozen=True, slots=True)
class Bridged:
    """A position without its jumps.

    Attributes:
        position: (3,) metres.
        velocity: (3,) m/s, as last believed.
        bridging: it is away from what the tracker says by more than noise.
        jumped: this very sample jumped.
    """

    position: FloatArray
    velocity: FloatArray
    bridging: bool
    jumped: bool


class JumpBridge:
    """Follows one tracked position.

    Args:
        limits: of the part of the body that wears the tracker.
    """

    def __init__(self, limits: JumpLimits) -> None:
        self._limits = limits
        self._t_ns: int | None = None
        self._believed_ns = 0
        self._measured = np.zeros(3)
        self._velocity = np.zeros(3)
        self._offset = np.zeros(3)
        self.jumps = 0

    def update(self, t_ns: int, position: FloatArray) -> Bridged:
        """Return the position (3,) of a sample, metres, without jumps; samples must not go back in time."""
        before_ns, before = self._t_ns, self._measured
        elapsed_s = 0.0 if before_ns is None else 1e-9 * (t_ns - before_ns)
        if before_ns is not None and elapsed_s <= 0.0:
            return self._bridged(before + self._offset, jumped=False)
        self._t_ns, self._measured = t_ns, position
        if before_ns is None or elapsed_s > _LONGEST_GAP_S:
            self._believed_ns, self._velocity, self._offset = t_ns, np.zeros(3), np.zeros(3)
            return self._bridged(position, jumped=False)
        increment = position - before
        unsure_s = 1e-9 * (t_ns - self._believed_ns)
        if unsure_s > _FORGET_S:
            self._velocity = np.zeros(3)
        jumped = self._is_jump(increment, elapsed_s, unsure_s)
        if jumped:
            self.jumps += 1
            self._offset = self._offset + self._velocity * elapsed_s - increment
        else:
            self._velocity, self._believed_ns = increment / elapsed_s, t_ns
            self._shrink(elapsed_s)
        return self._bridged(position + self._offset, jumped=jumped)

    def _is_jump(self, increment: FloatArray, elapsed_s: float, unsure_s: float) -> bool:
        limits = self._limits
        change_m = float(np.linalg.norm(increment - self._velocity * elapsed_s))
        moved_m = float(np.linalg.norm(increment))
        return (
            change_m > limits.noise_m + limits.acceleration * unsure_s * elapsed_s
            or moved_m > limits.noise_m + limits.speed * elapsed_s
        )

    def _shrink(self, elapsed_s: float) -> None:
        left_m = float(np.linalg.norm(self._offset))
        if left_m == 0.0:
            return
        speed = self._limits.speed - float(np.linalg.norm(self._velocity))
        step_m = elapsed_s * min(max(speed, _SLOWEST_BRIDGE), self._limits.bridging)
        self._offset = self._offset * max(1.0 - step_m / left_m, 0.0)

    def _bridged(self, position: FloatArray, *, jumped: bool) -> Bridged:
        away = float(np.linalg.norm(self._offset)) > self._limits.noise_m
        return Bridged(position, self._velocity, away, jumped)
