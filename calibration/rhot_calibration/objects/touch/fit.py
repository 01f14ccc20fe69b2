"""The object's frame on its tracker, fitted to touches of its faces.

At touch i the tip joint lay at c_i in the device's frame, and its flesh has the radius r_i. With T_device_object =
(R, p) it lies at q_i = Rᵀ · (c_i − p) in the object's frame, and touching face f means

    d_f(q_i) = r_i + δ,    b_f(q_i) = 0,

where d_f is the distance from the face along its normal, b_f how far q_i lies beyond the face's edges, and δ what pads
of fingers differ from the hand's model, the same for all touches and zero within a millimetre. R, p and δ are the most
probable ones under Gaussian noise (Levenberg–Marquardt). Touches that are far off get less weight (Huber). Several
starts are tried, because nothing is known of R before: planes alone do not tell a box from the same box inside out, the
faces' edges do. What a shape leaves free (a cylinder's rotation about its axis) stays as near to the earlier offset as
it can.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import (
    cross_matrix,
    nearest_rotation,
    rotation_cosine,
    rotation_from_quaternion,
    rotation_from_vector,
)
from rhot.messages import CylinderShape, FacedShape, SphereShape
from rhot_calibration.objects.touch.faces import free_rotations, gaps

TOUCH_SD_M = 0.75e-3
"""Noise of a measured fingertip along any direction: the median error of `rhot evaluate tracking` (1.16 mm,
docs/accuracy.md) over the median length of three standard normal variables, 1.538."""
ACROSS_SD_M, ALONG_SD_M = 0.45e-3, 1.15e-3
"""The same across and along the line of sight, where it is known: as much in all (√(2·0.45² + 1.15²) = √3 · 0.76),
shared out as by cameras, which stand near to one another and see depth worst; 0.2 to 0.35 and 0.7 to 1.1 mm in touches
of `rhot sim --motion touch`."""
FLESH_SD_M = 1e-3
"""How much the pads of fingers differ from the model's radius: they give way by about a millimetre."""

ROTATION, POSITION, FLESH = slice(0, 3), slice(3, 6), 6
"""Parameters: rotation vector (rad) and shift (m), both in the object's axes, and δ (m)."""
PARAMETERS = 7
_STARTS = 60
_FIRST_STEPS, _STEPS = 8, 60
_POLISHED = 6
_HUBER = 2.0
_NOISE_PRIOR = 6.0
"""The stated noise counts like this many residuals when the true noise is estimated from them."""
_SAME_RAD, _SAME_M = np.radians(10.0), 0.01
"""Solutions nearer than this to one another are one."""


@dataclass(frozen=True, slots=True)
class Touch:
    """One touch of a face with the object held still to the finger.

    Attributes:
        face: its name, see `faces_of`.
        tip_device: (3,) the tip joint in the device's frame, metres.
        radius_m: of the flesh about it.
        view_device: (3,) unit vector from the cameras to the tip, device's frame; zero where it is not known.
    """

    face: str
    tip_device: FloatArray
    radius_m: float
    view_device: FloatArray = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True)
class OffsetFit:
    """An object's frame on its device.

    Attributes:
        R_device_object: (3, 3).
        p_device_object: (3,) metres.
        flesh_m: δ.
        residual_m: (N,) distance of each touch's skin from its face: along the normal (positive: the finger is
            outside), or beside its edges, whichever is more.
        cost: sum of squares in units of the stated noise, weighted.
        covariance: (7, 7) of rotation vector (rad), shift (m), both in the object's axes, and δ (m); zero for what the
            shape leaves free; of the noise that the residuals show.
    """

    R_device_object: FloatArray
    p_device_object: FloatArray
    flesh_m: float
    residual_m: FloatArray
    cost: float
    covariance: FloatArray

    @property
    def rms_m(self) -> float:
        """Root mean square residual."""
        return float(np.sqrt(np.mean(np.square(self.residual_m))))

    @property
    def position_sd_m(self) -> float:
        """Standard deviation of the middle along its least certain direction."""
        return _largest_sd(self.covariance[POSITION, POSITION])

    @property
    def rotation_sd_rad(self) -> float:
        """Standard deviation of the rotation about its least certain axis."""
        return _largest_sd(self.covariance[ROTATION, ROTATION])

    def in_object(self, tip_device: FloatArray) -> FloatArray:
        """Return a point (..., 3) of the device's frame in the object's, metres."""
        inside: FloatArray = (tip_device - self.p_device_object) @ self.R_device_object
        return inside


