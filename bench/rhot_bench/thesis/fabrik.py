"""The five fingers as one batch of FABRIK chains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.arrays import FloatArray
from rhot_ik.hand.closed_form import FingerGeometry

# Chains of limited joints, many of the same build at once.
#
# A chain hangs at the origin of its own base frame, so limits turn with whatever carries it. Joint k turns the bone
# behind it by
#
#     R_k = R_{k−1} · rest_k · Ry(abduction_k) · Rx(−flexion_k) · Rz(twist_k),    p_{k+1} = p_k + R_k · bone_k
#
# and its build lies in its ranges alone: a hinge leaves only flexion free (its axis is x of its rest frame, which may
# point anywhere), a saddle or knuckle flexion and abduction, a ball all three. Limits of the swing are a rectangle in
# (flexion, abduction): an elliptic cone inside it, tried on recorded hands, forbids a tenth of their true knuckles
# and puts the joints after them 0.2 to 1.3 mm further off (docs/hand.md).

FLEXION: Final = 0
ABDUCTION: Final = 1
TWIST: Final = 2


@dataclass(frozen=True, slots=True)
class Chains:
    """B chains of n joints each.

    Attributes:
        rest: (B, n, 3, 3) rest frame of each joint in the frame of the bone before it.
        bones: (B, n, 3) metres: each bone in the frame of its joint, usually along −z.
        lowest, highest: (B, n, 3) radians: ranges of flexion, abduction and twist; each holds 0.
        coupling: (B, n) a hinge follows the hinge before it by this factor; NaN where it is free.
    """

    rest: FloatArray
    bones: FloatArray
    lowest: FloatArray
    highest: FloatArray
    coupling: FloatArray

    @property
    def count(self) -> int:
        """Number of joints n of each chain."""
        return int(self.bones.shape[1])

    @property
    def lengths(self) -> FloatArray:
        """(B, n) metres."""
        found: FloatArray = np.sqrt((self.bones**2).sum(-1))
        return found

    def clamp(self, angles: FloatArray) -> FloatArray:
        """Return angles (B, n, 3) brought inside the limits; what is not a number becomes the nearest to 0."""
        finite = np.nan_to_num(angles, nan=0.0)
        return np.clip(finite, self.lowest, self.highest)

    def forward(self, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return points (B, n + 1, 3), metres, and axes (B, n, 3, 3) of the bones, both in the base frame."""
        points = np.zeros((len(angles), self.count + 1, 3))
        axes = np.empty((len(angles), self.count, 3, 3))
        turns = joint_rotations(angles)
        for joint in range(self.count):
            frame = self.rest[:, joint] if joint == 0 else axes[:, joint - 1] @ self.rest[:, joint]
            axes[:, joint] = frame @ turns[:, joint]
            points[:, joint + 1] = points[:, joint] + (axes[:, joint] @ self.bones[:, joint, :, None])[..., 0]
        return points, axes


def joint_rotations(angles: FloatArray) -> FloatArray:
    """Return Ry(abduction) · Rx(−flexion) · Rz(twist), (..., 3, 3), of angles (..., 3)."""
    cos, sin = np.cos(angles), np.sin(angles)
    cf, ca, ct = cos[..., 0], cos[..., 1], cos[..., 2]
    sf, sa, st = sin[..., 0], sin[..., 1], sin[..., 2]
    R = np.empty((*angles.shape[:-1], 3, 3))
    R[..., 0, 0] = ca * ct - sa * sf * st
    R[..., 0, 1] = -ca * st - sa * sf * ct
    R[..., 0, 2] = sa * cf
    R[..., 1, 0] = cf * st
    R[..., 1, 1] = cf * ct
    R[..., 1, 2] = sf
    R[..., 2, 0] = -sa * ct - ca * sf * st
    R[..., 2, 1] = sa * st - ca * sf * ct
    R[..., 2, 2] = ca * cf
    return R


