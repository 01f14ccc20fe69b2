"""The camera's pose on the headset, fitted to views of one marker that lies still while the head moves.

In view i the head was at T_rig_head(i) and corner k of the marker, at c_k in its own frame, was seen at the pixel

    u_ik = π( T_head_camera⁻¹ · T_rig_head(t_i + δ)⁻¹ · T_rig_marker · c_k ) + noise,

with the lens π. Unknown are T_head_camera, T_rig_marker and δ, by which the head's times are off against the pictures'.
This is the robot-world-and-hand-eye problem (Zhuang, Roth, Sudhakar 1994), solved in the pixels in place of the usual
A·X = Z·B, because one picture of a small square tells its tilt badly and with a second, mirrored solution: all views
together have no such choice. The head's own noise moves all four corners of a view alike, so that each view is weighted
by the inverse of its whole covariance (8, 8). Views that are far off get less weight (Huber).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.camera import CameraModel
from rhot.geometry.rotations import cross_matrix, rigid, rotation_from_vector, vector_from_rotation
from rhot.messages.base import wire_position
from rhot.rig import HeadsetFile, Rig, RigidTransform
from rhot.rig.calibration import today
from rhot_calibration.headset.streams import HeadsetView, ViewCollector, first_poses
from rhot_feet.preview import HEAD_POSITION_M, HEAD_ROTATION_RAD

# When the views do not tell where the camera sits, and what to do about it.

FOOT_M: Final = 1.5
"""From a head to its feet."""
LEAST_VIEWS: Final = 40
MOST_ROTATION_SD_RAD: Final = float(np.radians(0.25))
MOST_POSITION_SD_M: Final = 0.006
"""With these a foot is 4 mm off; the thesis's marker stood within 3.0 mm."""
MOST_DEVIATION: Final = 3.0
"""Root mean square of all views, in standard deviations: the head's noise may be three times what is assumed."""
MOST_LEFT_OUT: Final = 0.25
FARTHEST_M: Final = 0.4
"""A camera on a headset is no farther from its middle."""
MOST_TILT_RAD: Final = float(np.radians(15.0))
FLAT_RAD: Final = float(np.radians(2.0))
"""Floors are flatter, and cards that lie on them."""
LATE_S: Final = 0.008
"""At 60 degrees a second the camera has turned by half a degree in that time."""


@dataclass(frozen=True, slots=True)
class Judged:
    """A fit that passed, and what a person should know about it.

    Attributes:
        fit: where the camera sits.
        left_out: views that contradict the others.
        tilt_rad: of the marker against the floor, by `up` of rig.toml.
        notes: sentences.
    """

    fit: HeadsetFit
    left_out: int
    tilt_rad: float
    notes: tuple[str, ...]


def judged(rig: Rig, collector: ViewCollector, size_m: float) -> Judged:
    """Fit the camera's pose to the views that were collected.

    Args:
        rig: with `[feet]`.
        collector: with its views.
        size_m: side of the marker's black square.

    Raises:
        CalibrationError: the views do not tell it; says what to do.
    """
    count = len(collector.views)
    if collector.camera is None or count < LEAST_VIEWS:
        raise CalibrationError(
            f"{count} views of marker {collector.marker_id}; {LEAST_VIEWS} are the least, {collector.wanted} are good. "
            "Lay it flat on the floor before you, well lit, and look at it from all sides for half a minute"
        )
    fit = fit_headset(collector.views, collector.camera, size_m, rig.T_head_camera)
    left_out = int(np.count_nonzero(fit.deviation > 2.0 * HUBER))
    up = np.array((0.0, 1.0, 0.0) if rig.config.feet is None else rig.config.feet.up)
    tilt_rad = float(np.arccos(np.clip(fit.T_rig_marker[:3, 2] @ up / np.linalg.norm(up), -1.0, 1.0)))
    # First this: views that contradict each other make everything uncertain.
    _check_agreement(fit, left_out, size_m)
    _check_motion(fit, collector)
    distance_m = float(np.linalg.norm(fit.T_head_camera[:3, 3]))
    if distance_m > FARTHEST_M:
        raise CalibrationError(
            f"the camera would sit {1e3 * distance_m:.0f} mm from the headset's middle, {1e3 * FARTHEST_M:.0f} are "
            "believable: is rhot/head the pose of this headset, and the marker "
            f"{1e3 * size_m:g} mm large (--size-mm)?"
        )
    if tilt_rad > MOST_TILT_RAD:
        raise CalibrationError(
            f"the marker would lie tilted by {np.degrees(tilt_rad):.0f}° from the floor: lay it flat, face up, and "
            "check `up` of [feet]: the direction against gravity in the frame of rhot/head"
        )
    return Judged(fit, left_out, tilt_rad, tuple(_notes(fit, left_out, tilt_rad, rig)))