class _Problem:
    """Touches by face, and their residuals with derivatives."""

    def __init__(self, shape: FacedShape, touches: Sequence[Touch]) -> None:
        self.shape = shape
        self.tips = np.array([touch.tip_device for touch in touches])
        self.radii = np.array([touch.radius_m for touch in touches])
        self.views = np.array([touch.view_device for touch in touches])
        self.seen = np.linalg.norm(self.views, axis=1) > 0.0
        self.rows: Mapping[str, FloatArray] = {
            face: np.array([index for index, touch in enumerate(touches) if touch.face == face])
            for face in dict.fromkeys(touch.face for touch in touches)
        }
        self.kept = [index for index in range(PARAMETERS) if index not in free_rotations(shape)]

    def residuals(self, R: FloatArray, p: FloatArray, flesh_m: float) -> tuple[FloatArray, FloatArray]:
        """Return residuals (N, 3) (distance, beside, beside) in units of their noise, and derivatives (N, 3, 7)."""
        e, J = self.distances(R, p, flesh_m)
        along = np.einsum("nik,nk->ni", J[:, :, POSITION], self.views @ R)
        sd = np.sqrt(ACROSS_SD_M**2 + along**2 * (ALONG_SD_M**2 - ACROSS_SD_M**2))
        sd = np.where(self.seen[:, None], sd, TOUCH_SD_M)
        return e / sd, J / sd[..., None]

    def distances(self, R: FloatArray, p: FloatArray, flesh_m: float) -> tuple[FloatArray, FloatArray]:
        """Return the same in metres."""
        q = (self.tips - p) @ R
        e, slopes = np.empty((len(q), 3)), np.empty((len(q), 3, 3))
        for face, rows in self.rows.items():
            found = gaps(self.shape, face, q[rows])
            e[rows, 0] = found.distance_m - self.radii[rows] - flesh_m
            e[rows, 1:] = found.beside_m
            slopes[rows, 0] = found.normals
            slopes[rows, 1:] = found.beside_slopes
        J = np.zeros((len(q), 3, PARAMETERS))
        # R → R · exp(ω) takes q to q − ω × q, a shift by R · τ takes it to q − τ.
        J[:, :, ROTATION] = slopes @ cross_matrix(q)
        J[:, :, POSITION] = -slopes
        J[:, 0, FLESH] = -1.0
        return e, J


def fit_offset(shape: FacedShape, touches: Sequence[Touch], R_before: FloatArray) -> list[OffsetFit]:
    """Return the offsets that explain touches, the most probable one first; the others differ from it by far.

    Args:
        shape: of the object.
        touches: at least one.
        R_before: (3, 3) R_device_object so far: what the shape leaves free is taken from it.

    Raises:
        CalibrationError: there is no touch.
    """
    if not touches:
        raise CalibrationError("no touch was taken; touch the object's faces with the fingertip, one after the other")
    problem = _Problem(shape, touches)
    starts = [R_before, *rotation_from_quaternion(_even_quaternions(_STARTS))]
    middle = problem.tips.mean(axis=0)
    first = sorted((_solved(problem, R, middle, _FIRST_STEPS) for R in starts), key=lambda state: state[0])
    rough: list[OffsetFit] = []
    for state in first:
        _add_other(rough, _described(problem, state, R_before))
    found: list[OffsetFit] = []
    for fit in rough[:_POLISHED]:
        state = _solved(problem, fit.R_device_object, fit.p_device_object, _STEPS, fit.flesh_m)
        _add_other(found, _described(problem, state, R_before))
    return sorted(found, key=lambda fit: fit.cost)


_State = tuple[float, FloatArray, FloatArray, float]
"""Cost, R, p, δ."""


