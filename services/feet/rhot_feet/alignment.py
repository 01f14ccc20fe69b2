"""How an inertial sensor sits on its foot and which way its north lies, learnt while the marker is seen.

A sensor knows up, not where the tracking space's axes lie: with z up in both, R_rig_sensor = C·Rz(ψ)·R_world_sensor,
where C is known from the direction of up and the yaw ψ is not. Nor is the lever l from the sensor to the marker, nor
the accelerometer's bias b. Over a stretch of half a second the marker's path x(t), in level axes, is

    x(t) = x₀ + v₀·t + Rz(ψ)·(D(t) − B(t)·b + R_world_sensor(t)·l),   D = ∬(R_world_sensor·f + g),  B = ∬R_world_sensor.

Turned by Rz(−ψ) and with constant and linear parts removed (˜), this is linear in (cos ψ, sin ψ, l, b):

    cos ψ·(x̃, ỹ, 0) + sin ψ·(ỹ, −x̃, 0) − W̃·l + B̃·b = D̃ − (0, 0, z̃),

one least-squares problem over all stretches on the circle cos² + sin² = 1. Lever and bias are eliminated, all yaws are
tried: no start value is needed, so no yaw is too wrong. Stretches in which the foot hardly moves are left out, because
of them the left side is noise.

A foot that swings is often blurred or out of sight, but heels are lifted in front of the camera. So the marker's
orientations count as well: with the mounting M = R_sensor_foot, A_k = Cᵀ·R_rig_foot = Rz(ψ)·R_world_sensor·M. For each
yaw the best M is the rotation nearest to S(ψ) = Σ (Rz(ψ)·R_world_sensor)ᵀ·A_k, and what it leaves is 3·K − tr(Mᵀ·S),
the sum of squared angles. It tells the yaw once the foot has been tilted; both costs are added.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rhot.rotations import nearest_rotation, rotation_from_quaternion
from rhot_feet.imu_sources.samples import ImuSamples
from rhot_feet.inertial import LONGEST_STEP_S
from rhot_feet.zero_velocity import GRAVITY

FloatArray = NDArray[np.float64]

_STRETCH_NS: Final = 500_000_000
_FEWEST: Final = 12
"""Positions in a stretch."""
_LEVER_M: Final = 0.15
"""How far the marker may be expected from the sensor, per axis."""
_BIAS: Final = 0.2
"""How wrong the accelerometer may be expected, m/s² per axis; a BNO080's linear acceleration is good to 0.35."""
_MODEL_M: Final = 0.004
"""What the model leaves unexplained of a marker's place over a stretch, per axis, on top of its own noise."""
_WORST_FIT_M: Final = 0.03
"""A stretch that no yaw explains better than this, root mean square, holds a false marker."""
_MEMORY: Final = 0.97
"""Weight that older stretches keep at each new one: the sensor's north drifts."""
_YAW_ENOUGH_RAD: Final = float(np.radians(8.0))
"""The filter refines the yaw; this is enough for it to start from."""
_MOVED_SIGMAS: Final = 6.0
"""A stretch counts when the marker strays this many standard deviations, root mean square, from a straight line."""
_WORST_SURPRISE: Final = 16.0
"""Mean squared normalised residual above which the stretches do not agree with each other."""
_TURN_RAD: Final = float(np.radians(3.0))
"""Noise of the marker's orientation; more than a single picture's, because that of successive ones is much the same."""
_CIRCLE: Final = np.linspace(-math.pi, math.pi, 720, endpoint=False)
_UNKNOWNS: Final = 8


@dataclass(frozen=True, slots=True)
class Alignment:
    """How a sensor sits, as far as it is known.

    Attributes:
        yaw_rad: ψ, from the sensor's level world to the rig's.
        yaw_sigma_rad: its standard deviation.
        lever: (3,) from the sensor to the foot's origin, metres, sensor frame.
        bias: (3,) of the accelerometer, m/s².
        covariance: (6, 6) of lever and bias.
        M: R_sensor_foot (3, 3), the identity while no orientation of the marker was seen.
        mounted: M was measured.
    """

    yaw_rad: float
    yaw_sigma_rad: float
    lever: FloatArray
    bias: FloatArray
    covariance: FloatArray
    M: FloatArray
    mounted: bool


@dataclass(frozen=True, slots=True)
class _Sighting:
    t_ns: int
    position: FloatArray
    sigma_m: float
    rotation: FloatArray | None


