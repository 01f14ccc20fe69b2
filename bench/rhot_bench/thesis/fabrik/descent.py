"""Damped least squares on the free angles of limited chains, for when joint limits stall FABRIK.

Source: Levenberg–Marquardt on the end's position, damping proportional to the error (Sugihara, "Solvability-unconcerned
inverse kinematics by the Levenberg–Marquardt method", IEEE T-RO 27(5), 2011); angles at a limit that the step would
push further out are held (projected gradient).
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_bench.thesis.fabrik.chains import ABDUCTION, FLEXION, TWIST, Chains

_AT_LIMIT_RAD: Final = 1e-9
"""Rounding: an angle this near to its limit is at it."""


def descend(
    chains: Chains, goal: FloatArray, start: FloatArray, tolerance_m: float, max_iterations: int
) -> tuple[FloatArray, FloatArray, int]:
    """Return the angles (B, n, 3) within the limits nearest to the goal, their error (B,) and the iterations used.

    Args:
        chains: the build.
        goal: (B, 3) metres, base frame, finite.
        start: (B, n, 3) radians, within the limits.
        tolerance_m: stop when all chains are this near.
        max_iterations: stop after this number; also when no chain improves any more.
    """
    count, joints = start.shape[:2]
    low = chains.lowest.reshape(count, -1)
    high = chains.highest.reshape(count, -1)
    angles = start
    points, axes = chains.forward(angles)
    gap = goal - points[:, -1]
    best = np.sqrt((gap * gap).sum(-1))
    best_angles = angles
    caution = np.ones(count)
    used = stale = 0
    while used < max_iterations and best.max() > tolerance_m:
        used += 1
        J = _jacobian(chains, best_angles, points, axes)
        flat = best_angles.reshape(count, -1)
        damping = caution * best**2 * 0.1 + 1e-12
        step = _step(J, gap, damping)
        held = ((flat <= low + _AT_LIMIT_RAD) & (step < 0.0)) | ((flat >= high - _AT_LIMIT_RAD) & (step > 0.0))
        if held.any():
            step = _step(np.where(held[:, None, :], 0.0, J), gap, damping)
        largest = np.abs(step).max(axis=1, keepdims=True)
        # Beyond it the derivatives say little; chosen.
        step = step * np.minimum(1.0, 0.5 / np.maximum(largest, 1e-12))
        angles = chains.clamp(_coupled(chains, (flat + step).reshape(count, joints, 3)))
        trial_points, trial_axes = chains.forward(angles)
        trial_gap = goal - trial_points[:, -1]
        error = np.sqrt((trial_gap * trial_gap).sum(-1))
        better = error < best
        gained = (error < 0.999 * best) & (best > tolerance_m)
        caution = np.where(better, caution * 0.3, caution * 8.0)
        best = np.where(better, error, best)
        best_angles = np.where(better[:, None, None], angles, best_angles)
        points = np.where(better[:, None, None], trial_points, points)
        axes = np.where(better[:, None, None, None], trial_axes, axes)
        gap = np.where(better[:, None], trial_gap, gap)
        stale = 0 if gained.any() else stale + 1
        # Iterations without improvement, each with more damping, before the descent stops.
        if stale == 4:
            break
    return best_angles, best, used


def _step(J: FloatArray, gap: FloatArray, damping: FloatArray) -> FloatArray:
    """Return Jᵀ (J Jᵀ + λ I)⁻¹ gap, (B, 3n)."""
    JT = np.swapaxes(J, 1, 2)
    inner = J @ JT + damping[:, None, None] * np.eye(3)
    step: FloatArray = (JT @ np.linalg.solve(inner, gap[:, :, None]))[..., 0]
    return step


def _jacobian(chains: Chains, angles: FloatArray, points: FloatArray, axes: FloatArray) -> FloatArray:
    """Return the end's derivative by each angle, (B, 3, 3n), metres per radian.

    A coupled hinge counts with its leader.
    """
    count, joints = angles.shape[:2]
    turn_axes = np.empty((count, joints, 3, 3))
    cos_f, sin_f = np.cos(angles[..., FLEXION]), np.sin(angles[..., FLEXION])
    cos_t, sin_t = np.cos(angles[..., TWIST]), np.sin(angles[..., TWIST])
    X, Y, Z = axes[..., 0], axes[..., 1], axes[..., 2]
    # Undo the twist, then the flexion: x is the flexion axis, y of the rest frame the abduction axis.
    flexion_axis = cos_t[..., None] * X - sin_t[..., None] * Y
    up = sin_t[..., None] * X + cos_t[..., None] * Y
    turn_axes[..., FLEXION, :] = -flexion_axis
    turn_axes[..., ABDUCTION, :] = cos_f[..., None] * up + sin_f[..., None] * Z
    turn_axes[..., TWIST, :] = Z
    arm = points[:, -1:, :] - points[:, :-1, :]
    columns = np.cross(turn_axes, arm[:, :, None, :])
    columns *= (chains.highest > chains.lowest)[..., None]
    for joint in range(joints - 1, 0, -1):
        factor = chains.coupling[:, joint]
        tied = np.isfinite(factor)
        if tied.any():
            share = np.where(tied, factor, 0.0)[:, None] * columns[:, joint, FLEXION]
            columns[:, joint - 1, FLEXION] += share
            columns[:, joint, FLEXION] = np.where(tied[:, None], 0.0, columns[:, joint, FLEXION])
    return np.swapaxes(columns.reshape(count, joints * 3, 3), 1, 2)


def _coupled(chains: Chains, angles: FloatArray) -> FloatArray:
    """Let coupled hinges follow their leaders, in place; the leader is clamped first so that both fit."""
    for joint in range(1, angles.shape[1]):
        factor = chains.coupling[:, joint]
        tied = np.isfinite(factor)
        if tied.any():
            before = joint - 1, FLEXION
            leader = np.clip(angles[:, *before], chains.lowest[:, *before], chains.highest[:, *before])
            angles[:, joint, FLEXION] = np.where(tied, np.where(tied, factor, 0.0) * leader, angles[:, joint, FLEXION])
    return angles
