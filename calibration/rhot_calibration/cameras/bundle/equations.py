"""The cost of bundle adjustment and its normal equations; see `bundle` for the formula."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import cross_matrix, rotation_from_vector
from rhot_calibration.cameras.bundle.lens import LENS_SIZE, project_with_derivatives
from rhot_calibration.cameras.bundle.model import Geometry, Observations, Prior

HUBER = 2.5
"""Residuals above so many σ weigh less."""
_SMALLEST_SIGMA_PX = 1e-3


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
        return max(float(np.sqrt(squares / max(coordinates - free, 0.1 * coordinates, 1.0))), _SMALLEST_SIGMA_PX)

    def cost(self, geometry: Geometry, residuals: FloatArray, sigma: float, robust: bool) -> float:
        """Return what is minimised."""
        distance = np.linalg.norm(residuals, axis=2) / sigma
        terms = np.where(distance <= HUBER, distance**2, 2.0 * HUBER * distance - HUBER**2)
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