# FABRIK with joint limits, for many chains of the same build at once.
#
# Each iteration runs backward from the target on points alone and forward from the base on angles: the forward pass
# turns every joint towards its point, clamps the angles, and places the next point by forward kinematics. What comes
# out is therefore always a pose within the limits with exact bone lengths, whatever the target.
#
# Joint limits can stall these passes short of a target that is in reach, and coupled hinges slow them down. Chains that
# no longer gain are therefore finished by damped least squares on the angles that are not held at a limit
# (`rhot_bench.thesis.fabrik`); the nearest pose seen is returned.
#
# Source: Aristidou & Lasenby, "FABRIK: a fast, iterative solver for the inverse kinematics problem", Graphical Models
# 73, 2011; limits as in Aristidou, Chrysanthou & Lasenby, "Extending FABRIK with model constraints", 2016.

# Damped least squares on the free angles of limited chains, for when joint limits stall FABRIK.
#
# Source: Levenberg–Marquardt on the end's position, damping proportional to the error (Sugihara, "Solvability-
# unconcerned inverse kinematics by the Levenberg–Marquardt method", IEEE T-RO 27(5), 2011); angles at a limit that
# the step would push further out are held (projected gradient).

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


# FABRIK with joint limits, for many chains of the same build at once.

_TINY_M: Final = 1e-9
_STALL: Final = 0.8
"""An iteration that leaves more than this share of the error is not worth another one."""
_LATERAL_DAMPING_M: Final = 0.003
"""Abduction of a chain whose target lies this near to the abduction axis is not determined by it any more."""


@dataclass(frozen=True, slots=True)
class ChainPose:
    """What the solver found.

    Attributes:
        angles: (B, n, 3) radians, inside the limits.
        points: (B, n + 1, 3) metres, base frame; the last is the end of the chain.
        error: (B,) metres between the end and the target.
        iterations: how many were run.
    """

    angles: FloatArray
    points: FloatArray
    error: FloatArray
    iterations: int


def solve(
    chains: Chains, targets: FloatArray, start: FloatArray, tolerance_m: float = 1e-4, max_iterations: int = 24
) -> ChainPose:
    """Bring the ends of all chains as near to their targets as the limits allow.

    Args:
        chains: the build.
        targets: (B, 3) metres, base frame of each chain; anything, also out of reach or not finite (then the chain
            keeps its start).
        start: (B, n, 3) radians, usually the last solution.
        tolerance_m: stop when all chains are this near.
        max_iterations: stop then in any case; the best pose seen is returned.
    """
    usable = np.asarray(np.isfinite(targets).all(axis=-1))
    angles = chains.clamp(start)
    points, axes = chains.forward(angles)
    # Far beyond the reach only the direction matters; this also keeps huge numbers out of the squares.
    reach = chains.lengths.sum(axis=1)
    goal = np.where(usable[:, None], targets, points[:, -1])
    goal = goal / np.maximum(1.0, np.abs(goal).max(axis=1) / (4.0 * reach))[:, None]
    best, best_angles = _distance(points, goal), angles
    iteration = 0
    while iteration < max_iterations and best.max() > tolerance_m:
        iteration += 1
        wanted = _backward(chains, goal, points, axes)
        angles = _forward(chains, goal, wanted, angles)
        points, axes = chains.forward(angles)
        error = _distance(points, goal)
        gaining = (error < _STALL * best) & (best > tolerance_m)
        better = error < best
        best = np.where(better, error, best)
        best_angles = np.where(better[:, None, None], angles, best_angles)
        if not gaining.any():
            break
    if iteration < max_iterations and best.max() > tolerance_m:
        best_angles, best, used = descend(chains, goal, best_angles, tolerance_m, max_iterations - iteration)
        iteration += used
    # Poses to start again from when limits stall a chain: shares of the range of each flexion.
    for share in (0.35, 0.65, 0.15):
        # Limits can hold a chain in a corner that it would have to leave backwards: try from other poses.
        if iteration >= max_iterations or best.max() <= tolerance_m:
            break
        other, error, used = descend(chains, goal, _eased(chains, share), tolerance_m, max_iterations - iteration)
        iteration += used
        better = error < best - tolerance_m
        best = np.where(better, error, best)
        best_angles = np.where(better[:, None, None], other, best_angles)
    best_points, _ = chains.forward(best_angles)
    error = np.where(usable, _distance(best_points, np.where(usable[:, None], targets, 0.0)), 0.0)
    return ChainPose(best_angles, best_points, error, iteration)


