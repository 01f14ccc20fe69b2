"""Estimates how an inertial sensor sits on its foot and where its north lies, while the marker is seen.

A sensor knows up, not where the tracking space's axes lie: with z up in both, R_rig_sensor = C·Rz(ψ)·R_world_sensor,
where C is known from the direction of up and the yaw ψ is not. Nor is the lever l from the sensor to the marker, nor
the accelerometer's bias b. Over a stretch of half a second the marker's path x(t), in level axes, is

    x(t) = x₀ + v₀·t + Rz(ψ)·(D(t) − B(t)·b + R_world_sensor(t)·l),   D = ∬(R_world_sensor·f + g),  B = ∬R_world_sensor.

Rotated by Rz(−ψ) and with constant and linear parts removed (˜), this is linear in (cos ψ, sin ψ, l, b):

    cos ψ·(x̃, ỹ, 0) + sin ψ·(ỹ, −x̃, 0) − W̃·l + B̃·b = D̃ − (0, 0, z̃),

`equations` solves them. Stretches in which the foot hardly moves are left out, because of them the left side
is noise.

A foot that walks is blurred or out of sight while it swings, so there are few such stretches. Its steps from one
stand-still to the next (`steps`) give the same equations with differences instead of ˜. And heels are lifted
in front of the camera, which the marker's orientations show.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot_feet.imu.alignment.equations import PRIOR, UNKNOWNS, Alignment, AlignmentEquations
from rhot_feet.imu.samples import GRAVITY_M_S2, LONGEST_STEP_S, ImuSamples, nearest_sample

_STRETCH_NS: Final = 500_000_000
"""Length of a stretch, and fewest positions in it."""
_SIGHTINGS: Final = 3
"""Of the marker, fewest on each side of a step."""
_SOLVE_EVERY: Final = 3
"""Sightings between two attempts to solve."""

# Steps of a foot from one stand-still to the next, as its sensor measured them and as pictures show their ends.
#
# A walking foot is mostly out of sight or blurred while it swings, but it is seen before and after. A sensor that stood
# at both ends knows the step in its own level axes: with f' = R_world_sensor·f + g, V = ∫f' and D = ∬f' over the
# T seconds in between,
#
#     d = D − ½·T·V,
#
# because the velocity is zero at the end, so that V is the work of an even error of acceleration (tilt and bias), which
# has moved D by half of T·V. One step gives the yaw between the sensor's and the rig's axes to a few degrees.

_GRAVITY: Final = np.array([0.0, 0.0, GRAVITY_M_S2])


@dataclass(frozen=True, slots=True)
class FootStep:
    """A foot's way between two positions where it stood and was seen, through any number of stand-stills unseen.

    Attributes:
        marker_m: (3,) how far the marker moved, metres, axes of the sightings.
        imu_m: (3,) how far the sensor moved, metres, its own level axes.
        d_bias: (3, 3) derivative of −`imu_m` by the accelerometer's bias, s².
        rotation_change: (3, 3) difference of the sensor's orientations, R_world_sensor after minus before.
    """

    marker_m: FloatArray
    imu_m: FloatArray
    d_bias: FloatArray
    rotation_change: FloatArray


@dataclass(slots=True)
class _Stand:
    """A stand-still: when, how the sensor was oriented, how it got here, and where the marker was seen."""

    start_ns: int
    end_ns: int
    R: FloatArray
    imu_m: FloatArray
    d_bias: FloatArray
    whole: bool
    total: FloatArray
    count: int = 0
    used: bool = False

    @property
    def position(self) -> FloatArray:
        mean: FloatArray = self.total / self.count
        return mean


class StepTracker:
    """Follows one sensor from stand-still to stand-still."""

    def __init__(self) -> None:
        # Stand-stills that are remembered.
        self._stands: deque[_Stand] = deque(maxlen=12)
        self.reset()

    def reset(self) -> None:
        """Forget everything: there was a gap, or it is another sensor."""
        self._stands.clear()
        self._t_ns: int | None = None
        self._level = np.zeros((3, 4))
        self._set_off()

    def _set_off(self) -> None:
        self._speed, self._way = np.zeros((3, 4)), np.zeros((3, 4))
        self._duration_s = 0.0
        self._whole = True

    def add_sample(self, t_ns: int, specific_force: FloatArray, R: FloatArray, *, stands: bool) -> None:
        """Add the next sample.

        Args:
            t_ns: of the sample.
            specific_force: (3,) m/s², sensor frame.
            R: (3, 3) R_world_sensor.
            stands: the sensor shows zero velocity.
        """
        # Acceleration, and beside it what a bias adds to it, both in the sensor's level axes.
        level = np.concatenate([(R @ specific_force - _GRAVITY)[:, None], R], axis=1)
        before, self._t_ns = self._t_ns, t_ns
        mean, self._level = 0.5 * (self._level + level), level
        stood = bool(self._stands) and self._duration_s == 0.0
        if stood and stands:
            self._stands[-1].end_ns = t_ns
            return
        if before is not None and (stood or self._duration_s > 0.0):
            h = 1e-9 * (t_ns - before)
            self._way += h * self._speed + (0.5 * h * h) * mean
            self._speed += h * mean
            self._duration_s += h
            # Samples farther apart have others missing between them; the foot swings on meanwhile.
            self._whole &= h <= 0.035
        if stands:
            way = self._way - (0.5 * self._duration_s) * self._speed
            whole = self._whole and 0.0 < self._duration_s <= 1.5
            self._stands.append(_Stand(t_ns, t_ns, R, way[:, 0], way[:, 1:], whole, np.zeros(3)))
            self._set_off()

    def add_marker(self, t_ns: int, position: FloatArray) -> FootStep | None:
        """Add an accepted position (3,) of the marker; return the step that it completes."""
        index = next((k for k, stand in enumerate(self._stands) if stand.start_ns <= t_ns <= stand.end_ns), None)
        if index is None:
            return None
        stand = self._stands[index]
        stand.total, stand.count = stand.total + position, stand.count + 1
        if stand.used or stand.count < _SIGHTINGS:
            return None
        imu_m, d_bias = np.zeros(3), np.zeros((3, 3))
        for k in range(index, 0, -1):
            if not self._stands[k].whole:
                return None
            imu_m, d_bias = imu_m + self._stands[k].imu_m, d_bias + self._stands[k].d_bias
            start = self._stands[k - 1]
            if start.count >= _SIGHTINGS:
                stand.used = True
                return FootStep(stand.position - start.position, imu_m, d_bias, stand.R - start.R)
        return None


@dataclass(frozen=True, slots=True)
class _Sighting:
    t_ns: int
    position: FloatArray
    sigma_m: float


class AlignmentEstimator:
    """Estimates the alignment of one sensor from its samples and the marker's positions."""

    def __init__(self, C: FloatArray, sensor_m: FloatArray) -> None:
        """Set the frame.

        Args:
            C: (3, 3) from level axes (z up) to the rig frame.
            sensor_m: (3,) about where a sensor is worn, foot frame.
        """
        self._C = C
        self._sensor_m = sensor_m
        self._samples: deque[tuple[int, FloatArray, FloatArray]] = deque()
        self._sightings: list[_Sighting] = []
        self._steps = StepTracker()
        self.reset()

    def reset(self) -> None:
        """Start over: it is another sensor now, or it was restarted."""
        self._samples.clear()
        self._sightings.clear()
        self._steps.reset()
        self._equations = AlignmentEquations(self._sensor_m)
        self._alignment: Alignment | None = None
        self._unsolved = 0
        self._stood_ns = 0

    def solve(self, *, at_once: bool = False) -> Alignment | None:
        """Return what is known; None until the yaw is.

        Args:
            at_once: the newest sightings have to be in it, though solving takes its time.
        """
        if self._unsolved >= (1 if at_once else _SOLVE_EVERY):
            self._alignment, self._unsolved = self._equations.solve() or self._alignment, 0
        return self._alignment

    def add_imu_samples(
        self, samples: ImuSamples, rotations: Sequence[FloatArray] | FloatArray, stands: Sequence[bool]
    ) -> None:
        """Add samples, their orientations R_world_sensor (3, 3), and whether each shows zero velocity.

        A gap ends stretch and step.
        """
        for t_ns, force, R, still in zip(samples.t_ns.tolist(), samples.specific_force, rotations, stands, strict=True):
            if self._samples and t_ns - self._samples[-1][0] > LONGEST_STEP_S * 1e9:
                self._samples.clear()
                self._sightings.clear()
                self._steps.reset()
            self._samples.append((t_ns, R @ force, R))
            self._steps.add_sample(t_ns, force, R, stands=still)
            if still:
                self._stood_ns = t_ns
        while self._samples and self._samples[-1][0] - self._samples[0][0] > 4 * _STRETCH_NS:
            self._samples.popleft()

    def add_marker(
        self, t_ns: int, position: FloatArray, sigma_m: float, rotation: FloatArray | None, orientation_sigma_rad: float
    ) -> None:
        """Add an accepted position (3,) and R_rig_foot (3, 3) of the marker, each with its noise per axis."""
        first_ns = self._sightings[0].t_ns if self._sightings else t_ns
        if self._sightings and (t_ns <= self._sightings[-1].t_ns or t_ns - first_ns > 2 * _STRETCH_NS):
            self._sightings.clear()
            first_ns = t_ns
        self._sightings.append(_Sighting(t_ns, position, sigma_m))
        if rotation is not None:
            self._add_orientation(t_ns, rotation, orientation_sigma_rad)
        step = self._steps.add_marker(t_ns, position @ self._C)
        if step is not None:
            self._add_step(step, sigma_m)
        if t_ns - first_ns >= _STRETCH_NS:
            stretch, self._sightings = self._sightings, []
            self._add_stretch(stretch)

    def _add_orientation(self, t_ns: int, rotation: FloatArray, sigma_rad: float) -> None:
        """Add an orientation."""
        nearest = nearest_sample(self._samples, t_ns, itemgetter(0))
        if nearest is None:
            return
        # A sensor mistakes acceleration for tilt: how fast its orientation goes wrong
        # since it stood, and by how much at most (a BNO080 promises 3.5 degrees in motion).
        leans_rad = min(math.radians(10.0) * 1e-9 * max(t_ns - self._stood_ns, 0), math.radians(4.0))
        sigma_rad = math.hypot(sigma_rad, leans_rad)
        self._equations.add_orientation(t_ns, nearest[2], self._C.T @ rotation, sigma_rad)
        self._unsolved += 1

    def _add_step(self, step: FootStep, sigma_m: float) -> None:
        """Add a step."""
        x, y, z = step.marker_m.tolist()
        length_m = math.hypot(x, y)
        # A step that differs by more between pictures and sensor holds a
        # false marker.
        room_m = 0.06 + 0.15 * length_m
        imu_m = math.hypot(step.imu_m[0], step.imu_m[1])
        # Shortest and longest step that is used; after longer the sensor alone has lost
        # its way.
        if length_m < 0.12 or abs(length_m - imu_m) > room_m or abs(z - step.imu_m[2]) > room_m:
            return
        rows, values = np.zeros((3, UNKNOWNS)), step.imu_m.copy()
        rows[:2, :2] = (x, y), (y, -x)
        rows[:, 2:5], rows[:, 5:] = -step.rotation_change, step.d_bias
        values[2] -= z
        self._equations.add_positions(
            # Error of a step by the sensor, per axis: so much, and this share of its
            # length on top.
            rows,
            values,
            math.hypot(0.02 + 0.03 * length_m, sigma_m),
        )
        self._unsolved = _SOLVE_EVERY

    def _add_stretch(self, stretch: list[_Sighting]) -> None:
        """Add the positions of a stretch."""
        path = self._path(stretch) if len(stretch) >= 12 else None
        if path is None:
            return
        rows, values = path
        # What the model leaves unexplained of a position in a stretch, per axis, on top of its own noise.
        sigma = math.hypot(0.004, float(np.mean([sighting.sigma_m for sighting in stretch])))
        # A stretch counts when the marker strays this many standard deviations, root mean square, from a
        # straight line.
        if math.sqrt(float(np.mean(rows[:, 0] ** 2))) < 6.0 * sigma / math.sqrt(3.0):
            return
        information, moment = rows.T @ rows / sigma**2, rows.T @ values / sigma**2
        alone = np.linalg.solve(information + PRIOR, moment)
        # A stretch that no yaw explains better than this, root mean square, holds a false marker.
        if math.sqrt(float(np.mean((values - rows @ alone) ** 2))) <= 0.03:
            self._equations.add_positions(rows, values, sigma)
            self._unsolved = _SOLVE_EVERY

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
        forces = np.array([sample[1] for sample in self._samples]) - np.array([0.0, 0.0, GRAVITY_M_S2])
        driven = _twice_integrated(t, np.concatenate([forces, R.reshape(-1, 9)], axis=1), at)
        nearest = R[np.abs(t[None, :] - at[:, None]).argmin(axis=1)]
        x = np.array([sighting.position for sighting in stretch]) @ self._C
        flat = np.zeros((len(at), 3, UNKNOWNS + 1))
        flat[:, 0, 0], flat[:, 1, 0] = x[:, 0], x[:, 1]
        flat[:, 0, 1], flat[:, 1, 1] = x[:, 1], -x[:, 0]
        flat[:, :, 2:5] = -nearest
        flat[:, :, 5:8] = driven[:, 3:].reshape(-1, 3, 3)
        flat[:, :, 8] = driven[:, :3]
        flat[:, 2, 8] -= x[:, 2]
        columns = flat.reshape(len(at), -1)
        straight = np.stack([np.ones_like(at), at], axis=1)
        columns = columns - straight @ np.linalg.lstsq(straight, columns, rcond=None)[0]
        table = columns.reshape(-1, UNKNOWNS + 1)
        return table[:, :8], table[:, 8]


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
    position: FloatArray = twice[index] + s * once[index] + 0.5 * s * s * values[index]
    return position