class AlignmentLearner:
    """Learns the alignment of one sensor from its samples and the marker's places."""

    def __init__(self, C: FloatArray) -> None:
        """Set the frame.

        Args:
            C: (3, 3) from level axes (z up) to the rig frame.
        """
        self._C = C
        self._samples: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._sightings: list[_Sighting] = []
        self.forget()

    def forget(self) -> None:
        """Start anew: it is another sensor now, or it was restarted."""
        self._samples.clear()
        self._sightings.clear()
        self._information = _PRIOR.copy()
        self._moment = np.zeros(_UNKNOWNS)
        self._energy = self._rows = 0.0
        # S(ψ) = S[0] + cos ψ·S[1] + sin ψ·S[2], and K.
        self._turned = np.zeros((3, 3, 3))
        self._turns = 0.0
        self._alignment: Alignment | None = None
        self._is_solved = True

    @property
    def alignment(self) -> Alignment | None:
        """What is known; None until the yaw is."""
        if not self._is_solved:
            self._alignment, self._is_solved = self._solve() or self._alignment, True
        return self._alignment

    def imu(self, samples: ImuSamples) -> None:
        """Take samples; a gap ends the stretch."""
        rotations = rotation_from_quaternion(samples.orientation_xyzw)
        for t_ns, force, R in zip(samples.t_ns.tolist(), samples.specific_force, rotations, strict=True):
            if self._samples and t_ns - self._samples[-1][0] > LONGEST_STEP_S * 1e9:
                self._samples.clear()
                self._sightings.clear()
            self._samples.append((t_ns, R @ force, R))
        while self._samples and self._samples[-1][0] - self._samples[0][0] > 4 * _STRETCH_NS:
            self._samples.popleft()

    def marker(self, t_ns: int, position: FloatArray, sigma_m: float, rotation: FloatArray | None) -> bool:
        """Take a believed place (3,) and R_rig_foot (3, 3) of the marker; tell whether anything was learnt."""
        first_ns = self._sightings[0].t_ns if self._sightings else t_ns
        if self._sightings and (t_ns <= self._sightings[-1].t_ns or t_ns - first_ns > 2 * _STRETCH_NS):
            self._sightings.clear()
            first_ns = t_ns
        self._sightings.append(_Sighting(t_ns, position, sigma_m, rotation))
        if t_ns - first_ns < _STRETCH_NS:
            return False
        stretch = self._sightings
        self._sightings = []
        learnt = self._learn_turning(stretch) | self._learn_moving(stretch)
        self._is_solved &= not learnt
        return learnt

    def _learn_turning(self, stretch: list[_Sighting]) -> bool:
        """Take in the orientations of a stretch."""
        times = np.array([sample[0] for sample in self._samples], dtype=np.int64)
        pairs = []
        for sighting in stretch:
            if sighting.rotation is None or not len(times):
                continue
            nearest = int(np.abs(times - sighting.t_ns).argmin())
            if abs(int(times[nearest]) - sighting.t_ns) <= LONGEST_STEP_S * 1e9:
                pairs.append((self._samples[nearest][2], self._C.T @ sighting.rotation))
        if not pairs:
            return False
        B, A = (np.array(rotations) for rotations in zip(*pairs, strict=True))
        self._turned = _MEMORY * self._turned + np.einsum("kji,ajl,klm->aim", B, _TURNS, A)
        self._turns = _MEMORY * self._turns + len(pairs)
        return True

    def _learn_moving(self, stretch: list[_Sighting]) -> bool:
        """Take in the places of a stretch."""
        path = self._path(stretch) if len(stretch) >= _FEWEST else None
        if path is None:
            return False
        rows, values = path
        sigma = math.hypot(_MODEL_M, float(np.mean([sighting.sigma_m for sighting in stretch])))
        if math.sqrt(float(np.mean(rows[:, 0] ** 2))) < _MOVED_SIGMAS * sigma / math.sqrt(3.0):
            return False
        information, moment = rows.T @ rows / sigma**2, rows.T @ values / sigma**2
        alone = np.linalg.solve(information + _PRIOR, moment)
        if math.sqrt(float(np.mean((values - rows @ alone) ** 2))) > _WORST_FIT_M:
            return False
        self._information = _MEMORY * self._information + (1.0 - _MEMORY) * _PRIOR + information
        self._moment = _MEMORY * self._moment + moment
        self._energy = _MEMORY * self._energy + float(values @ values) / sigma**2
        self._rows = _MEMORY * self._rows + len(values)
        return True

    def _path(self, stretch: list[_Sighting]) -> tuple[FloatArray, FloatArray] | None:
        """Return the rows (3n, 8) and values (3n,) of the least squares."""
        if len(self._samples) < 2 or self._samples[0][0] > stretch[0].t_ns:
            return None
        times = np.array([sample[0] for sample in self._samples], dtype=np.int64)
        if times[-1] < stretch[-1].t_ns - LONGEST_STEP_S * 1e9 / 2:
            return None
        origin = stretch[0].t_ns
        t = (times - origin).astype(np.float64) * 1e-9
        at = np.array([(sighting.t_ns - origin) * 1e-9 for sighting in stretch])
        R = np.array([sample[2] for sample in self._samples])
        forces = np.array([sample[1] for sample in self._samples]) - np.array([0.0, 0.0, GRAVITY])
        driven = _twice_integrated(t, np.concatenate([forces, R.reshape(-1, 9)], axis=1), at)
        nearest = R[np.abs(t[None, :] - at[:, None]).argmin(axis=1)]
        x = np.array([sighting.position for sighting in stretch]) @ self._C
        flat = np.zeros((len(at), 3, _UNKNOWNS + 1))
        flat[:, 0, 0], flat[:, 1, 0] = x[:, 0], x[:, 1]
        flat[:, 0, 1], flat[:, 1, 1] = x[:, 1], -x[:, 0]
        flat[:, :, 2:5] = -nearest
        flat[:, :, 5:8] = driven[:, 3:].reshape(-1, 3, 3)
        flat[:, :, 8] = driven[:, :3]
        flat[:, 2, 8] -= x[:, 2]
        columns = flat.reshape(len(at), -1)
        straight = np.stack([np.ones_like(at), at], axis=1)
        columns = columns - straight @ np.linalg.lstsq(straight, columns, rcond=None)[0]
        table = columns.reshape(-1, _UNKNOWNS + 1)
        return table[:, :8], table[:, 8]

    def _solve(self) -> Alignment | None:
        N, m = self._information, self._moment
        covariance = np.linalg.inv(N[2:, 2:])
        gain = N[:2, 2:] @ covariance
        reduced, aim = N[:2, :2] - gain @ N[2:, :2], m[:2] - gain @ m[2:]
        around = np.stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])
        costs = np.einsum("ik,ij,jk->k", around, reduced, around) - 2.0 * aim @ around
        best = int(costs.argmin())
        total = self._energy + float(costs[best]) - float(m[2:] @ covariance @ m[2:])
        if total > _WORST_SURPRISE * max(self._rows, 1.0):
            return None
        costs += (3.0 * self._turns - _fits(self._summed(_CIRCLE))) / _TURN_RAD**2
        best = int(costs.argmin())
        # A parabola through the lowest cost and its neighbours; its curvature is twice the information.
        left, low, right = costs[best - 1], costs[best], costs[(best + 1) % len(costs)]
        spacing = float(_CIRCLE[1] - _CIRCLE[0])
        bend = float(left - 2.0 * low + right)
        if bend <= 0.0:
            return None
        yaw = float(_CIRCLE[best]) + 0.5 * spacing * float(left - right) / bend
        yaw_sigma = spacing * math.sqrt(2.0 / bend)
        if yaw_sigma > _YAW_ENOUGH_RAD:
            return None
        solution = covariance @ (m[2:] - N[2:, :2] @ np.array([math.cos(yaw), math.sin(yaw)]))
        mounted = self._turns > 0.0
        M = nearest_rotation(self._summed(np.array([yaw]))[0]) if mounted else np.eye(3)
        return Alignment(yaw, yaw_sigma, solution[:3], solution[3:], covariance, M, mounted)

    def _summed(self, yaws_rad: FloatArray) -> FloatArray:
        """Return S(ψ) (n, 3, 3) of yaws (n,)."""
        first, second, third = self._turned
        summed: FloatArray = first + np.cos(yaws_rad)[:, None, None] * second + np.sin(yaws_rad)[:, None, None] * third
        return summed


