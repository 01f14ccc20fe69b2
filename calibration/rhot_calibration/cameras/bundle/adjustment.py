"""From views and a rough placement to adjusted geometry: what `bundle` needs, built and taken apart by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import cross_matrix, rigid, rotation_from_vector
from rhot_calibration.cameras.bundle.lens import (
    LENS_SIZE,
    Geometry,
    Observations,
    Prior,
    project_with_derivatives,
    residuals_of,
)
from rhot_calibration.cameras.solve.views import Board, BoardView

# Bundle adjustment of cameras, board places and, where asked for, the board's own shape.
#
# Minimised over lenses, camera poses, board poses and corner positions, by Levenberg–Marquardt on the manifold
# (Triggs et al., "Bundle Adjustment – A Modern Synthesis", 1999; R ← exp(δω)·R):
#
#     Σ ρ(|uv − project(lens_c, T_camera_rig,c · T_rig_board,p · X_j)| / σ) + Σ ((q − q_prior) / σ_q)²
#
# with Huber's ρ. σ is re-estimated in every step.
#
# The normal equations are summed view by view. On the thesis's chessboards one step of
# `scipy.optimize.least_squares`, with the same derivatives, took 35 to 60 ms and a problem 40 steps or more; here a
# whole problem takes 50 to 100 ms, and a calibration solves 41 of them. Both found the same focal lengths to 0.1 %.
#
# The corners are released as Strobl and Hirzinger do ("More Accurate Pinhole Camera Calibration with Imperfect Planar
# Target", ICCV Workshops 2011), held by priors in place of three fixed corners.

# The cost of bundle adjustment and its normal equations; see `bundle` for the formula.

HUBER = 2.5
"""Residuals above so many σ weigh less."""


class BundleEquations:
    """Assembles cost and normal equations of one set of observations."""

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
        # Where the numbers of all views go that fall upon one another: parameters a view does not have, −1, go nowhere.
        used = columns >= 0
        self._used, self._used_pairs = used, used[:, :, None] & used[:, None, :]
        self._into = columns[used]
        self._into_pairs = (columns[:, :, None] * self.size + columns[:, None, :])[self._used_pairs]
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
        smallest_sigma_px = 1e-3
        return max(float(np.sqrt(squares / max(coordinates - free, 0.1 * coordinates, 1.0))), smallest_sigma_px)

    def cost(self, geometry: Geometry, residuals: FloatArray, sigma: float) -> float:
        """Return what is minimised."""
        distance = np.linalg.norm(residuals, axis=2) / sigma
        terms = np.where(distance <= HUBER, distance**2, 2.0 * HUBER * distance - HUBER**2)
        total = float(np.sum(terms))
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
        by_camera_turn, by_board_turn = -by_point @ cross_matrix(in_camera), -by_rig @ cross_matrix(turned)
        J = np.concatenate([by_lens, by_camera_turn, by_point, by_board_turn, by_rig], axis=3)
        w = np.where(observations.seen, weights, 0.0)
        flat = J.reshape(len(place), 2 * corner_count, -1)
        weighted_J = J * w[..., None, None]
        weighted = weighted_J.reshape(flat.shape)
        blocks = np.swapaxes(weighted, 1, 2) @ flat
        sides = np.einsum("vrk,vr->vk", weighted, residuals.reshape(len(place), -1))
        summed = np.bincount(self._into_pairs, blocks[self._used_pairs], self.size**2)
        H: FloatArray = np.asarray(summed, np.float64).reshape(self.size, self.size)
        g: FloatArray = np.asarray(np.bincount(self._into, sides[self._used], self.size), np.float64)
        if self._prior.corner_sd is not None:
            by_corner = by_rig @ R_board[:, None]
            # (V, parameters, corners, 3)
            mixed = np.swapaxes(np.swapaxes(weighted_J, 2, 3) @ by_corner, 1, 2)
            for view, columns in enumerate(self._columns):
                used = self._used[view]
                H[columns[used], self._first_corner :] += mixed[view][used].reshape(np.count_nonzero(used), -1)
            weighted_corner = np.swapaxes(by_corner * w[..., None, None], 2, 3)
            corner = (weighted_corner @ by_corner).sum(axis=0)
            rows = self._first_corner + np.arange(3 * corner_count).reshape(corner_count, 3)
            H[rows[:, :, None], rows[:, None, :]] += corner
            g[self._first_corner :] += (weighted_corner @ residuals[..., None]).sum(axis=0).ravel()
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
            camera_R=_rotated(camera_step[:, :3], geometry.camera_R),
            camera_t=geometry.camera_t + camera_step[:, 3:],
            board_R=_rotated(board_step[:, :3], geometry.board_R),
            board_t=geometry.board_t + board_step[:, 3:],
            corners=corners,
        )


def _rotated(vectors: FloatArray, R: FloatArray) -> FloatArray:
    return np.stack([rotation_from_vector(vector) @ each for vector, each in zip(vectors, R, strict=True)])


# Bundle adjustment of cameras, board places and, where asked for, the board's own shape.

_MAX_STEPS = 60
_DONE = 1e-6
"""Relative decrease of the cost that ends the descent."""


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


def adjust(geometry: Geometry, observations: Observations, prior: Prior, *, sigma_px: float = 1.0) -> Bundle:
    """Return the geometry that explains the observations best.

    Args:
        geometry: where to start.
        observations: of the board.
        prior: what is known beforehand.
        sigma_px: standard deviation of a coordinate to start with; it is re-estimated in every step.

    Raises:
        CalibrationError: the views do not determine the parameters.
    """
    problem = BundleEquations(observations, prior, len(geometry.lenses), len(geometry.board_t))
    damping, sigma = 1e-3, sigma_px
    residuals = residuals_of(geometry, observations)
    weights = _weights(residuals, sigma)
    for _ in range(_MAX_STEPS):
        cost = problem.cost(geometry, residuals, sigma)
        H, g = problem.normal_equations(geometry, weights / sigma**2)
        for _attempt in range(12):
            candidate = problem.moved(geometry, _solve(H + damping * np.diag(np.diag(H)), g))
            moved = residuals_of(candidate, observations)
            new_cost = problem.cost(candidate, moved, sigma)
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
        weights = _weights(residuals, sigma)
    weights = _weights(residuals, sigma)
    H, _ = problem.normal_equations(geometry, weights / sigma**2)
    return Bundle(geometry, residuals, weights, sigma, _inverse(H))


def _weights(residuals: FloatArray, sigma: float) -> FloatArray:
    distance = np.linalg.norm(residuals, axis=2)
    weights: FloatArray = np.minimum(1.0, HUBER * sigma / np.maximum(distance, 1e-12))
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

Key = tuple[str, int]
BoardStand = tuple[int, str]
"""Where the board stood: number of the pictures, and a camera's name where that camera's picture is on its own."""

LENS_SD: Final = np.array([0.15, 0.15, 0.04, 0.04, 0.5, 0.7, 0.005, 0.005, 0.2])
"""Standard deviations of what lenses are like: focal lengths and centre as shares of the width, then coefficients."""
_ASPECT_SD: Final = 0.001
"""Pixels are square to about this share."""


@dataclass(frozen=True, slots=True)
class Adjusted:
    """A bundle with its names.

    Attributes:
        cameras: names in order of the geometry.
        places: where the board stood, in order of the geometry.
        keys: (camera, picture number) of each view.
        observations: what was seen.
        bundle: the solution.
        released: whether the shape of the board was estimated.
    """

    cameras: tuple[str, ...]
    places: tuple[BoardStand, ...]
    keys: tuple[Key, ...]
    observations: Observations
    bundle: Bundle
    released: bool

    @property
    def rms_px(self) -> dict[Key, float]:
        """Reprojection RMS of each view, pixels."""
        values = self.bundle.view_rms(self.observations.seen)
        return dict(zip(self.keys, values.tolist(), strict=True))

    def lens(self, camera: str) -> FloatArray:
        """Return the lens (9,) of a camera."""
        lens: FloatArray = self.bundle.geometry.lenses[self.cameras.index(camera)]
        return lens

    def T_camera_rig(self, camera: str) -> FloatArray:
        """Return the pose (4, 4) of a camera."""
        index = self.cameras.index(camera)
        return rigid(self.bundle.geometry.camera_R[index], self.bundle.geometry.camera_t[index])

    def T_rig_board(self, place: BoardStand) -> FloatArray:
        """Return the pose (4, 4) of the board at a place."""
        index = self.places.index(place)
        return rigid(self.bundle.geometry.board_R[index], self.bundle.geometry.board_t[index])

    def total_rms_px(self) -> float:
        """Return the reprojection RMS over all corners, pixels."""
        seen = self.observations.seen
        return float(np.sqrt(np.sum(self.bundle.residuals[seen] ** 2) / max(int(seen.sum()), 1)))


def adjust_views(
    board: Board,
    views: Mapping[Key, BoardView],
    place_of: Mapping[Key, BoardStand],
    lenses: Mapping[str, FloatArray],
    camera_poses: Mapping[str, FloatArray],
    board_poses: Mapping[BoardStand, FloatArray],
    widths: Mapping[str, int],
    *,
    corners: FloatArray | None = None,
    release: bool = False,
    hold: bool = False,
    sigma_px: float = 1.0,
) -> Adjusted:
    """Adjust cameras and places together.

    Args:
        board: what was shown.
        views: by (camera, picture number).
        place_of: at which place each view saw the board.
        lenses: (9,) to start with, by camera; the order of the cameras, the first is the reference.
        camera_poses: T_camera_rig (4, 4) to start with.
        board_poses: T_rig_board (4, 4) to start with.
        widths: of the pictures, pixels.
        corners: (N, 3) to start with, metres; the flat board when not given.
        release: estimate the corners too.
        hold: lenses, cameras and corners are known; estimate only where the board stood.
        sigma_px: spread of the corners to start with.

    Raises:
        CalibrationError: the views do not determine the parameters.
    """
    cameras = tuple(lenses)
    keys = tuple(views)
    places = tuple(dict.fromkeys(place_of[key] for key in keys))
    observations = _observations(
        board, [views[key] for key in keys], keys, cameras, [place_of[key] for key in keys], places
    )
    start = Geometry(
        lenses=np.stack([lenses[name] for name in cameras]),
        camera_R=np.stack([camera_poses[name][:3, :3] for name in cameras]),
        camera_t=np.stack([camera_poses[name][:3, 3] for name in cameras]),
        board_R=np.stack([board_poses[place][:3, :3] for place in places]),
        board_t=np.stack([board_poses[place][:3, 3] for place in places]),
        corners=board.points if corners is None else corners,
    )
    prior = _prior(board, start, cameras, widths, release)
    if hold:
        prior = replace(prior, lens_sd=np.zeros_like(prior.lens_sd), cameras_held=True)
    bundle = adjust(start, observations, prior, sigma_px=sigma_px)
    return Adjusted(cameras, places, keys, observations, bundle, release)


def _observations(
    board: Board,
    seen: Sequence[BoardView],
    keys: Sequence[Key],
    cameras: Sequence[str],
    at: Sequence[BoardStand],
    places: Sequence[BoardStand],
) -> Observations:
    count = board.columns * board.rows
    uv, mask = np.zeros((len(seen), count, 2)), np.zeros((len(seen), count), dtype=bool)
    for row, view in enumerate(seen):
        uv[row, view.ids] = view.corners
        mask[row, view.ids] = True
    place_index = {place: index for index, place in enumerate(places)}
    return Observations(
        camera=np.array([cameras.index(camera) for camera, _ in keys], dtype=np.int64),
        place=np.array([place_index[place] for place in at], dtype=np.int64),
        uv=uv,
        seen=mask,
    )


def _prior(board: Board, start: Geometry, cameras: Sequence[str], widths: Mapping[str, int], release: bool) -> Prior:
    expected = np.zeros_like(start.lenses)
    # Wherever the focal length starts, it is expected there: its prior is only to keep the descent in bounds.
    expected[:, :2] = start.lenses[:, :2].mean(axis=1, keepdims=True)
    expected[:, 2:4] = start.lenses[:, 2:4]
    width = float(np.mean([widths[name] for name in cameras]))
    sd = LENS_SD * np.where(np.arange(9) < 4, width, 1.0)
    if not release:
        return Prior(expected, sd, _ASPECT_SD, board.points, None)
    diagonal = board.square_m * float(np.hypot(board.columns - 1, board.rows - 1))
    # A printed corner lies this share of a square beside its place, standard deviation ….
    in_plane = 0.01 * board.square_m
    # … and this share of the board's diagonal above or below the plane.
    return Prior(expected, sd, _ASPECT_SD, board.points, np.array([in_plane, in_plane, 0.02 * diagonal]))