def _eased(chains: Chains, share: float) -> FloatArray:
    """Return angles (B, n, 3) with every flexion at a share of its range and the rest in the middle of theirs."""
    eased = 0.5 * (chains.lowest + chains.highest)
    low, high = chains.lowest[..., FLEXION], chains.highest[..., FLEXION]
    eased[..., FLEXION] = low + share * (high - low)
    return chains.clamp(eased)


def _distance(points: FloatArray, goal: FloatArray) -> FloatArray:
    gap = points[:, -1] - goal
    # Scaled, because the square of a huge target does not fit.
    largest = np.maximum(np.abs(gap).max(axis=1), 1e-300)
    distance: FloatArray = largest * np.sqrt(((gap / largest[:, None]) ** 2).sum(-1))
    return distance


def _backward(chains: Chains, goal: FloatArray, points: FloatArray, axes: FloatArray) -> FloatArray:
    """Return where the points (B, n + 1, 3) should go when the end sits on its goal; limits are left to the way back.

    Each joint first moves with the correction of the one after it and is then pulled to its bone's length.
    """
    lengths = chains.lengths
    wanted = points.copy()
    wanted[:, -1] = goal
    for joint in range(chains.count - 1, 0, -1):
        ray = points[:, joint] - wanted[:, joint + 1]
        distance = np.sqrt((ray * ray).sum(-1, keepdims=True))
        along = -(axes[:, joint] @ chains.bones[:, joint, :, None])[..., 0] / lengths[:, joint, None]
        direction = np.where(distance > _TINY_M, ray / np.maximum(distance, _TINY_M), along)
        wanted[:, joint] = wanted[:, joint + 1] + lengths[:, joint, None] * direction
    return wanted


def _forward(chains: Chains, goal: FloatArray, wanted: FloatArray, previous: FloatArray) -> FloatArray:
    """Return angles within the limits (B, n, 3) that turn each joint from the base on towards its wanted point."""
    angles = previous.copy()
    origin = np.zeros((len(goal), 3))
    parent = np.broadcast_to(np.eye(3), (len(goal), 3, 3))
    for joint in range(chains.count):
        frame = parent @ chains.rest[:, joint]
        bone = chains.bones[:, joint]
        low, high = chains.lowest[:, joint], chains.highest[:, joint]
        towards = _in_frame(frame, wanted[:, joint + 1] - origin)
        turn = angles[:, joint]
        if _is_free(low, high, ABDUCTION):
            # Hinges behind a knuckle all bend in its plane, so the plane has to hold the target itself.
            planar = not _is_free(low, high, TWIST) and joint + 1 < chains.count
            lateral = _in_frame(frame, goal - origin) if planar else towards
            turn[:, ABDUCTION] = _abduction(lateral, bone[:, 0], low[:, ABDUCTION], high[:, ABDUCTION])
        cos_a, sin_a = np.cos(turn[:, ABDUCTION]), np.sin(turn[:, ABDUCTION])
        depth = sin_a * towards[:, 0] + cos_a * towards[:, 2]
        bend = np.arctan2(-towards[:, 1], -depth) - np.arctan2(-bone[:, 1], -bone[:, 2])
        turn[:, FLEXION] = _nearest_in_range(bend, low[:, FLEXION], high[:, FLEXION])
        if _is_free(low, high, TWIST) and joint + 1 < chains.count:
            swing = turn * (1.0, 1.0, 0.0)
            beyond = _in_frame(frame @ joint_rotations(swing), wanted[:, joint + 2] - wanted[:, joint + 1])
            off_axis = np.hypot(beyond[:, 0], beyond[:, 1])
            twist = np.arctan2(beyond[:, 0], -beyond[:, 1])
            within = _nearest_in_range(twist, low[:, TWIST], high[:, TWIST])
            turn[:, TWIST] = np.where(off_axis > 1e-3 * chains.lengths[:, joint + 1], within, turn[:, TWIST])
        if joint > 0:
            factor = chains.coupling[:, joint]
            tied = np.isfinite(factor)
            if tied.any():
                _couple(angles, joint, np.where(tied, factor, 0.0), tied)
        parent = frame @ joint_rotations(turn)
        origin = origin + (parent @ bone[:, :, None])[..., 0]
    return chains.clamp(angles)


