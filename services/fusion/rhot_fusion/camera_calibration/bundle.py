"""Bundle adjustment of cameras, board places and, where asked for, the board's own shape.

Minimised over lenses, camera poses, board poses and corner positions, by Levenberg–Marquardt on the manifold
(Triggs et al., "Bundle Adjustment – A Modern Synthesis", 1999; R ← exp(δω)·R):

    Σ ρ(|uv − project(lens_c, T_camera_rig,c · T_rig_board,p · X_j)| / σ) + Σ ((q − q_prior) / σ_q)²

with Huber's ρ. The corners are released as Strobl and Hirzinger do ("More Accurate Pinhole Camera Calibration with
Imperfect Planar Target", ICCV Workshops 2011), held by priors in place of three fixed corners.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rhot.errors import CalibrationError
from rhot.rotations import rotation_from_vector
from rhot_fusion.camera_calibration.lens import LENS_SIZE, project, project_with_derivatives

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_HUBER = 2.5
"""Residuals above so many σ weigh less."""
_MAX_STEPS = 60
_SMALLEST_SIGMA_PX = 1e-3
_DONE = 1e-6
"""Relative decrease of the cost that ends the descent."""


@dataclass(frozen=True, slots=True)
class Observations:
    """V views of the board, padded to its N corners.

    Attributes:
        camera: (V,) index of the camera.
        place: (V,) index of the place at which the board stood.
        uv: (V, N, 2) pixels; 0 where a corner was not seen.
        seen: (V, N) which corners were.
    """

    camera: IntArray
    place: IntArray
    uv: FloatArray
    seen: BoolArray


@dataclass(frozen=True, slots=True)
class Geometry:
    """What is estimated.

    Attributes:
        lenses: (C, 9) in the order of `lens.LENS_NAMES`.
        camera_R: (C, 3, 3) and
        camera_t: (C, 3) metres: T_camera_rig of each camera; the first is the rig frame and stays.
        board_R: (P, 3, 3) and
        board_t: (P, 3) metres: T_rig_board of each place.
        corners: (N, 3) metres, board frame.
    """

    lenses: FloatArray
    camera_R: FloatArray  # noqa: N815
    camera_t: FloatArray
    board_R: FloatArray  # noqa: N815
    board_t: FloatArray
    corners: FloatArray


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known beforehand.

    Attributes:
        lenses: (C, 9) expected parameters.
        lens_sd: (9,) their standard deviations; 0 holds a parameter.
        aspect_sd: standard deviation of fy/fx − 1.
        corners: (N, 3) expected corners, metres.
        corner_sd: (3,) standard deviations along x, y and z, metres; None = the corners are held.
        cameras_held: whether the poses of the cameras are known.
    """

    lenses: FloatArray
    lens_sd: FloatArray
    aspect_sd: float
    corners: FloatArray
    corner_sd: FloatArray | None
    cameras_held: bool = False


@dataclass(frozen=True, slots=True)
class Bundle:
    """A solution.

    Attributes:
        geometry: the estimate.
        residuals: (V, N, 2) observed minus projected, pixels; 0 where not seen.
        weights: (V, N) of the last step, 0 to 1.
        sigma_px: standard deviation of a coordinate, from the residuals.
        covariance: (Q, Q) of all parameters: C·9 lenses, (C − 1)·6 camera motions (δω, δt of T_camera_rig), P·6 board
            motions, N·3 corners when released.
    """

    geometry: Geometry
    residuals: FloatArray
    weights: FloatArray
    sigma_px: float
    covariance: FloatArray

    def view_rms(self, seen: BoolArray) -> FloatArray:
        """Return the root mean square (V,) of each view's residuals (distance, pixels); `seen` is (V, N)."""
        squares = np.where(seen, np.sum(self.residuals**2, axis=2), 0.0)
        rms: FloatArray = np.sqrt(squares.sum(axis=1) / np.maximum(seen.sum(axis=1), 1))
        return rms


