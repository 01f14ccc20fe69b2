"""Tracker space to rig, fitted to places where a marker on a tracked device was measured in both.

At place i the cameras measured the marker at x_i in the rig, and the tracking system the device's pose (R_i, p_i) in
its own space. With the marker at l in the device's frame (the lever arm),

    x_i = R · (R_i · l + p_i − c) + s,        T_rig_tracker = (R, s − R · c)

where c, a fixed point of the tracker's space amid the places, keeps position and rotation apart: s is where c lies in
the rig. The estimate of R, s and l is the most probable one under Gaussian noise and a Gaussian prior (of the lever arm
always, of R and s when an earlier registration is corrected), by Gauss–Newton from Kabsch's solution. Places that the
others contradict get no weight and are named.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rhot.arrays import BoolArray, FloatArray
from rhot.errors import CalibrationError
from rhot.geometry.rotations import nearest_rotation, rotation_from_vector

PARAMETERS = 9
"""Rotation vector (rad, rig frame, applied on the left), position of the centre (m), lever arm (m)."""
ROTATION, POSITION, LEVER = slice(0, 3), slice(3, 6), slice(6, 9)

_STEPS = 50
_ROBUST_STEPS = 30
_CONVERGED = 1e-10
_HUBER = 1.5
_MEDIAN_OF_NORM = 1.538
"""Median length of a vector of three standard normal variables."""
_OUTLIER = 4.5
"""A place further off than this many standard deviations (length of the three together) is left out."""
_LEAST_KEPT = 3
_NOISE_PRIOR = 3.0
"""The stated noise counts like this many residuals when the true noise is estimated from them."""


@dataclass(frozen=True, slots=True)
class Places:
    """N places where the marker was held still.

    Attributes:
        names: for people, such as `places.csv:3`.
        x_rig: (N, 3) metres, rig frame: the marker as the cameras measured it.
        sigma_m: (N,) standard deviation of each coordinate, metres: how well cameras and tracker agree about a place.
        R_space_device: (N, 3, 3) orientation of the device in the tracking system's space.
        p_space_device: (N, 3) metres, its position there.
    """

    names: tuple[str, ...]
    x_rig: FloatArray
    sigma_m: FloatArray
    R_space_device: FloatArray
    p_space_device: FloatArray

    def __len__(self) -> int:
        return len(self.names)

    def marker_in_space(self, lever_m: FloatArray) -> FloatArray:
        """Return the marker (N, 3), metres, tracker space, for a lever arm (3,)."""
        inside: FloatArray = self.R_space_device @ lever_m + self.p_space_device
        return inside


@dataclass(frozen=True, slots=True)
class Estimate:
    """R, s and l with their uncertainty; what a fit returns, and what the next one may start from.

    Attributes:
        R_rig_tracker: (3, 3).
        center_space: (3,) c, metres, tracker space.
        center_rig: (3,) s, metres, rig frame.
        lever_m: (3,) l, metres, device frame.
        covariance: (9, 9) of rotation vector (rad, rig frame), s (m) and l (m); infinite variances = not known.
    """

    R_rig_tracker: FloatArray
    center_space: FloatArray
    center_rig: FloatArray
    lever_m: FloatArray
    covariance: FloatArray

    @property
    def t_rig_tracker(self) -> FloatArray:
        """(3,) metres: origin of the tracker's space in the rig."""
        t: FloatArray = self.center_rig - self.R_rig_tracker @ self.center_space
        return t

    @property
    def rotation_sd_rad(self) -> float:
        """Standard deviation of the rotation about its least certain axis."""
        return _largest_sd(self.covariance[ROTATION, ROTATION])

    @property
    def position_sd_m(self) -> FloatArray:
        """(3,) standard deviation of the centre's position in the rig, along the rig's axes."""
        return np.sqrt(np.diag(self.covariance)[POSITION])

    @property
    def lever_sd_m(self) -> FloatArray:
        """(3,) standard deviation of the lever arm, along the device's axes."""
        return np.sqrt(np.diag(self.covariance)[LEVER])

    def to_rig(self, points: FloatArray) -> FloatArray:
        """Return points (N, 3) of the tracker's space in the rig, metres."""
        inside: FloatArray = (points - self.center_space) @ self.R_rig_tracker.T + self.center_rig
        return inside

    def moved(self, step: FloatArray) -> Estimate:
        """Return the estimate after a step (9,) of its parameters."""
        return replace(
            self,
            R_rig_tracker=rotation_from_vector(step[ROTATION]) @ self.R_rig_tracker,
            center_rig=self.center_rig + step[POSITION],
            lever_m=self.lever_m + step[LEVER],
        )

    def offset_from(self, other: Estimate) -> FloatArray:
        """Return the step (9,) from another estimate with the same centre to this one, to first order in rotation."""
        R = self.R_rig_tracker @ other.R_rig_tracker.T
        rotation = 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        return np.concatenate([rotation, self.center_rig - other.center_rig, self.lever_m - other.lever_m])


