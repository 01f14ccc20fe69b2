"""The clock of a simulated camera's node: wrong on purpose, by an amount that follows from seed and name."""

from __future__ import annotations

from rhot.clock import SkewedClock
from rhot.rig.config import SimConfig
from rhot_sim.rig.schedule import clock_error


def node_clock_of(config: SimConfig, camera: str) -> SkewedClock:
    """Return the clock of a simulated camera's node."""
    error = clock_error(camera, config)
    return SkewedClock(error.offset_ns, error.drift_ppm)
