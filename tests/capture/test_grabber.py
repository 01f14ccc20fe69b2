from __future__ import annotations

import asyncio
import queue
import threading
import time

import numpy as np
import pytest
from wall_clock import in_time

from rhot.errors import ConfigError, DeviceError, HungDeviceError
from rhot_capture.settings import CameraSettings
from rhot_capture.sources import Frame, grab


class ScriptedSource:
    """Delivers what a test puts into its queue: frames, None for the end, or an exception."""

    def __init__(self) -> None:
        self.items: queue.Queue[Frame | Exception | None] = queue.Queue()
        self.taken = threading.Semaphore(0)
        self.closed = threading.Event()

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None: ...

    def read(self) -> Frame | None:
        self.taken.release()
        item = self.items.get()
        if isinstance(item, Exception):
            raise item
        return item

    def apply(self, settings: CameraSettings) -> None: ...

    def close(self) -> None:
        self.closed.set()
        self.items.put(None)


def frame(index: int) -> Frame:
    return Frame(np.zeros((2, 2, 3), np.uint8), index, 1_000 * index, 0.0, 0.0)


async def wait_for_reads(source: ScriptedSource, count: int) -> None:
    for _ in range(count):
        assert await asyncio.to_thread(source.taken.acquire, True, 5.0)


async def test_the_newest_frame_is_delivered_and_the_others_are_counted() -> None:
    source = ScriptedSource()
    grabber = grab(source)
    for index in (0, 1, 4):
        source.items.put(frame(index))
    grabber.start()
    await wait_for_reads(source, 4)
    newest = await grabber.next_frame()
    assert newest is not None
    assert newest.index == 4
    assert (grabber.counts.read, grabber.counts.dropped_late, grabber.counts.missed) == (3, 2, 2)
    await grabber.stop()


async def test_a_reader_waits_for_the_next_frame() -> None:
    source = ScriptedSource()
    grabber = grab(source)
    grabber.start()
    waiting = asyncio.create_task(grabber.next_frame())
    await wait_for_reads(source, 1)
    assert not waiting.done()
    source.items.put(frame(7))
    got = await asyncio.wait_for(waiting, 5.0)
    assert got is not None
    assert got.index == 7
    await grabber.stop()


async def test_every_frame_arrives_when_the_reader_keeps_up() -> None:
    source = ScriptedSource()
    grabber = grab(source)
    grabber.start()
    for index in range(50):
        source.items.put(frame(index))
        got = await asyncio.wait_for(grabber.next_frame(), 5.0)
        assert got is not None
        assert got.index == index
    assert grabber.counts.dropped_late == 0
    await grabber.stop()


async def test_the_last_frame_comes_before_the_end() -> None:
    source = ScriptedSource()
    source.items.put(frame(0))
    source.items.put(None)
    grabber = grab(source)
    grabber.start()
    await wait_for_reads(source, 2)
    assert (await asyncio.wait_for(grabber.next_frame(), 5.0)) is not None
    assert (await asyncio.wait_for(grabber.next_frame(), 5.0)) is None
    await grabber.stop()


@pytest.mark.parametrize(
    ("raised", "expected", "words"),
    [
        (ConfigError("picture 3 is broken"), ConfigError, "picture 3 is broken"),
        (ValueError("strange"), DeviceError, "camera left: ValueError: strange"),
    ],
)
async def test_errors_reach_the_reader(raised: Exception, expected: type[Exception], words: str) -> None:
    source = ScriptedSource()
    source.items.put(raised)
    grabber = grab(source, "left")
    grabber.start()
    with pytest.raises(expected, match=words):
        await asyncio.wait_for(grabber.next_frame(), 5.0)
    await grabber.stop()


async def test_stop_ends_a_waiting_reader_and_closes_the_source() -> None:
    source = ScriptedSource()
    grabber = grab(source)
    grabber.start()
    waiting = asyncio.create_task(grabber.next_frame())
    await wait_for_reads(source, 1)
    begun = time.monotonic()
    await grabber.stop()
    assert (await asyncio.wait_for(waiting, 5.0)) is None
    assert time.monotonic() - begun < 1.0
    assert source.closed.is_set()