_PRIOR: Final = np.diag(np.r_[np.full(2, 1e-6), np.full(3, _LEVER_M**-2), np.full(3, _BIAS**-2)])


_TURNS: Final = np.array(
    [
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]],
        [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    ]
)
"""Rz(−ψ) = [0] + cos ψ·[1] + sin ψ·[2]."""


def _fits(S: FloatArray) -> FloatArray:
    """Return the greatest tr(Mᵀ·S) (n,) over rotations M for matrices (n, 3, 3)."""
    sizes = np.linalg.svd(S, compute_uv=False)
    fits: FloatArray = sizes[:, 0] + sizes[:, 1] + np.sign(np.linalg.det(S)) * sizes[:, 2]
    return fits


def _twice_integrated(t: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    """Return the double integral (n, k) of values (N, k), straight between times (N,) seconds, at times (n,).

    It starts at the first of the times; what that leaves open is a constant and a linear part.
    """
    h = np.diff(t)[:, None]
    zero = np.zeros((1, values.shape[1]))
    once = np.concatenate([zero, np.cumsum(0.5 * h * (values[1:] + values[:-1]), axis=0)])
    steps = h * once[:-1] + h * h * (2.0 * values[:-1] + values[1:]) / 6.0
    twice = np.concatenate([zero, np.cumsum(steps, axis=0)])
    index = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 1)
    s = (at - t[index])[:, None]
    place: FloatArray = twice[index] + s * once[index] + 0.5 * s * s * values[index]
    return place
