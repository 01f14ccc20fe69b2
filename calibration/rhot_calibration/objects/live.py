"""Places from a running rig: the marker from `rhot/points`, the device from `rhot/object/<id>`."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from rhot.bus import Bus
from rhot.errors import BusError, ConfigError
from rhot.messages import Control, ObjectPose, PointSet
from rhot.operation.control import newest_control
from rhot.rig import BusConfig, Rig
from rhot.rig.folder import registration_name, registration_path
from rhot_calibration.objects.collector import Place, PlaceCollector
from rhot_objects.core import key_of
from rhot_objects.pose import Pose
from rhot_objects.registration import Registration

CONNECT_TIMEOUT_S: Final = 5.0
HINT_S: Final = 0.5
"""Between two looks at what is missing."""

Taken = Callable[[Place], None]
Hint = Callable[[str], None]


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

    def keep(place: Place | None) -> None:
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

    async with await Bus.open(bus_config, timeout_s=CONNECT_TIMEOUT_S) as bus:
        check_session(
            await newest_control(bus), registration_path(rig.path, source) or rig.path / registration_name(source)
        )
        tasks = [asyncio.create_task(follow(bus)) for follow in (follow_points, follow_device)]
        try:
            services = {"rhot/points": "fusion", object_key: "objects"}
            remedy = " and the rig started (`rhot status`, `rhot start`)"
            await _wait(done, StreamWatch(tasks, heard, services, patience_s, remedy, hint), collector)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _wait(done: asyncio.Event, watch: StreamWatch, collector: PlaceCollector) -> None:
    """Wait until done, saying what is missing."""
    while not done.is_set():
        watch.look(lambda: collector.hint)
        try:
            async with asyncio.timeout(HINT_S):
                await done.wait()
        except TimeoutError:
            continue


class StreamWatch:
    """Says what the person should do while streams are listened to, and ends the wait for one that stays silent.

    Args:
        tasks: that listen.
        heard: keys that something came on; filled by them.
        services: key to the service that publishes it.
        patience_s: how long a key may stay silent at the beginning.
        remedy: what to look after when one does, behind the question whether its service is running.
        hint: called with what the person should do, whenever that changes.
    """

    def __init__(
        self,
        tasks: Sequence[asyncio.Task[None]],
        heard: set[str],
        services: Mapping[str, str],
        patience_s: float,
        remedy: str,
        hint: Hint,
    ) -> None:
        self._tasks, self._heard, self._services = tasks, heard, services
        self._patience_s, self._remedy, self._hint = patience_s, remedy, hint
        self._begun, self._hinted = time.monotonic(), ""

    def look(self, advice: Callable[[], str]) -> None:
        """Look once, every `HINT_S` or so.

        Args:
            advice: what the person should do when every key is heard; empty = nothing.

        Raises:
            BusError: a key has stayed silent for too long, or the connection was closed.
        """
        silent = [key for key in self._services if key not in self._heard]
        if silent and time.monotonic() - self._begun > self._patience_s:
            raise BusError(
                f"nothing was published on {silent[0]} for {self._patience_s:.0f} s; is "
                f"`rhot {self._services[silent[0]]}` running{self._remedy}?"
            )
        for task in self._tasks:
            if task.done():
                task.result()
                raise BusError("the connection to the router was closed")
        now = f"nothing on {silent[0]} yet" if silent else advice()
        if now and now != self._hinted:
            self._hint(now)
        self._hinted = now


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