def _check_motion(fit: HeadsetFit, collector: ViewCollector) -> None:
    rotation_sd, position_sd = fit.rotation_sd_rad, fit.position_sd_m
    if np.isfinite(rotation_sd) and rotation_sd <= MOST_ROTATION_SD_RAD and position_sd <= MOST_POSITION_SD_M:
        return
    spread = np.degrees(collector.spread_rad)
    more = f"{' and '.join(collector.lacking)} it more" if collector.lacking else "take more views"
    raise CalibrationError(
        f"too little motion: the camera's rotation is known to {np.degrees(rotation_sd):.2f}° (at most "
        f"{np.degrees(MOST_ROTATION_SD_RAD):g}°) and its position to {1e3 * position_sd:.1f} mm (at most "
        f"{1e3 * MOST_POSITION_SD_M:g} mm). The head nodded by ±{spread[0]:.0f}°, turned by ±{spread[1]:.0f}° and "
        f"tilted by ±{spread[2]:.0f}°: {more}, lean to all sides and bend your knees, with the marker in sight"
    )


def _check_agreement(fit: HeadsetFit, left_out: int, size_m: float) -> None:
    count = len(fit.deviation)
    typical = float(np.sqrt(np.mean(np.minimum(fit.deviation, 2.0 * HUBER) ** 2)))
    if typical <= MOST_DEVIATION and left_out <= MOST_LEFT_OUT * count:
        return
    raise CalibrationError(
        f"views and head contradict each other: {left_out} of {count} are far off, residual {fit.rms_px:.1f} px. Is "
        f"the black square {1e3 * size_m:g} mm wide (--size-mm), did the marker lie still, the headset's tracking "
        "work, and is the camera fixed to the headset?"
    )


def _notes(fit: HeadsetFit, left_out: int, tilt_rad: float, rig: Rig) -> list[str]:
    notes = []
    if left_out:
        notes.append(f"{left_out} views contradict the others and were left out")
    if tilt_rad > FLAT_RAD:
        notes.append(
            f"the marker lay tilted by {np.degrees(tilt_rad):.1f}° from what `up` of [feet] says is level; is the "
            "floor?"
        )
    if abs(fit.delay_s) > LATE_S:
        notes.append(
            f"the head's poses are {1e3 * abs(fit.delay_s):.0f} ms too {'late' if fit.delay_s > 0 else 'early'} "
            "against the pictures; feet of a head that turns will be off"
        )
    before = rig.T_head_camera
    if before is not None:
        angle_rad, distance_m = mounting_error(fit.T_head_camera, before)
        notes.append(
            f"the camera's pose so far was {np.degrees(angle_rad):.2f}° and {1e3 * distance_m:.1f} mm from this"
        )
    return notes


def report_lines(found: Judged) -> tuple[str, ...]:
    """Return what was found, in lines for people."""
    fit = found.fit
    right, up, back = 1e3 * fit.T_head_camera[:3, 3]
    pitch, yaw, roll = np.degrees(camera_angles_rad(fit.T_head_camera))
    return (
        f"residual  {fit.rms_px:.2f} px RMS over {len(fit.deviation) - found.left_out} views",
        f"position  {right:.1f} right, {up:.1f} up, {back:.1f} mm back of the head's middle, "
        f"± {1e3 * fit.position_sd_m:.1f} mm",
        f"pitch     {pitch:.2f}° down, yaw {yaw:.2f}° to the left, roll {roll:.2f}°, "
        f"± {np.degrees(fit.rotation_sd_rad):.2f}°",
        f"at a foot ± {1e3 * fit.foot_sd_m(FOOT_M):.1f} mm, {FOOT_M:g} m away",
        f"marker    flat within {np.degrees(found.tilt_rad):.1f}°; head's poses {1e3 * fit.delay_s:+.1f} ms",
    )


