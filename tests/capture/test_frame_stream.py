"""Frames for recording: encoded only with a subscriber, and then all in order."""

from __future__ import annotations

import asyncio

import cv2
import numpy as np
from bus_watch import PATIENCE_S

from rhot.bus import Bus
from rhot.messages import decode
from rhot.recording.camera_picture import CameraPicture, jpeg_of
from rhot.recording.mcap.session import subscribe_pictures
from rhot.rig import BusConfig
from rhot_capture.service import FrameStream
from rhot_capture.sources import Frame


def frame(index: int, size: tuple[int, int] = (48, 64)) -> Frame:
    image = np.random.default_rng(index).integers(0, 255, (*size, 3), dtype=np.uint8)
    return Frame(np.asarray(cv2.GaussianBlur(image, (0, 0), 2.0), dtype=np.uint8), index, 1000 + index, 0.004, 0.012)


async def test_frames_are_sent_while_somebody_records(router: BusConfig) -> None:
    async with await Bus.open(router) as camera, await Bus.open(router) as everything:
        stream = FrameStream("left", camera)
        watched = everything.events("rhot/**")
        for index in range(3):
            stream.offer(frame(index), index)
        async with await Bus.open(router) as recorder:
            mailbox = subscribe_pictures(recorder)
            async with asyncio.timeout(PATIENCE_S):
                while not stream.has_reader:
                    await asyncio.sleep(0.005)
            for index in range(3, 8):
                stream.offer(frame(index), 10**18 + index)
            got = []
            async with asyncio.timeout(PATIENCE_S):
                async for sample in mailbox:
                    got.append(decode(sample.payload, CameraPicture))
                    if len(got) == 5:
                        break
        assert [(one.frame, one.t_ns, one.seq) for one in got] == [(n, 10**18 + n, n - 3) for n in range(3, 8)]
        assert got[0].jpeg == jpeg_of(frame(3).image)
        decoded = cv2.imdecode(np.frombuffer(got[0].jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        assert np.abs(decoded.astype(int) - frame(3).image).mean() < 3.0
        assert watched.received == 0, "who watches everything gets no pictures"
        assert stream.dropped == 0


async def test_frames_that_nobody_can_take_are_counted(router: BusConfig) -> None:
    async with await Bus.open(router) as camera, await Bus.open(router) as recorder:
        stream = FrameStream("left", camera)
        subscribe_pictures(recorder)
        async with asyncio.timeout(PATIENCE_S):
            while not stream.has_reader:
                await asyncio.sleep(0.005)
        noise = np.random.default_rng(0).integers(0, 255, (1080, 1920, 3), dtype=np.uint8)
        for index in range(20):
            stream.offer(Frame(noise, index, index, 0.004, 0.012), index)
        async with asyncio.timeout(PATIENCE_S):
            while stream.dropped < 20:
                await asyncio.sleep(0.01)