@pytest.mark.real_time
async def test_a_read_that_hangs_does_not_hold_up_the_stop() -> None:
    class Hanging(ScriptedSource):
        def close(self) -> None:
            self.closed.set()

    source = Hanging()
    grabber = grab(source, "left")
    grabber.start()
    await wait_for_reads(source, 1)
    begun = time.monotonic()
    with pytest.raises(HungDeviceError, match=r"camera left: read: its driver has not returned for 0\.2 s"):
        await grabber.stop(limit_s=0.2)
    in_time(time.monotonic() - begun, 1.0, "giving up a read that hangs")
    source.items.put(None)


@pytest.mark.real_time
async def test_a_close_that_hangs_is_given_up_and_the_frames_with_it() -> None:
    class Hanging(ScriptedSource):
        release = threading.Event()

        def close(self) -> None:
            self.release.wait()

    source = Hanging()
    grabber = grab(source, "left")
    source.items.put(frame(0))
    grabber.start()
    await wait_for_reads(source, 2)
    begun = time.monotonic()
    with pytest.raises(HungDeviceError, match=r"camera left: close.*this process ends"):
        await grabber.stop(limit_s=0.2)
    in_time(time.monotonic() - begun, 1.0, "giving up a close that hangs")
    assert await grabber.next_frame() is None
    source.release.set()
    source.items.put(None)


async def test_what_a_driver_raises_at_the_close_does_no_harm(caplog: pytest.LogCaptureFixture) -> None:
    class PulledOut(ScriptedSource):
        def close(self) -> None:
            super().close()
            raise RuntimeError("no such device")

    source = PulledOut()
    grabber = grab(source, "left")
    grabber.start()
    await grabber.stop()
    assert "camera left: close: RuntimeError: no such device" in caplog.text


async def test_reading_before_the_start_is_an_error() -> None:
    with pytest.raises(DeviceError, match="not started"):
        await grab(ScriptedSource()).next_frame()


class TestWork:
    """Frames on a thread of their own."""

    async def test_a_frame_in_work_is_finished_before_the_device_is_closed(self) -> None:
        source = ScriptedSource()
        grabber = grab(source)
        begun, go_on = threading.Event(), threading.Event()
        seen: list[tuple[int, bool]] = []

        def work(frame: Frame) -> None:
            begun.set()
            assert go_on.wait(5.0)
            seen.append((frame.index, source.closed.is_set()))

        grabber.start()
        working = asyncio.create_task(grabber.work(work))
        source.items.put(frame(0))
        assert await asyncio.to_thread(begun.wait, 5.0)
        for index in (1, 2):
            source.items.put(frame(index))
        await wait_for_reads(source, 4)
        go_on.set()
        while len(seen) < 2:
            await asyncio.sleep(0.001)
        begun.clear()
        go_on.clear()
        source.items.put(frame(3))
        assert await asyncio.to_thread(begun.wait, 5.0)
        stopping = asyncio.create_task(grabber.stop())
        await asyncio.sleep(0.05)
        assert not source.closed.is_set()
        go_on.set()
        await asyncio.wait_for(stopping, 5.0)
        await asyncio.wait_for(working, 5.0)
        assert seen == [(0, False), (2, False), (3, False)], "the newest, and none after the stop"
        assert grabber.counts.dropped_late == 1

    async def test_it_ends_with_the_source_and_passes_errors_on(self) -> None:
        source = ScriptedSource()
        source.items.put(frame(0))
        source.items.put(None)
        grabber = grab(source)
        seen: list[Frame] = []
        grabber.start()
        await asyncio.wait_for(grabber.work(seen.append), 5.0)
        assert [one.index for one in seen] == [0]
        await grabber.stop()

        def failing(_: Frame) -> None:
            raise ZeroDivisionError

        for item, work, expected in (
            (ValueError("strange"), seen.append, DeviceError),
            (frame(0), failing, ZeroDivisionError),
        ):
            source = ScriptedSource()
            source.items.put(item)
            grabber = grab(source)
            grabber.start()
            with pytest.raises(expected):
                await asyncio.wait_for(grabber.work(work), 5.0)
            await grabber.stop()

    async def test_a_session_that_is_cancelled_ends_it(self) -> None:
        source = ScriptedSource()
        grabber = grab(source)
        grabber.start()
        working = asyncio.create_task(grabber.work(lambda _: None))
        await wait_for_reads(source, 1)
        working.cancel()
        with pytest.raises(asyncio.CancelledError):
            await working
        await asyncio.wait_for(grabber.stop(), 5.0)
        assert not [one for one in threading.enumerate() if one.name.startswith("work camera")]