def camera_angles_rad(T_head_camera: FloatArray) -> tuple[float, float, float]:
    """Return pitch (down), yaw (to the left) and roll (clockwise, as the camera sees it), radians.

    T_head_camera = rotation_y(yaw) · rotation_x(−pitch) · diag(1, −1, −1) · rotation_z(roll).
    """
    R = T_head_camera[:3, :3]
    forward = R[:, 2]
    pitch = float(np.arcsin(np.clip(-forward[1], -1.0, 1.0)))
    yaw = float(np.arctan2(-forward[0], -forward[2]))
    level = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    roll = float(np.arctan2(-R[:, 1] @ level, R[:, 0] @ level))
    return pitch, yaw, roll


def headset_file(found: Judged) -> HeadsetFile:
    """Return the file to write."""
    fit = found.fit
    pose = RigidTransform.from_matrix(fit.T_head_camera)
    return HeadsetFile(
        date=today(),
        T_head_camera=pose.model_copy(update={"position": wire_position(np.round(fit.T_head_camera[:3, 3], 6))}),
        quality={
            "views": len(fit.deviation) - found.left_out,
            "left_out": found.left_out,
            "residual_rms_px": round(fit.rms_px, 3),
            "position_sd_mm": round(1e3 * fit.position_sd_m, 3),
            "rotation_sd_deg": round(float(np.degrees(fit.rotation_sd_rad)), 4),
            "foot_sd_mm": round(1e3 * fit.foot_sd_m(FOOT_M), 3),
            "marker_tilt_deg": round(float(np.degrees(found.tilt_rad)), 3),
            "head_delay_ms": round(1e3 * fit.delay_s, 3),
        },
    )


CORNER_PX: Final = 0.15
"""Least noise of a corner along each axis; what `rhot_feet.marker` states for sharp ones is 0.1 to 0.3."""
DELAY_SD_S: Final = 0.02
"""How much the head's times may be off against the pictures': a frame, and a half."""
HUBER: Final = 2.0
"""Standard deviations of a view, as the root of the mean over its 8 coordinates, beyond which it counts less."""
_CAMERA, _MARKER, _DELAY = slice(0, 6), slice(6, 12), 12
_PARAMETERS: Final = 13
_STEP: Final = 1e-6
_MOST_STEPS: Final = 40
_DONE: Final = 1e-9


@dataclass(frozen=True, slots=True)
class HeadsetFit:
    """Where the camera sits.

    Attributes:
        T_head_camera: (4, 4), metres.
        T_rig_marker: (4, 4); the marker's axes are OpenCV's: x right, y up, z out of the paper.
        delay_s: δ: the head's poses are of so much earlier than their stamps say, as the pictures have it.
        residual_px: (N,) root mean square distance of each view's corners.
        deviation: (N,) the same in standard deviations of the view.
        covariance: (13, 13) of rotation (rad, camera's axes) and position (m, head's axes) of the camera, the same of
            the marker, and δ (s); of the noise that the residuals show, where that is more than stated.
    """

    T_head_camera: FloatArray
    T_rig_marker: FloatArray
    delay_s: float
    residual_px: FloatArray
    deviation: FloatArray
    covariance: FloatArray

    @property
    def rms_px(self) -> float:
        """Root mean square residual of all views."""
        return float(np.sqrt(np.mean(self.residual_px**2)))

    @property
    def rotation_sd_rad(self) -> float:
        """Standard deviation of the camera's rotation about its least certain axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[0:3, 0:3])[-1]))

    @property
    def position_sd_m(self) -> float:
        """Standard deviation of the camera's position along its least certain direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:6, 3:6])[-1]))

    def foot_sd_m(self, distance_m: float) -> float:
        """Return by how much a foot at a distance is off because of the camera's pose: one standard deviation."""
        lever = cross_matrix(np.array([0.0, 0.0, -distance_m]))
        J = np.hstack([self.T_head_camera[:3, :3] @ lever, np.eye(3)])
        return float(np.sqrt(np.trace(J @ self.covariance[:6, :6] @ J.T)))