def _solved(problem: _Problem, R: FloatArray, p: FloatArray, steps: int, flesh_m: float = 0.0) -> _State:
    damping = 1e-2
    e, J = problem.residuals(R, p, flesh_m)
    cost, weight = _cost(e, flesh_m)
    kept = problem.kept
    for _ in range(steps):
        A = np.einsum("n,nik,nil->kl", weight, J, J)
        b = np.einsum("n,nik,ni->k", weight, J, e)
        A[FLESH, FLESH] += FLESH_SD_M**-2
        b[FLESH] += flesh_m / FLESH_SD_M**2
        lifted = A + damping * np.diag(np.diag(A)) + 1e-9 * np.eye(PARAMETERS) * np.trace(A)
        step = np.zeros(PARAMETERS)
        step[kept] = -np.linalg.solve(lifted[np.ix_(kept, kept)], b[kept])
        R_new = R @ rotation_from_vector(step[ROTATION])
        p_new = p + R @ step[POSITION]
        flesh_new = flesh_m + float(step[FLESH])
        e_new, J_new = problem.residuals(R_new, p_new, flesh_new)
        cost_new, weight_new = _cost(e_new, flesh_new)
        if cost_new < cost:
            gained = cost - cost_new
            R, p, flesh_m, e, J, cost, weight = R_new, p_new, flesh_new, e_new, J_new, cost_new, weight_new
            damping = max(0.2 * damping, 1e-9)
            if gained < 1e-9 * (1.0 + cost):
                break
        else:
            damping *= 8.0
            if damping > 1e8:
                break
    return cost, nearest_rotation(R), p, flesh_m


def _cost(e: FloatArray, flesh_m: float) -> tuple[float, FloatArray]:
    """Return Huber's cost of residuals (N, 3) in units of their noise, and the weight (N,) of each touch."""
    size = np.linalg.norm(e, axis=1)
    far = size > _HUBER
    cost = np.where(far, 2.0 * _HUBER * size - _HUBER**2, size**2).sum() + (flesh_m / FLESH_SD_M) ** 2
    return float(cost), np.where(far, _HUBER / np.maximum(size, 1e-12), 1.0)


def _add_other(found: list[OffsetFit], fit: OffsetFit) -> None:
    """Add a fit unless one near to it is there; of the two, the more probable one stays."""
    for index, other in enumerate(found):
        apart_m = float(np.linalg.norm(fit.p_device_object - other.p_device_object))
        if apart_m < _SAME_M and rotation_cosine(fit.R_device_object, other.R_device_object) > np.cos(_SAME_RAD):
            if fit.cost < other.cost:
                found[index] = fit
            return
    found.append(fit)


def _described(problem: _Problem, state: _State, R_before: FloatArray) -> OffsetFit:
    cost, R, p, flesh_m = state
    # Before the derivatives, whose axes are the object's.
    R = _with_free_part(problem.shape, R, R_before)
    e, J = problem.residuals(R, p, flesh_m)
    _, weight = _cost(e, flesh_m)
    information = np.einsum("n,nik,nil->kl", weight, J, J)
    information[FLESH, FLESH] += FLESH_SD_M**-2
    # A metre or a radian: what no touch determines comes out as wide as that instead of infinite.
    information += np.eye(PARAMETERS)
    kept = np.ix_(problem.kept, problem.kept)
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    covariance[kept] = np.linalg.inv(information[kept])
    squares = float((weight * np.square(e).sum(axis=1)).sum())
    freedom = max(len(e) - len(problem.kept) + 1, 0)
    # Never below the stated noise: few touches that happen to agree do not make fingers more exact.
    ratio = max((squares + _NOISE_PRIOR) / (freedom + _NOISE_PRIOR), 1.0)
    off, _ = problem.distances(R, p, flesh_m)
    residual = off[np.arange(len(off)), np.argmax(np.abs(off), axis=1)]
    return OffsetFit(R, p, flesh_m, residual, cost, ratio * covariance)


def _with_free_part(shape: FacedShape, R: FloatArray, R_before: FloatArray) -> FloatArray:
    """Return R with what the shape leaves free turned as near to the earlier rotation as it can be."""
    if isinstance(shape, SphereShape):
        return R_before
    if not isinstance(shape, CylinderShape):
        return R
    # The angle φ that maximises trace(R_beforeᵀ · R · Rz(φ)).
    M = R_before.T @ R
    angle = float(np.arctan2(M[0, 1] - M[1, 0], M[0, 0] + M[1, 1]))
    return R @ rotation_from_vector(np.array([0.0, 0.0, angle]))


def _even_quaternions(count: int) -> FloatArray:
    """Return unit quaternions (count, 4) spread evenly over all rotations.

    M. Alexa, "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022, algorithm 1.
    """
    phi, psi = np.sqrt(2.0), 1.533751168755204288118041
    s = np.arange(count) + 0.5
    r, big = np.sqrt(s / count), np.sqrt(1.0 - s / count)
    alpha, beta = 2.0 * np.pi * s / phi, 2.0 * np.pi * s / psi
    spread: FloatArray = np.column_stack([r * np.sin(alpha), r * np.cos(alpha), big * np.sin(beta), big * np.cos(beta)])
    return spread


def _largest_sd(covariance: FloatArray) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
