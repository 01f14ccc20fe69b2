"""Recording everything that a running rig publishes, without losing a sample."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Final

from rhot.bus import Bus, EventSubscriber
from rhot.clock import difference_ns
from rhot.errors import WireError
from rhot.messages import HeadPose, decode
from rhot.recording.camera_picture import PICTURES_KEY, CameraPicture
from rhot.recording.feet_tables import SENSORS_KEY, FeetTables, SensorSamples
from rhot.recording.mcap.gaps import Tally, peek
from rhot.recording.mcap.wire_models import MSGPACK_ENCODING
from rhot.recording.mcap.writer import McapWriter
from rhot.recording.picture_folder import PictureFolder

EVERYTHING: Final = "rhot/**"
QUEUE_LIMIT: Final = 1 << 16
"""Samples that wait while the disk does; at 700 a second more than a minute of them."""
PICTURE_LIMIT: Final = 256
"""Pictures that wait while the disk does: two seconds of two cameras, some 20 MB."""
_BEAT_S: Final = 0.5
_SYNC_S: Final = 1.0
"""What a power cut costs, with a beat before it; an SD card takes tens of milliseconds for it."""


async def record(
    mailbox: EventSubscriber,
    writer: McapWriter,
    tally: Tally,
    stop: asyncio.Event,
    *,
    on_beat: Callable[[], None],
    duration_s: float | None = None,
) -> None:
    """Write every sample of a mailbox until stopped, then what has arrived by then.

    Args:
        mailbox: `subscribe` makes it.
        writer: where samples go; it is flushed twice a second, synced once, and stays open.
        tally: counts what is written and what was lost before it came here.
        stop: ends the recording.
        on_beat: called twice a second.
        duration_s: ends the recording after this time.

    Raises:
        ConfigError: the file cannot be written any more.
    """
    # Spacing comes from the monotonic clock, so that a step of the system's clock leaves no gap in the recording.
    epoch_ns = difference_ns(time.time_ns, time.monotonic_ns)

    async def write() -> None:
        async for sample in mailbox:
            if sample.deleted:
                continue
            if not tally.admits(sample.key, sample.encoding):
                continue
            is_message = sample.encoding.startswith(MSGPACK_ENCODING)
            t_ns, seq = peek(sample.payload) if is_message else (None, None)
            writer.write(sample.key, sample.encoding, sample.payload, t_ns, seq, epoch_ns + sample.arrived_ns)
            tally.note(sample.key, seq, len(sample.payload))

    async def beat() -> None:
        while True:
            await asyncio.sleep(_BEAT_S)
            writer.flush()
            on_beat()

    async def sync() -> None:
        while True:
            await asyncio.sleep(_SYNC_S)
            await asyncio.to_thread(writer.sync)

    async def end() -> None:
        await asyncio.wait_for(stop.wait(), duration_s)

    writing, *others = tasks = [asyncio.create_task(work()) for work in (write, beat, sync, end)]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        mailbox.close()
        for task in done & set(others):
            if not isinstance(task.exception(), TimeoutError):
                task.result()
        await writing
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


def subscribe(bus: Bus) -> EventSubscriber:
    """Subscribe to everything; what arrives from now on is kept until it is written."""
    return bus.events(EVERYTHING, QUEUE_LIMIT)


def subscribe_pictures(bus: Bus) -> EventSubscriber:
    """Ask all cameras for their pictures; they code them from now on, and until the bus is closed."""
    return bus.events(f"{PICTURES_KEY}/*", PICTURE_LIMIT)


def subscribe_motion(bus: Bus) -> tuple[EventSubscriber, EventSubscriber]:
    """Ask for the head's poses and for the ankles' sensors, which belong to the pictures of the feet."""
    return bus.events("rhot/head", QUEUE_LIMIT), bus.events(f"{SENSORS_KEY}/*", QUEUE_LIMIT)


async def record_motion(mailboxes: Sequence[EventSubscriber], tables: FeetTables) -> int:
    """Write what `subscribe_motion` gives until both mailboxes are closed.

    Returns:
        How many messages were not valid and were left out.

    Raises:
        ConfigError: a table cannot be written any more.
    """
    invalid = 0

    async def heads(mailbox: EventSubscriber) -> None:
        nonlocal invalid
        async for sample in mailbox:
            try:
                tables.add_head(decode(sample.payload, HeadPose), sample.arrived_ns)
            except WireError:
                invalid += 1

    async def sensors(mailbox: EventSubscriber) -> None:
        nonlocal invalid
        async for sample in mailbox:
            try:
                samples = decode(sample.payload, SensorSamples)
            except WireError:
                invalid += 1
                continue
            if sample.key.rpartition("/")[2] == samples.side:
                tables.add_samples(samples, sample.arrived_ns)
            else:
                invalid += 1

    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(heads(mailboxes[0]))
        tasks.create_task(sensors(mailboxes[1]))
    return invalid


async def record_pictures(mailbox: EventSubscriber, folder: PictureFolder) -> int:
    """Write every picture of a mailbox until it is closed, then those that have arrived by then.

    Args:
        mailbox: `subscribe_pictures` makes it.
        folder: where pictures go.

    Returns:
        How many were not valid, or bore another camera's name than their key, and were left out.

    Raises:
        ConfigError: the folder cannot be written any more.
    """
    invalid = 0
    synced_s = time.monotonic()
    async for sample in mailbox:
        try:
            picture = decode(sample.payload, CameraPicture)
        except WireError:
            invalid += 1
            continue
        if sample.key.rpartition("/")[2] != picture.camera:
            invalid += 1
            continue
        await asyncio.to_thread(folder.write, picture, sample.arrived_ns)
        if time.monotonic() - synced_s > _SYNC_S:
            await asyncio.to_thread(folder.sync)
            synced_s = time.monotonic()
    return invalid