@dataclass(frozen=True, slots=True)
class _State:
    T_head_camera: FloatArray
    T_rig_marker: FloatArray
    delay_s: float = 0.0

    def moved(self, x: FloatArray) -> _State:
        """Return the state after a small change (13,)."""
        return _State(
            _moved(self.T_head_camera, x[_CAMERA]), _moved(self.T_rig_marker, x[_MARKER]), self.delay_s + x[12]
        )


def fit_headset(
    views: Sequence[HeadsetView], camera: CameraModel, size_m: float, guess: FloatArray | None = None
) -> HeadsetFit:
    """Return the most probable pose of the camera on the headset.

    Args:
        views: of the marker from different poses of the head, three at the least.
        camera: the lens; its rig frame is its own.
        size_m: side of the marker's black square.
        guess: (4, 4) T_head_camera as somebody typed it in, one more start.

    Raises:
        CalibrationError: there are too few views, or no pose explains them.
    """
    if len(views) < 3:
        raise CalibrationError(f"{len(views)} views of the marker; three are the least, and forty are good")
    half = 0.5 * size_m
    square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])
    problem = _Problem(views, camera, square)
    state = _State(*first_poses(views, camera, square, guess))
    # Weights first of the corners alone, then with the head's noise at the pose that those gave.
    for whiteners in (problem.corner_whiteners(), None):
        state, J, scaled = _refined(problem, state, problem.whiteners(state) if whiteners is None else whiteners)
    residual = problem.residuals(state)
    deviation = np.sqrt(np.mean(scaled.reshape(len(views), 8) ** 2, axis=1))
    kept = deviation < 2.0 * HUBER
    freedom = max(1, 8 * int(kept.sum()) - _PARAMETERS)
    noise = max(1.0, float(np.sum(scaled.reshape(len(views), 8)[kept] ** 2)) / freedom)
    A = J.reshape(len(views), 8, _PARAMETERS)[kept].reshape(-1, _PARAMETERS)
    information = A.T @ A
    information[_DELAY, _DELAY] += DELAY_SD_S**-2
    return HeadsetFit(
        state.T_head_camera,
        state.T_rig_marker,
        state.delay_s,
        np.sqrt(np.mean(np.sum(residual.reshape(len(views), 4, 2) ** 2, axis=2), axis=1)),
        deviation,
        noise * np.linalg.pinv(information, hermitian=True),
    )


class _Problem:
    """Views, and the pixels that a state predicts for them."""

    def __init__(self, views: Sequence[HeadsetView], camera: CameraModel, square: FloatArray) -> None:
        self._camera = camera
        self._square = square
        self._seen = np.concatenate([view.corners for view in views])
        self._sigma_px = np.array([max(view.corner_sigma_px, CORNER_PX) for view in views])
        self._R = np.stack([view.T_rig_head[:3, :3] for view in views])
        self._t = np.stack([view.T_rig_head[:3, 3] for view in views])
        self._velocity = np.stack([view.velocity for view in views])
        self.count = len(views)

    def residuals(self, state: _State, head: FloatArray | None = None) -> FloatArray:
        """Return predicted less seen pixels (8 N,); `head` (N, 6) moves each head by rotation vector and shift."""
        moved = state.delay_s * self._velocity if head is None else state.delay_s * self._velocity + head
        R = rotations_from_vectors(moved[:, :3]) @ self._R
        t = self._t + moved[:, 3:]
        marker = self._square @ state.T_rig_marker[:3, :3].T + state.T_rig_marker[:3, 3]
        in_head = np.einsum("nij,nki->nkj", R, marker[None] - t[:, None])
        in_camera = (in_head - state.T_head_camera[:3, 3]) @ state.T_head_camera[:3, :3]
        uv = self._camera.project(in_camera.reshape(-1, 3))
        # Behind the camera there are no pixels; what is far off anyhow is as good.
        difference: FloatArray = np.nan_to_num(uv - self._seen, nan=1e4)
        return difference.ravel()

    def corner_whiteners(self) -> FloatArray:
        """Return (N, 8, 8) of the corners' noise alone."""
        whiteners: FloatArray = np.eye(8) / self._sigma_px[:, None, None]
        return whiteners

    def whiteners(self, state: _State) -> FloatArray:
        """Return (N, 8, 8) that make the residuals of each view independent and of unit variance."""
        base = self.residuals(state)
        covariance = np.eye(8) * self._sigma_px[:, None, None] ** 2
        for axis in range(6):
            head = np.zeros((self.count, 6))
            head[:, axis] = _STEP
            column = ((self.residuals(state, head) - base) / _STEP).reshape(self.count, 8)
            sigma = HEAD_ROTATION_RAD if axis < 3 else HEAD_POSITION_M
            covariance += sigma**2 * column[:, :, None] * column[:, None, :]
        return np.linalg.inv(np.linalg.cholesky(covariance))


