"""Smoothing of the hand estimate, from the samples before and after each moment.

The filter knows of each moment what came before. Going back from the last sample, the smoother (Rauch, Tung & Striebel
1965) moves each state x by what the next one turned out to be: x + P·Fᵀ·P'⁻¹·(smoothed next − expected next), with P'
the covariance that the next sample met. So a finger that was hidden is led to where it came out.

What is particular of the person stays as the filter had it at each moment, and pose and angles are smoothed as given
that. It is learned from errors of model and paint that last, so what later samples say of it is no better: smoothed as
well, it put hands 0.3 mm further off while all tips were seen (`rhot evaluate motion`, develop seeds 0 to 30).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.geometry.rotations import vector_from_rotation
from rhot_ik.hand.filter.filter import HandFilter
from rhot_ik.hand.filter.process import (
    ANGLES,
    ANGULAR_VELOCITY,
    MOTION,
    PERSON,
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    HandState,
)


class Filtered(Protocol):
    """What the filter made of one sample; `HandTrack` is one."""

    @property
    def t_ns(self) -> int:
        """When the sample was true."""
        ...

    @property
    def state(self) -> HandState:
        """The state after it."""
        ...

    @property
    def expected(self) -> HandState | None:
        """The state before it; none where the hand was taken up with it."""
        ...

    @property
    def measured(self) -> BoolArray:
        """(5,) whether each finger was measured by it."""
        ...


def smoothed_states(hand_filter: HandFilter, steps: Sequence[Filtered]) -> list[HandState]:
    """Return the state at each of a row of samples, in order of time, as all of them show it."""
    smoothed = [step.state for step in steps]
    for k in range(len(steps) - 2, -1, -1):
        after = steps[k + 1]
        if after.expected is None or after.expected.keeps is None or after.state.prior_covariance is None:
            continue
        state, dt_s = steps[k].state, (after.t_ns - steps[k].t_ns) / 1e9
        error = np.zeros(SIZE)
        error[MOTION] = _motion_between(after.expected, smoothed[k + 1])
        if dt_s > 0.0:
            met = _given_person(_met(after.expected.P, after.state.prior_covariance, steps[k].measured))
            gain = np.asarray(np.linalg.solve(met, error[MOTION]), dtype=np.float64)
            F = hand_filter.derivative(state, dt_s, after.expected.keeps)[MOTION, MOTION]
            error[MOTION] = _given_person(state.P) @ (F.T @ gain)
        moved = hand_filter.moved(state, error)
        smoothed[k] = dataclasses.replace(moved, angles=hand_filter.clamp(moved.angles))
    return smoothed


def _met(expected: FloatArray, prior: FloatArray, measured: BoolArray) -> FloatArray:
    """Return the covariance (43, 43) that a sample met, as the smoother counts it.

    Where a finger comes out elsewhere than expected, the filter has to take it for one that moves faster than usual. A
    finger that nobody saw before, however, has come there while it was hidden, not in this one step.

    Args:
        expected: (43, 43) without the room that the sample gave the fingers.
        prior: (43, 43) with it.
        measured: (5,) fingers that the sample before it had measured.
    """
    if measured.all():
        return prior
    seen = np.repeat(measured, 4).astype(np.float64)
    met = expected.copy()
    met[ANGLES, ANGLES] += (prior[ANGLES, ANGLES] - expected[ANGLES, ANGLES]) * seen[:, None] * seen
    return met


def _motion_between(expected: HandState, found: HandState) -> FloatArray:
    """Return by how much pose, speeds and angles (32,) are off what was expected."""
    error = np.empty(MOTION.stop)
    error[ROTATION] = vector_from_rotation(expected.R.T @ found.R)
    error[POSITION] = found.p - expected.p
    error[ANGULAR_VELOCITY] = found.angular_velocity - expected.angular_velocity
    error[VELOCITY] = found.velocity - expected.velocity
    error[ANGLES] = found.angles - expected.angles
    return error


def _given_person(P: FloatArray) -> FloatArray:
    """Return the covariance (32, 32) of pose, speeds and angles of somebody who is known."""
    between = P[MOTION, PERSON]
    given: FloatArray = P[MOTION, MOTION] - between @ np.linalg.solve(P[PERSON, PERSON], between.T)
    return given