@dataclass(frozen=True, slots=True)
class RegistrationFit:
    """A registration and how well it fits.

    Attributes:
        estimate: with the covariance that the residuals bear out.
        residual_m: (N,) distance of each measured position from the fitted one, metres, left-out ones too.
        kept: (N,) which places were used.
        noise_ratio: estimated over stated noise of the places.
    """

    estimate: Estimate
    residual_m: FloatArray
    kept: BoolArray
    noise_ratio: float

    @property
    def rms_m(self) -> float:
        """Root mean square of the residuals of the places that were used, metres."""
        return float(np.sqrt(np.mean(np.square(self.residual_m[self.kept]))))


def first_prior(places: Places, lever_m: FloatArray, lever_sd_m: float) -> Estimate:
    """Return where a fit without an earlier registration starts: Kabsch's solution, and nothing known but the lever."""
    inside = places.marker_in_space(lever_m)
    center_space, center_rig = inside.mean(axis=0), places.x_rig.mean(axis=0)
    R = nearest_rotation((places.x_rig - center_rig).T @ (inside - center_space))
    covariance = np.diag([np.inf] * 6 + [lever_sd_m**2] * 3)
    return Estimate(R, center_space, center_rig, lever_m, covariance)


def fit_registration(places: Places, prior: Estimate) -> RegistrationFit:
    """Fit a registration.

    Args:
        places: as measured; what cannot be fitted is refused by `checks` before and after.
        prior: where to start and what is known beforehand (infinite variances = nothing).

    Raises:
        CalibrationError: the places contradict each other, so that no three of them agree.
    """
    weight, estimate = np.ones(len(places)), prior
    for _ in range(_ROBUST_STEPS):
        estimate = _solve(places, prior, weight, estimate)
        size = _normalised(places, estimate)
        # The spread of the middle half: not moved by what is to be found with it.
        scale = max(1.0, float(np.median(size)) / _MEDIAN_OF_NORM)
        before, weight = weight, np.minimum(1.0, _HUBER * scale * _MEDIAN_OF_NORM / np.maximum(size, 1e-12))
        if np.abs(weight - before).max() < 1e-3:
            break
    kept = size <= _OUTLIER * scale
    if np.count_nonzero(kept) < min(_LEAST_KEPT, len(places)):
        raise CalibrationError(
            f"of the {len(places)} places no {min(_LEAST_KEPT, len(places))} agree with each other: is the marker "
            "fixed to this very device, and was it held still at each place?"
        )
    estimate = _solve(places, prior, kept.astype(np.float64), estimate)
    ratio = _noise_ratio(places, prior, estimate, kept)
    # With the noise that was found, not the stated one: the prior's share depends on it.
    scaled = replace(places, sigma_m=places.sigma_m * ratio)
    estimate = _solve(scaled, prior, kept.astype(np.float64), estimate)
    residual = np.linalg.norm(_residual(places, estimate), axis=1)
    return RegistrationFit(estimate, residual, kept, ratio)