def rotations_from_vectors(vectors: FloatArray) -> FloatArray:
    """Return rotations (N, 3, 3) of rotation vectors (N, 3), radians."""
    return np.stack([rotation_from_vector(vector) for vector in vectors])


def _refined(problem: _Problem, state: _State, whiteners: FloatArray) -> tuple[_State, FloatArray, FloatArray]:
    """Return the best state near one, with the whitened derivatives (8 N, 13) and residuals (8 N,) there."""

    def scaled(at: _State) -> FloatArray:
        each = problem.residuals(at).reshape(problem.count, 8, 1)
        whitened: FloatArray = (whiteners @ each).ravel()
        return whitened

    def weights(residual: FloatArray) -> FloatArray:
        off = np.sqrt(np.mean(residual.reshape(problem.count, 8) ** 2, axis=1))
        return np.repeat(np.minimum(1.0, HUBER / np.maximum(off, 1e-12)), 8)

    def cost(residual: FloatArray, at: _State) -> float:
        off = np.sqrt(np.mean(residual.reshape(problem.count, 8) ** 2, axis=1))
        robust = np.where(off <= HUBER, off**2, HUBER * (2.0 * off - HUBER))
        return 8.0 * float(robust.sum()) + (at.delay_s / DELAY_SD_S) ** 2

    return _levenberg(state, scaled, weights, cost)


def _levenberg(
    state: _State,
    scaled: Callable[[_State], FloatArray],
    weights: Callable[[FloatArray], FloatArray],
    cost: Callable[[FloatArray, _State], float],
) -> tuple[_State, FloatArray, FloatArray]:
    residual = scaled(state)
    J = _derivatives(state, residual, scaled)
    now, damping = cost(residual, state), 1e-4
    for _ in range(_MOST_STEPS):
        w = weights(residual)
        A = J.T @ (w[:, None] * J)
        b = J.T @ (w * residual)
        A[_DELAY, _DELAY] += DELAY_SD_S**-2
        b[_DELAY] += state.delay_s * DELAY_SD_S**-2
        step = np.asarray(-np.linalg.solve(A + damping * np.diag(np.diag(A) + 1e-12), b), np.float64)
        moved = state.moved(step)
        then = scaled(moved)
        after = cost(then, moved)
        if after < now:
            done = now - after < _DONE * now
            state, residual, now, damping = moved, then, after, 0.2 * damping
            J = _derivatives(state, residual, scaled)
            if done:
                break
        elif damping > 1e8:
            break
        else:
            damping *= 8.0
    return state, J, residual


def _derivatives(state: _State, residual: FloatArray, scaled: Callable[[_State], FloatArray]) -> FloatArray:
    steps: FloatArray = _STEP * np.eye(_PARAMETERS, dtype=np.float64)
    columns = [(scaled(state.moved(step)) - residual) / _STEP for step in steps]
    return np.stack(columns, axis=1)


def _moved(T: FloatArray, x: FloatArray) -> FloatArray:
    """Return a pose rotated about its own axes by x[:3] and shifted by x[3:] in those of its parent."""
    return rigid(T[:3, :3] @ rotation_from_vector(x[:3]), T[:3, 3] + x[3:])


def mounting_error(T_head_camera: FloatArray, true: FloatArray) -> tuple[float, float]:
    """Return by how much two poses of a camera differ: angle (rad) and distance (m)."""
    turned = vector_from_rotation(true[:3, :3].T @ T_head_camera[:3, :3])
    return float(np.linalg.norm(turned)), float(np.linalg.norm(T_head_camera[:3, 3] - true[:3, 3]))
