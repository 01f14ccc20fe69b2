"""Touches on a running rig: the fingertip from `rhot/hand/<side>`, the device from `rhot/object/<id>`."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import Final

from rhot.bus import CONNECT_S, Bus
from rhot.errors import CalibrationError
from rhot.messages import HandPose, ObjectPose
from rhot.operation.control import newest_control
from rhot.rig import BusConfig, Rig
from rhot.rig.folder import registration_name, registration_path
from rhot_calibration.live import HINT_S, Hint, StreamWatch, listening
from rhot_calibration.objects.live import check_session
from rhot_calibration.objects.touch.checks import judged, least_touches, missing_faces
from rhot_calibration.objects.touch.collector import TouchCollector
from rhot_calibration.objects.touch.fit import Touch
from rhot_calibration.objects.touch.record import R_before
from rhot_calibration.objects.touch.streams import TouchTask, feed
from rhot_calibration.writing import keyboard

_REMEDY: Final = ", the rig started (`rhot status`, `rhot start`), and in sight what it tracks"

Taken = Callable[[Touch], None]


async def collect_touches(
    bus_config: BusConfig,
    rig: Rig,
    task: TouchTask,
    collector: TouchCollector,
    *,
    patience_s: float,
    taken: Taken,
    hint: Hint,
    keys: bool = False,
) -> None:
    """Fill a collector from a running rig until its plan is done.

    Args:
        bus_config: how to reach the rig.
        rig: for the time of its registration.
        task: what is touched, and by whom.
        collector: filled as it goes, so that an interrupted session keeps what there is.
        patience_s: how long both keys may stay silent at the beginning.
        taken: called with each new touch.
        hint: called with what the person should do, whenever that changes.
        keys: Enter takes the touch that is held now, `b` takes the last one back.

    Raises:
        BusError: no router, or a key stays silent.
        ConfigError: the session began with another registration than the rig folder holds.
    """
    heard: set[str] = set()
    from_ns = 0
    changed = asyncio.Event()

    def keep(touch: Touch | None) -> None:
        if touch is not None:
            taken(touch)
            changed.set()

    async def follow(bus: Bus, key: str, model: type[HandPose | ObjectPose]) -> None:
        async for _, message in bus.events(key).messages(model):
            if message.t_ns < from_ns:
                continue
            heard.add(key)
            keep(feed(task, collector, key, message))

    def pressed(key: str) -> None:
        if key in "\r\n":
            touch = collector.take_now()
            keep(touch)
            if touch is None:
                hint(f"not taken: {collector.hint}")
        elif key == "b":
            collector.take_back()
            hint(f"taken back; {collector.asked}")

    async with await Bus.open(bus_config, timeout_s=CONNECT_S) as bus:
        start = await newest_control(bus)
        check_session(start, registration_path(rig.path, task.source) or rig.path / registration_name(task.source))
        # A session that is about to start: what still comes from the one before is another world.
        from_ns = start.start_t_ns if start is not None and start.action == "start" else 0
        services = {task.hand_key: "ik", task.object_key: "objects"}
        models: dict[str, type[HandPose | ObjectPose]] = {task.hand_key: HandPose, task.object_key: ObjectPose}
        works = [follow(bus, key, model) for key, model in models.items()]
        async with listening(*works, _work_out(collector, task, changed)) as tasks:
            with keyboard(pressed) if keys else contextlib.nullcontext():
                watch = StreamWatch(tasks, heard, services, patience_s, _REMEDY, hint)
                while not collector.done:
                    watch.look(lambda: collector.hint)
                    await asyncio.sleep(HINT_S)


async def _work_out(collector: TouchCollector, task: TouchTask, changed: asyncio.Event) -> None:
    """Keep the rough offset of a collector up to date, as soon as its touches tell one."""
    before = R_before(task)
    while True:
        await changed.wait()
        changed.clear()
        touches = list(collector.touches)
        if len(touches) < least_touches(task.shape) or missing_faces(task.shape, [touch.face for touch in touches]):
            continue
        try:
            found = await asyncio.to_thread(judged, task.shape, touches, before)
        except CalibrationError:
            # Said in the end; until then every touch is taken as it comes.
            collector.rough = None
            continue
        if len(collector.touches) >= len(touches):
            collector.rough = found.fit
