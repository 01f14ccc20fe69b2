"""How a body moves that stands still: it sways, and it looks up from its feet now and then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rhot.arrays import FloatArray
from rhot_sim.walker.foot_path import Posture
from rhot_sim.world.motion import bump


def draw_wave(rng: np.random.Generator, band_hz: tuple[float, float]) -> Callable[[FloatArray], FloatArray]:
    """Return a wave of three sines between -1 and 1."""
    rate = 2.0 * np.pi * rng.uniform(*band_hz, 3)
    phase = rng.uniform(0.0, 2.0 * np.pi, 3)

    def wave(t: FloatArray) -> FloatArray:
        value: FloatArray = np.sin(t[:, None] * rate + phase).mean(axis=1)
        return value

    return wave


def swaying(rng: np.random.Generator, *, glances: bool = True) -> Callable[[FloatArray], Posture]:
    """Return a body that sways as nobody can help, and with `glances` looks up from its feet now and then."""
    slow = [draw_wave(rng, (0.1, 0.5)) for _ in range(6)]
    starts = np.cumsum(rng.uniform(4.0, 8.0, 16))
    spells = [(start, start + rng.uniform(0.9, 2.0), rng.uniform(0.35, 0.8)) for start in starts]

    def posture(t: FloatArray) -> Posture:
        held = Posture.upright(len(t))
        wave = np.stack([each(t) for each in slow], axis=-1)
        away = sum((much * bump(t, start, end, 0.35) for start, end, much in spells), np.zeros(len(t)))
        return replace(
            held,
            shift_m=wave[:, :2] * 0.006 + [0.0, 0.055],
            lean_rad=0.22 + wave[:, 2] * 0.01,
            head_rad=wave[:, 3:] * np.radians([2.0, 1.0, 1.0]),
            look=1.0 - away if glances else held.look,
        )

    return posture
