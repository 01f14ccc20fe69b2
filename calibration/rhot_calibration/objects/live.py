"""Places from a running rig: the marker from `rhot/points`, the device from `rhot/object/<id>`."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rhot.arrays import FloatArray
from rhot.bus import CONNECT_S, Bus
from rhot.errors import ConfigError
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.messages import Control, ObjectPose, PointSet
from rhot.operation.control import newest_control
from rhot.rig import BusConfig, Rig
from rhot.rig.folder import registration_name, registration_path
from rhot_calibration.live import HINT_S, Hint, StreamWatch, listening
from rhot_calibration.objects.checks import angle_between, covers, forget_old, held_pose
from rhot_calibration.objects.fit import Places
from rhot_objects.core import key_of
from rhot_objects.pose import Pose, Registration

# Taking places from two live streams: the marker in the rig and the device in its space, when both are held still.

_ELSEWHERE_M = 0.05


@dataclass(frozen=True, slots=True)
class PosePair:
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
        self.places: list[PosePair] = []
        self._points: deque[_PointSample] = deque()
        self._poses: deque[_PoseSample] = deque()

    def add_point(self, t_ns: int, position: FloatArray, sigma_m: float) -> PosePair | None:
        """Take a measured marker position (3,), metres, rig frame, `sigma_m` as in `Point.sigma`."""
        self._points.append(_PointSample(t_ns, position, sigma_m))
        return self._try()

    def add_pose(self, t_ns: int, T_space_device: Pose) -> PosePair | None:
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

    def _try(self) -> PosePair | None:
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

    def _candidate(self) -> PosePair | None:
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
        return PosePair(np.median(x, axis=0), max(sigma_m, least_sigma_m), R_mean, p_mean)

    def _is_new(self, place: PosePair) -> bool:
        turned_rad = np.radians(25.0)
        return all(
            np.linalg.norm(place.p_space_device - other.p_space_device) > _ELSEWHERE_M
            or angle_between(place.R_space_device, other.R_space_device) > turned_rad
            for other in self.places
        )


Taken = Callable[[PosePair], None]


async def collect_places(
    bus_config: BusConfig,
    rig: Rig,
    object_id: str,
    marker: str,
    collector: PlaceCollector,
    *,
    wanted: int,
    patience_s: float,
    taken: Taken,
    hint: Hint,
) -> None:
    """Fill a collector from a running rig until it holds `wanted` places.

    Args:
        bus_config: how to reach the rig.
        rig: its registration is undone on the published poses.
        object_id: of the tracked device.
        marker: name of the marker that is fixed to it.
        collector: filled as it goes, so that an interrupted session keeps what there is.
        wanted: places.
        patience_s: how long both keys may stay silent at the beginning.
        taken: called with each new place.
        hint: called with what the person should do, whenever that changes.

    Raises:
        BusError: no router, or a key stays silent.
        ConfigError: the session began with another registration than the rig folder holds.
    """
    source = rig.config.objects[object_id].source
    registration = Registration.from_file(rig.registration_of(source))
    done = asyncio.Event()
    heard: set[str] = set()
    object_key = key_of(object_id)

    def keep(place: PosePair | None) -> None:
        if place is not None and not done.is_set():
            taken(place)
            if len(collector.places) >= wanted:
                done.set()

    async def follow_points(bus: Bus) -> None:
        async for _, points in bus.events("rhot/points").messages(PointSet):
            heard.add("rhot/points")
            point = points.points.get(marker)
            if point is not None and point.state == "measured" and not done.is_set():
                keep(collector.add_point(points.t_ns, np.array(point.position), point.sigma))

    async def follow_device(bus: Bus) -> None:
        async for _, message in bus.events(object_key).messages(ObjectPose):
            heard.add(object_key)
            if message.state == "measured" and not done.is_set():
                pose = Pose.from_arrays(message.position, message.orientation)
                keep(collector.add_pose(message.t_ns, registration.to_tracker(object_id, pose)))

    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        check_session(
            await newest_control(bus), registration_path(rig.path, source) or rig.path / registration_name(source)
        )
        async with listening(follow_points(bus), follow_device(bus)) as tasks:
            services = {"rhot/points": "fusion", object_key: "objects"}
            remedy = " and the rig started (`rhot status`, `rhot start`)"
            await _wait(done, StreamWatch(tasks, heard, services, patience_s, remedy, hint), collector)


async def _wait(done: asyncio.Event, watch: StreamWatch, collector: PlaceCollector) -> None:
    """Wait until done, saying what is missing."""
    while not done.is_set():
        watch.look(lambda: collector.hint)
        try:
            async with asyncio.timeout(HINT_S):
                await done.wait()
        except TimeoutError:
            continue


def check_session(start: Control | None, file: Path) -> None:
    """Refuse a session that began before the registration that would be undone was written."""
    if start is None or start.action != "start" or not file.exists():
        return
    # A file's time and the start of a session, by another machine's clock, compare no better than this.
    if file.stat().st_mtime > start.start_t_ns / 1e9 + 2.0:
        raise ConfigError(
            f"{file} was written after this session began, so `rhot objects` still uses an earlier registration; start "
            "the rig again (`rhot start`), then repeat this"
        )