def free_scale(places: Places, fit: RegistrationFit) -> tuple[float, float]:
    """Return the factor from tracker lengths to rig lengths that would fit best, and its standard deviation.

    A factor other than 1 means that cameras and tracker disagree about the metre.
    """
    estimate = fit.estimate
    used = _subset(places, fit.kept)
    sigma = used.sigma_m * fit.noise_ratio
    arms = (used.marker_in_space(estimate.lever_m) - estimate.center_space) @ estimate.R_rig_tracker.T
    J = np.concatenate([_jacobian(used, estimate), arms[:, :, None]], axis=2) / sigma[:, None, None]
    e = _residual(used, estimate) / sigma[:, None]
    prior = np.zeros((PARAMETERS + 1, PARAMETERS + 1))
    prior[LEVER, LEVER] = np.eye(3) * 1e2  # a lever arm of 0.1 m at most: what is not determined stays where it is
    information = np.einsum("nik,nil->kl", J, J) + prior
    covariance = np.linalg.pinv(information, hermitian=True)
    step = -covariance @ np.einsum("nik,ni->k", J, e)
    return 1.0 + float(step[-1]), float(np.sqrt(covariance[-1, -1]))


def _subset(places: Places, kept: BoolArray) -> Places:
    return Places(
        tuple(name for name, keep in zip(places.names, kept, strict=True) if keep),
        places.x_rig[kept],
        places.sigma_m[kept],
        places.R_space_device[kept],
        places.p_space_device[kept],
    )


def _solve(places: Places, prior: Estimate, weight: FloatArray, start: Estimate) -> Estimate:
    """Return the most probable estimate (Gauss–Newton) with the covariance of stated noise and prior."""
    prior_information = _information(prior.covariance)
    estimate = start
    share = np.sqrt(weight) / places.sigma_m
    information = prior_information
    for _ in range(_STEPS):
        J = _jacobian(places, estimate) * share[:, None, None]
        e = _residual(places, estimate) * share[:, None]
        information = prior_information + np.einsum("nik,nil->kl", J, J)
        gradient = np.einsum("nik,ni->k", J, e) + prior_information @ estimate.offset_from(prior)
        step = -np.linalg.pinv(information, rcond=1e-15, hermitian=True) @ gradient
        estimate = estimate.moved(step)
        if np.abs(step).max() < _CONVERGED:
            break
    return replace(
        estimate, covariance=np.asarray(np.linalg.pinv(information, rcond=1e-15, hermitian=True), np.float64)
    )


def _information(covariance: FloatArray) -> FloatArray:
    known = np.isfinite(np.diag(covariance))
    information = np.zeros_like(covariance)
    information[np.ix_(known, known)] = np.linalg.inv(covariance[np.ix_(known, known)])
    return information


def _residual(places: Places, estimate: Estimate) -> FloatArray:
    """Return fitted minus measured position (N, 3), metres, rig frame."""
    difference: FloatArray = estimate.to_rig(places.marker_in_space(estimate.lever_m)) - places.x_rig
    return difference


def _jacobian(places: Places, estimate: Estimate) -> FloatArray:
    """Return the derivative (N, 3, 9) of the residual by the parameters."""
    arms = (places.marker_in_space(estimate.lever_m) - estimate.center_space) @ estimate.R_rig_tracker.T
    J = np.zeros((len(places), 3, PARAMETERS))
    # d(ω × a)/dω = −[a]×
    x, y, z = arms.T
    J[:, 0, 1], J[:, 0, 2] = z, -y
    J[:, 1, 0], J[:, 1, 2] = -z, x
    J[:, 2, 0], J[:, 2, 1] = y, -x
    J[:, :, POSITION] = np.eye(3)
    J[:, :, LEVER] = estimate.R_rig_tracker @ places.R_space_device
    return J


def _normalised(places: Places, estimate: Estimate) -> FloatArray:
    size: FloatArray = np.linalg.norm(_residual(places, estimate), axis=1) / places.sigma_m
    return size


def _noise_ratio(places: Places, prior: Estimate, estimate: Estimate, kept: BoolArray) -> float:
    """Return estimated over stated noise: the residuals' own, held to the stated one where they are few."""
    squares = float(np.square(_normalised(places, estimate)[kept]).sum())
    # Parameters that the prior alone settles cost the residuals nothing.
    share = _information(prior.covariance) @ estimate.covariance
    used = PARAMETERS - float(np.trace(share))
    freedom = max(3.0 * np.count_nonzero(kept) - used, 0.0)
    return float(np.sqrt((squares + _NOISE_PRIOR) / (freedom + _NOISE_PRIOR)))


def _largest_sd(covariance: FloatArray) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