def _couple(angles: FloatArray, joint: int, factor: FloatArray, tied: NDArray[np.bool_]) -> None:
    """Move two coupled hinges to the nearest pair (q, factor · q), in place."""
    first, second = angles[:, joint - 1, FLEXION], angles[:, joint, FLEXION]
    common = (first + factor * second) / (1.0 + factor * factor)
    angles[:, joint - 1, FLEXION] = np.where(tied, common, first)
    angles[:, joint, FLEXION] = np.where(tied, factor * common, second)


def _abduction(towards: FloatArray, offset: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the abduction (B,) whose plane comes nearest to a point, damped where the point is on the axis."""
    x, z = towards[:, 0], towards[:, 2]
    angle = np.clip(np.arctan((x - offset) * z / (z * z + _LATERAL_DAMPING_M**2)), low, high)
    for _ in range(2):
        cos, sin = np.cos(angle), np.sin(angle)
        across, along = cos * x - sin * z - offset, sin * x + cos * z
        angle = np.clip(angle + across * along / (along * along + _LATERAL_DAMPING_M**2), low, high)
    return angle


def _nearest_in_range(angle: FloatArray, low: FloatArray, high: FloatArray) -> FloatArray:
    """Return the angle within the limits (B,) nearest to `angle` on the circle."""
    middle = 0.5 * (low + high)
    turned = middle + (angle - middle + np.pi) % (2.0 * np.pi) - np.pi
    return np.clip(turned, low, high)


def _in_frame(frame: FloatArray, vector: FloatArray) -> FloatArray:
    """Return vectors (B, 3) in frames (B, 3, 3): frameᵀ · vector."""
    local: FloatArray = (vector[:, None, :] @ frame)[:, 0, :]
    return local


def _is_free(low: FloatArray, high: FloatArray, angle: int) -> bool:
    return bool((high[:, angle] > low[:, angle]).any())


def finger_chains(geometry: FingerGeometry) -> Chains:
    """Return the chains of a hand in the frames of `FingerGeometry.in_finger_frames`: knuckle, hinge, hinge.

    The knuckle's limits are the rectangle that the hand model states; the last hinge follows the middle one.
    """
    model = geometry.model
    fingers = len(model.bones)
    bones = np.zeros((fingers, 3, 3))
    bones[:, :2, 2] = -model.bones[:, :2]
    bones[:, 2] = geometry.mirrored_ends
    lowest, highest = np.zeros((fingers, 3, 3)), np.zeros((fingers, 3, 3))
    for limits, given in ((lowest, model.angle_min), (highest, model.angle_max)):
        limits[:, :, FLEXION] = given[:, (0, 2, 3)]
        limits[:, 0, ABDUCTION] = given[:, 1]
    coupling = np.full((fingers, 3), np.nan)
    coupling[:, 2] = model.coupling
    rest = np.broadcast_to(np.eye(3), (fingers, 3, 3, 3))
    return Chains(rest, bones, lowest, highest, coupling)


class FabrikFingers:
    """FABRIK on the fingers of one hand; stateless, the start is handed in."""

    def __init__(self, geometry: FingerGeometry) -> None:
        self._geometry = geometry
        self._chains = finger_chains(geometry)

    def solve(
        self, targets: FloatArray, start: FloatArray, tolerance_m: float, max_iterations: int
    ) -> tuple[FloatArray, ChainPose]:
        """Return angles (5, 4), radians, for marker centres (5, 3), metres, wrist frame, and the chains' own result.

        Args:
            targets: a row that is not finite keeps its start.
            start: (5, 4) radians, the last angles.
            tolerance_m: as in `fabrik.solve`.
            max_iterations: as in `fabrik.solve`.
        """
        warm = np.zeros((len(start), 3, 3))
        warm[:, :, FLEXION] = start[:, (0, 2, 3)]
        warm[:, 0, ABDUCTION] = start[:, 1]
        pose = solve(self._chains, self._geometry.in_finger_frames(targets), warm, tolerance_m, max_iterations)
        flexion = pose.angles[:, :, FLEXION]
        angles = np.column_stack([flexion[:, 0], pose.angles[:, 0, ABDUCTION], flexion[:, 1], flexion[:, 2]])
        return angles, pose
