"""The backward pass of smoothing.

Rauch, Tung and Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA Journal 3(8), 1965:

    G = P F' P⁻¹(next, before),    x ← x + G (x(next) − x(next, before)),    P ← P + G (P(next) − P(next, before)) G'.

A marker that was lost is initialised anew when it comes back. Each of its lives is smoothed by itself, and the last
state of the earlier one is then led to the beginning of the later one (`bridged`), so that what lies between is
interpolated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from rhot.arrays import BoolArray, FloatArray, IndexArray
from rhot_fusion.filter.settings import FilterSettings
from rhot_fusion.filter.state import SHARED, State, Step

_JITTER: float = 1e-13
"""Regularisation that keeps covariances of new markers invertible, m² and m²/s²."""


def backward(steps: Sequence[tuple[Step, BoolArray]], settings: FilterSettings) -> list[State]:
    """Return the smoothed states of the steps."""
    states = [step.after for step, _ in steps]
    # The newest markers' states where they were initialised, by marker; `bridged` connects earlier ones with them.
    starts: dict[int, State] = {}
    for number in range(len(steps) - 2, -1, -1):
        following, new = steps[number + 1]
        later = states[number + 1]
        starts |= dict.fromkeys(np.flatnonzero(new & later.alive).tolist(), later)
        smoothed = _smoothed(steps[number][0].after, following, later, new)
        for marker in [one for one in starts if smoothed.alive[one]]:
            smoothed = bridged(smoothed, marker, starts.pop(marker), settings)
        states[number] = smoothed
    return states


def _smoothed(own: State, following: Step, later: State, new: BoolArray) -> State:
    """Return a state smoothed by a later one, except for markers (M,) that start anew there."""
    both = own.alive & following.before.alive & later.alive & ~new
    if not both.any():
        return own
    rows, every, kept = _rows(both), _rows(own.alive), _rows(own.alive & ~new)
    before = following.before.P[np.ix_(rows, rows)]
    before[np.diag_indices(len(rows))] += _JITTER
    # The shared rotation makes the other markers depend on one that starts anew, but not on where it was before.
    moved = following.transition[np.ix_(rows, kept)] @ own.P[np.ix_(kept, every)]
    gain = np.linalg.solve(before, moved).T
    x, P = own.x.copy(), own.P.copy()
    x[every] += gain @ (later.x - following.before.x)[rows]
    P[np.ix_(every, every)] += gain @ (later.P[np.ix_(rows, rows)] - before) @ gain.T
    return State(own.t_s, x, P, own.weight, own.alive)


def bridged(state: State, marker: int, start: State, settings: FilterSettings) -> State:
    """Return a state with a marker led to where it was initialised anew soon after.

    What followed its initialisation knows nothing of what preceded it, and is used as one observation of it. Where that
    lies beyond the gate, the marker has moved more than was assumed, and its covariance is inflated in proportion.

    Args:
        state: before; smoothed by what other markers did later.
        marker: index among the hand's markers.
        start: smoothed state at the marker's next initialisation.
        settings: of the filter; a `start` that is too late or too uncertain has no effect.
    """
    dt = start.t_s - state.t_s
    bridge = settings.bridge
    # One that was initialised on a ray takes its depth from the hand, like the earlier life: that is no observation.
    if not 0.0 < dt <= bridge.lasts_s or start.spread_m2[marker] > settings.track.loose_m**2:
        return state
    rows = own_rows(marker, len(state.alive))
    F = constant_velocity(dt)
    noise = bridge.scale**2 * np.kron(np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]]), np.eye(3))
    off, other = start.x[rows] - F @ state.x[rows], start.P[np.ix_(rows, rows)] + noise
    across = state.P[:, rows] @ F.T
    inverse = np.linalg.inv(F @ across[rows] + other)
    gain = across @ inverse
    P = state.P - gain @ across.T
    wider = np.ones(len(P))
    wider[rows] = math.sqrt(max(float(off @ inverse @ off) / bridge.gate, 1.0))
    P = wider[:, None] * P * wider
    return State(state.t_s, state.x + gain @ off, 0.5 * (P + P.T), state.weight, state.alive)


def constant_velocity(dt: float) -> FloatArray:
    """Return the transition (6, 6) of a marker's position and velocity over a time, seconds; it may be negative."""
    return np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(3))


def own_rows(marker: int, count: int) -> IndexArray:
    """Return the state rows (6,) of one of `count` markers."""
    three = np.arange(3 * marker, 3 * marker + 3)
    return np.concatenate([three, 3 * count + three])


def _rows(alive: BoolArray) -> IndexArray:
    """Return the state rows of the markers that are alive (M,) and of the shared accelerations."""
    return np.flatnonzero(np.concatenate([np.tile(np.repeat(alive, 3), 2), np.ones(SHARED, dtype=bool)]))
