"""Places from a running rig: the marker from `rhot/points`, the device from `rhot/object/<id>`."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from rhot.bus import Bus
from rhot.errors import BusError, ConfigError, WireError
from rhot.messages import Control, ObjectPose, PointSet, decode
from rhot.operation.control import newest_control
from rhot.rig import BusConfig, Rig
from rhot.rig.folder import registration_name, registration_path
from rhot_calibration.objects.collector import Place, PlaceCollector
from rhot_objects.pose import Pose
from rhot_objects.registration import Registration
from rhot_objects.stage import key_of

_CONNECT_TIMEOUT_S: Final = 5.0
_HINT_S: Final = 0.5
_CLOCKS_S: Final = 2.0
"""A file's time and the start of a session, by another machine's clock, compare no better than this."""

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
        async for sample in bus.events("rhot/points"):
            try:
                points = decode(sample.payload, PointSet)
            except WireError:
                continue
            heard.add("rhot/points")
            point = points.points.get(marker)
            if point is not None and point.state == "measured" and not done.is_set():
                keep(collector.add_point(points.t_ns, np.array(point.position), point.sigma))

    async def follow_device(bus: Bus) -> None:
        async for sample in bus.events(object_key):
            try:
                message = decode(sample.payload, ObjectPose)
            except WireError:
                continue
            heard.add(object_key)
            if message.state == "measured" and not done.is_set():
                pose = Pose.from_arrays(message.position, message.orientation)
                keep(collector.add_pose(message.t_ns, registration.to_tracker(object_id, pose)))

    async with await Bus.open(bus_config, timeout_s=_CONNECT_TIMEOUT_S) as bus:
        check_session(
            await newest_control(bus), registration_path(rig.path, source) or rig.path / registration_name(source)
        )
        tasks = [asyncio.create_task(follow(bus)) for follow in (follow_points, follow_device)]
        try:
            await _wait(done, tasks, heard, ("rhot/points", object_key), collector, patience_s, hint)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _wait(
    done: asyncio.Event,
    tasks: list[asyncio.Task[None]],
    heard: set[str],
    keys: tuple[str, str],
    collector: PlaceCollector,
    patience_s: float,
    hint: Hint,
) -> None:
    """Wait until done, saying what is missing."""
    begun, hinted = time.monotonic(), ""
    while not done.is_set():
        silent = [key for key in keys if key not in heard]
        if silent and time.monotonic() - begun > patience_s:
            service = "fusion" if silent[0] == "rhot/points" else "objects"
            raise BusError(
                f"nothing was published on {silent[0]} for {patience_s:.0f} s; is `rhot {service}` running and the rig "
                "started (`rhot status`, `rhot start`)?"
            )
        for task in tasks:
            if task.done():
                task.result()
                raise BusError("the connection to the router was closed")
        now = f"nothing on {silent[0]} yet" if silent else collector.hint
        if now and now != hinted:
            hint(now)
        hinted = now
        try:
            async with asyncio.timeout(_HINT_S):
                await done.wait()
        except TimeoutError:
            continue


def check_session(start: Control | None, file: Path) -> None:
    """Refuse a session that began before the registration that would be undone was written."""
    if start is None or start.action != "start" or not file.exists():
        return
    if file.stat().st_mtime > start.start_t_ns / 1e9 + _CLOCKS_S:
        raise ConfigError(
            f"{file} was written after this session began, so `rhot objects` still uses an earlier registration; start "
            "the rig anew (`rhot start`), then repeat this"
        )
