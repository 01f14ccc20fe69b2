"""Where the point sets of a hand calibration come from: a recording, a file of `rhot process`, or the running rig."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from rhot.atomic_file import why_unread
from rhot.bus import Bus
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.messages import MarkerFrame, PointSet, decode, first_problem
from rhot.offline import marker_frames, track
from rhot.recording import Recording
from rhot.recording.mcap.reader import is_mcap, open_mcap
from rhot.rig import BusConfig, Rig

_POINTS_KEY: Final = "rhot/points"
_CONNECT_S: Final = 3.0


def recorded_points(rig: Rig, recording: Recording, on_frame: Callable[[], None]) -> Iterator[PointSet]:
    """Yield the point sets of a recording, tracked by the very cores that run live; `on_frame` counts its frames."""
    for _, message in track(rig, marker_frames(rig, recording)):
        if isinstance(message, MarkerFrame):
            on_frame()
        elif isinstance(message, PointSet):
            yield message


def stored_points(file: Path) -> Iterator[PointSet]:
    """Yield the point sets in an MCAP file of `rhot record` or a JSON Lines file of `rhot process`.

    Raises:
        ConfigError: it cannot be read.
        CalibrationError: a line is not a message; names the line.
        WireError: a payload of the MCAP file is not a valid message.
    """
    if is_mcap(file):
        for sample in open_mcap(file).samples():
            if sample.key == _POINTS_KEY:
                yield decode(sample.payload, PointSet)
        return
    try:
        with file.open(encoding="utf-8-sig") as lines:
            for number, line in enumerate(lines, start=1):
                if line.strip():
                    found = _points_of(f"{file}:{number}", line)
                    if found is not None:
                        yield found
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error


def _points_of(where: str, line: str) -> PointSet | None:
    try:
        entry = json.loads(line)
    except (json.JSONDecodeError, RecursionError) as error:
        raise CalibrationError(f"{where}: not JSON ({error}); give a file that `rhot process --out` wrote") from error
    if not isinstance(entry, dict) or "key" not in entry or "value" not in entry:
        raise CalibrationError(f'{where}: not {{"key": …, "value": …}}; give a file that `rhot process --out` wrote')
    if entry["key"] != _POINTS_KEY:
        return None
    try:
        # From JSON text, so that its lists count as the tuples of the model.
        return PointSet.model_validate_json(json.dumps(entry["value"]))
    except ValidationError as error:
        raise CalibrationError(f"{where}: not a valid PointSet: {first_problem(error)}") from error


async def live_points(bus_config: BusConfig, seconds: float, on_time: Callable[[float, int], None]) -> list[PointSet]:
    """Return the point sets that a running rig publishes.

    Args:
        bus_config: how to reach it.
        seconds: how long to listen.
        on_time: is told the seconds since the start and the number of point sets so far.

    Raises:
        BusError: no router, or nothing was published.
    """
    points: list[PointSet] = []
    began = time.monotonic()

    async def listen(bus: Bus) -> None:
        async for _, point_set in bus.events(_POINTS_KEY).messages(PointSet):
            points.append(point_set)

    async with await Bus.open(bus_config, timeout_s=_CONNECT_S) as bus:
        listening = asyncio.create_task(listen(bus))
        try:
            while (passed := time.monotonic() - began) < seconds and not listening.done():
                on_time(passed, len(points))
                await asyncio.sleep(0.1)
        finally:
            listening.cancel()
            await asyncio.gather(listening, return_exceptions=True)
    if not points:
        raise BusError(
            f"nothing came on {_POINTS_KEY} within {seconds:g} s; is the rig running and started "
            "(`rhot up`, `rhot start`, `rhot status`)?"
        )
    return points