def camera_points(geometry: Geometry, observations: Observations) -> FloatArray:
    """Return the corners (V, N, 3) of every view in its camera's frame, metres."""
    place, camera = observations.place, observations.camera
    rig = geometry.corners @ np.swapaxes(geometry.board_R[place], 1, 2) + geometry.board_t[place][:, None]
    points: FloatArray = rig @ np.swapaxes(geometry.camera_R[camera], 1, 2) + geometry.camera_t[camera][:, None]
    return points


def residuals_of(geometry: Geometry, observations: Observations) -> FloatArray:
    """Return observed minus projected pixels (V, N, 2), 0 where a corner was not seen."""
    points = camera_points(geometry, observations)
    error = observations.uv - project(geometry.lenses[observations.camera][:, None], points)
    return np.where(observations.seen[..., None], error, 0.0)


def adjust(
    geometry: Geometry, observations: Observations, prior: Prior, *, sigma_px: float = 1.0, robust: bool = True
) -> Bundle:
    """Return the geometry that explains the observations best.

    Args:
        geometry: where to start.
        observations: of the board.
        prior: what is known beforehand.
        sigma_px: standard deviation of a coordinate to start with; it is estimated anew along the way.
        robust: weigh large residuals down.

    Raises:
        CalibrationError: the views do not determine the parameters.
    """
    problem = _Problem(observations, prior, len(geometry.lenses), len(geometry.board_t))
    damping, sigma = 1e-3, sigma_px
    residuals = residuals_of(geometry, observations)
    weights = _weights(residuals, sigma, robust)
    for _ in range(_MAX_STEPS):
        cost = problem.cost(geometry, residuals, sigma, robust)
        H, g = problem.normal_equations(geometry, weights / sigma**2)
        for _attempt in range(12):
            candidate = problem.moved(geometry, _solve(H + damping * np.diag(np.diag(H)), g))
            moved = residuals_of(candidate, observations)
            new_cost = problem.cost(candidate, moved, sigma, robust)
            if np.isfinite(new_cost) and new_cost <= cost:
                break
            damping *= 6.0
        else:
            break
        geometry, residuals, damping = candidate, moved, max(damping / 8.0, 1e-12)
        settled = abs(problem.sigma(residuals, weights) / sigma - 1.0) < 0.02
        if cost - new_cost < _DONE * cost and settled:
            break
        sigma = problem.sigma(residuals, weights)
        weights = _weights(residuals, sigma, robust)
    weights = _weights(residuals, sigma, robust)
    H, _ = problem.normal_equations(geometry, weights / sigma**2)
    return Bundle(geometry, residuals, weights, sigma, _inverse(H))


def _weights(residuals: FloatArray, sigma: float, robust: bool) -> FloatArray:
    distance = np.linalg.norm(residuals, axis=2)
    if not robust:
        return np.ones_like(distance)
    weights: FloatArray = np.minimum(1.0, _HUBER * sigma / np.maximum(distance, 1e-12))
    return weights


def _solve(H: FloatArray, g: FloatArray) -> FloatArray:
    try:
        # Parameters differ by many orders of magnitude; a unit diagonal keeps the factorisation accurate.
        scale = 1.0 / np.sqrt(np.diag(H))
        step: FloatArray = scale * np.linalg.solve(H * np.outer(scale, scale), scale * g)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(_UNDETERMINED) from error
    return step


def _inverse(H: FloatArray) -> FloatArray:
    try:
        scale = 1.0 / np.sqrt(np.diag(H))
        inverse: FloatArray = np.linalg.inv(H * np.outer(scale, scale)) * np.outer(scale, scale)
    except np.linalg.LinAlgError as error:
        raise CalibrationError(_UNDETERMINED) from error
    return inverse


_UNDETERMINED = (
    "the pictures do not determine the cameras; take more, with the board at other places, nearer and farther, and "
    "tilted by 20 to 40 degrees in all directions"
)


