"""Taking places from two live streams: the marker in the rig and the device in its space, when both are held still."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from rhot.arrays import FloatArray
from rhot.geometry.rotations import rotation_from_quaternion
from rhot_calibration.objects.fit import Places
from rhot_calibration.objects.stillness import angle_between, covers, forget_old, held_pose
from rhot_objects.pose import Pose

_ELSEWHERE_M = 0.05


@dataclass(frozen=True, slots=True)
class Place:
    """One place; see `Places` for frames and units."""

    x_rig: FloatArray
    sigma_m: float
    R_space_device: FloatArray
    p_space_device: FloatArray


@dataclass(frozen=True, slots=True)
class _PointSample:
    t_ns: int
    position: FloatArray
    sigma_m: float


@dataclass(frozen=True, slots=True)
class _PoseSample:
    t_ns: int
    position: FloatArray
    R: FloatArray


class PlaceCollector:
    """Watches both streams and takes a place whenever both are still and it differs from the earlier ones.

    Attributes:
        places: taken so far.
    """

    def __init__(self) -> None:
        self.places: list[Place] = []
        self._points: deque[_PointSample] = deque()
        self._poses: deque[_PoseSample] = deque()

    def add_point(self, t_ns: int, position: FloatArray, sigma_m: float) -> Place | None:
        """Take a measured marker position (3,), metres, rig frame, `sigma_m` as in `Point.sigma`."""
        self._points.append(_PointSample(t_ns, position, sigma_m))
        return self._try()

    def add_pose(self, t_ns: int, T_space_device: Pose) -> Place | None:
        """Take a measured device pose, tracker space."""
        R = rotation_from_quaternion(T_space_device.orientation_xyzw)
        self._poses.append(_PoseSample(t_ns, T_space_device.position, R))
        return self._try()

    @property
    def hint(self) -> str:
        """What the person should do now."""
        if not covers(self._points):
            return "the cameras do not see the marker"
        if not covers(self._poses):
            return "the tracking system does not see the device"
        place = self._candidate()
        if place is None:
            return "hold it still"
        return "" if self._is_new(place) else "go to another place, and turn it"

    def to_places(self) -> Places:
        """Return what was taken, for the fit."""
        return Places(
            names=tuple(f"place {number}" for number in range(1, len(self.places) + 1)),
            x_rig=np.array([place.x_rig for place in self.places]).reshape(-1, 3),
            sigma_m=np.array([place.sigma_m for place in self.places]),
            R_space_device=np.array([place.R_space_device for place in self.places]).reshape(-1, 3, 3),
            p_space_device=np.array([place.p_space_device for place in self.places]).reshape(-1, 3),
        )

    def _try(self) -> Place | None:
        forget_old(self._points, self._poses)
        if not (covers(self._points) and covers(self._poses)):
            return None
        place = self._candidate()
        if place is None or not self._is_new(place):
            return None
        self.places.append(place)
        self._points.clear()
        self._poses.clear()
        return place

    def _candidate(self) -> Place | None:
        """Return the place that is held now, None when something moves."""
        p = np.array([sample.position for sample in self._poses])
        R = np.array([sample.R for sample in self._poses])
        held = held_pose(p, R)
        if held is None:
            return None
        p_mean, R_mean = held
        x = np.array([sample.position for sample in self._points])
        half = len(x) // 2
        # Distance between the marker's mean places in the first and second half: cameras see it shake by
        # millimetres.
        if np.linalg.norm(x[:half].mean(axis=0) - x[half:].mean(axis=0)) > 0.004:
            return None
        # Not divided by the number of samples: the tracker's filter makes them alike, and its bias does not average.
        sigma_m = float(np.mean([sample.sigma_m for sample in self._points])) / np.sqrt(3.0)
        least_sigma_m = 3e-4
        return Place(np.median(x, axis=0), max(sigma_m, least_sigma_m), R_mean, p_mean)

    def _is_new(self, place: Place) -> bool:
        turned_rad = np.radians(25.0)
        return all(
            np.linalg.norm(place.p_space_device - other.p_space_device) > _ELSEWHERE_M
            or angle_between(place.R_space_device, other.R_space_device) > turned_rad
            for other in self.places
        )