class _Problem:
    """Assembles the normal equations of one set of observations."""

    def __init__(self, observations: Observations, prior: Prior, cameras: int, places: int) -> None:
        self._observations = observations
        self._prior = prior
        self._cameras = cameras
        self._corner_count = observations.uv.shape[1]
        self._first_pose = cameras * LENS_SIZE
        self._first_place = self._first_pose + (cameras - 1) * 6
        self._first_corner = self._first_place + places * 6
        self.size = self._first_corner + (3 * self._corner_count if prior.corner_sd is not None else 0)
        columns = np.full((len(observations.camera), LENS_SIZE + 12), -1, dtype=np.int64)
        columns[:, :LENS_SIZE] = observations.camera[:, None] * LENS_SIZE + np.arange(LENS_SIZE)
        moving = observations.camera > 0
        pose = self._first_pose + (observations.camera[:, None] - 1) * 6 + np.arange(6)
        columns[moving, LENS_SIZE : LENS_SIZE + 6] = pose[moving]
        columns[:, LENS_SIZE + 6 :] = self._first_place + observations.place[:, None] * 6 + np.arange(6)
        self._columns = columns
        held = np.zeros(self.size, dtype=bool)
        held[: self._first_pose] = np.tile(prior.lens_sd == 0.0, cameras)
        held[self._first_pose : self._first_place] = prior.cameras_held
        self._held = held

    def sigma(self, residuals: FloatArray, weights: FloatArray) -> float:
        """Return the standard deviation of a coordinate, from weighted residuals and the degrees of freedom."""
        squares = float(np.sum(weights * np.sum(residuals**2, axis=2)))
        coordinates = 2.0 * float(np.sum(weights[self._observations.seen]))
        # Released corners are held by their prior too; as free parameters they count for part of their number.
        free = self.size - int(np.count_nonzero(self._held))
        return max(float(np.sqrt(squares / max(coordinates - free, 0.1 * coordinates, 1.0))), _SMALLEST_SIGMA_PX)

    def cost(self, geometry: Geometry, residuals: FloatArray, sigma: float, robust: bool) -> float:
        """Return what is minimised."""
        distance = np.linalg.norm(residuals, axis=2) / sigma
        terms = np.where(distance <= _HUBER, distance**2, 2.0 * _HUBER * distance - _HUBER**2)
        total = float(np.sum(terms if robust else distance**2))
        difference, information = self._prior_terms(geometry)
        total += float(np.sum(information * difference**2))
        lenses = geometry.lenses
        return total + float(np.sum(((lenses[:, 1] / lenses[:, 0] - 1.0) / self._prior.aspect_sd) ** 2))

    def _prior_terms(self, geometry: Geometry) -> tuple[FloatArray, FloatArray]:
        """Return prior minus estimate and the information of the prior, (Q,) each."""
        difference, information = np.zeros(self.size), np.zeros(self.size)
        difference[: self._first_pose] = (self._prior.lenses - geometry.lenses).ravel()
        sd = np.tile(self._prior.lens_sd, self._cameras)
        information[: self._first_pose][sd > 0.0] = sd[sd > 0.0] ** -2.0
        if self._prior.corner_sd is not None:
            difference[self._first_corner :] = (self._prior.corners - geometry.corners).ravel()
            information[self._first_corner :] = np.tile(self._prior.corner_sd**-2.0, self._corner_count)
        return difference, information

    def normal_equations(self, geometry: Geometry, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return H (Q, Q) and g (Q,) of H·δ = g, with weights (V, N) in 1/pixels²."""
        observations, corner_count = self._observations, self._corner_count
        place, camera = observations.place, observations.camera
        R_board, R_camera = geometry.board_R[place], geometry.camera_R[camera]
        turned = geometry.corners @ np.swapaxes(R_board, 1, 2)
        rig = turned + geometry.board_t[place][:, None]
        in_camera = rig @ np.swapaxes(R_camera, 1, 2)
        points = in_camera + geometry.camera_t[camera][:, None]
        uv, by_lens, by_point = project_with_derivatives(geometry.lenses[camera][:, None], points)
        residuals = np.where(observations.seen[..., None], observations.uv - uv, 0.0)
        by_rig = by_point @ R_camera[:, None]
        J = np.concatenate([by_lens, -by_point @ _cross(in_camera), by_point, -by_rig @ _cross(turned), by_rig], axis=3)
        w = np.where(observations.seen, weights, 0.0)
        flat = J.reshape(len(place), 2 * corner_count, -1)
        weighted = (J * w[..., None, None]).reshape(flat.shape)
        blocks = np.swapaxes(weighted, 1, 2) @ flat
        sides = np.einsum("vrk,vr->vk", weighted, residuals.reshape(len(place), -1))
        H, g = np.zeros((self.size, self.size)), np.zeros(self.size)
        released = self._prior.corner_sd is not None
        by_corner = by_rig @ R_board[:, None] if released else None
        for view, columns in enumerate(self._columns):
            kept = np.flatnonzero(columns >= 0)
            into = columns[kept]
            H[np.ix_(into, into)] += blocks[view][np.ix_(kept, kept)]
            g[into] += sides[view][kept]
            if by_corner is not None:
                mixed = np.einsum("nik,nil,n->knl", J[view][..., kept], by_corner[view], w[view])
                H[into, self._first_corner :] += mixed.reshape(len(kept), -1)
        if by_corner is not None:
            corner = np.einsum("vnik,vnil,vn->nkl", by_corner, by_corner, w)
            rows = self._first_corner + np.arange(3 * corner_count).reshape(corner_count, 3)
            H[rows[:, :, None], rows[:, None, :]] += corner
            g[self._first_corner :] += np.einsum("vnik,vni,vn->nk", by_corner, residuals, w).ravel()
            H[self._first_corner :, : self._first_corner] = H[: self._first_corner, self._first_corner :].T
        self._add_priors(geometry, H, g)
        return H, g

    def _add_priors(self, geometry: Geometry, H: FloatArray, g: FloatArray) -> None:
        difference, information = self._prior_terms(geometry)
        H[np.diag_indices_from(H)] += information
        g += information * difference
        for camera, lens in enumerate(geometry.lenses):
            ratio = lens[1] / lens[0]
            gradient = np.array([-ratio / lens[0], 1.0 / lens[0]]) / self._prior.aspect_sd
            at = slice(camera * LENS_SIZE, camera * LENS_SIZE + 2)
            H[at, at] += np.outer(gradient, gradient)
            g[at] -= gradient * (ratio - 1.0) / self._prior.aspect_sd
        H[self._held] = 0.0
        H[:, self._held] = 0.0
        H[self._held, self._held] = 1e30
        g[self._held] = 0.0

    def moved(self, geometry: Geometry, step: FloatArray) -> Geometry:
        """Return the geometry after a step (Q,)."""
        lenses = geometry.lenses + step[: self._first_pose].reshape(-1, LENS_SIZE)
        camera_step = np.zeros((self._cameras, 6))
        camera_step[1:] = step[self._first_pose : self._first_place].reshape(-1, 6)
        board_step = step[self._first_place : self._first_corner].reshape(-1, 6)
        corners = geometry.corners
        if self._prior.corner_sd is not None:
            corners = corners + step[self._first_corner :].reshape(-1, 3)
        return replace(
            geometry,
            lenses=lenses,
            camera_R=_turned(camera_step[:, :3], geometry.camera_R),
            camera_t=geometry.camera_t + camera_step[:, 3:],
            board_R=_turned(board_step[:, :3], geometry.board_R),
            board_t=geometry.board_t + board_step[:, 3:],
            corners=corners,
        )


def _turned(vectors: FloatArray, R: FloatArray) -> FloatArray:
    return np.stack([rotation_from_vector(vector) @ each for vector, each in zip(vectors, R, strict=True)])


def _cross(points: FloatArray) -> FloatArray:
    """Return the matrices [p]× (..., 3, 3) of points (..., 3)."""
    matrix = np.zeros((*points.shape, 3))
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    matrix[..., 0, 1], matrix[..., 0, 2] = -z, y
    matrix[..., 1, 0], matrix[..., 1, 2] = z, -x
    matrix[..., 2, 0], matrix[..., 2, 1] = -y, x
    return matrix
