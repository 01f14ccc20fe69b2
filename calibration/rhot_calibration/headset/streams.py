"""Views from a running rig, and from a recording of one."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np

from rhot.bus import Bus
from rhot.errors import BusError, ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import HeadPose
from rhot.recording import load_recording
from rhot.recording.camera_picture import PICTURES_KEY, CameraPicture
from rhot.recording.picture_file import decode_picture
from rhot.rig import BusConfig
from rhot_calibration.headset.collector import ViewCollector
from rhot_feet.frames import pinhole
from rhot_feet.input_stream import CAMERA
from rhot_feet.marker.detection import MarkerDetection
from rhot_feet.offline import HEAD_KEY, recorded_heads
from rhot_feet.sources.depth_camera.recorded_frames import load_depth_recording

CONNECT_S: Final = 5.0
_LOOK_S: Final = 0.5
_HEAD_AHEAD_NS: Final = 100_000_000
_PICTURES: Final = f"{PICTURES_KEY}/{CAMERA}"


async def collect_views(
    config: BusConfig,
    collector: ViewCollector,
    *,
    patience_s: float,
    taken: Callable[[], None],
    hint: Callable[[str], None],
) -> None:
    """Fill a collector from a running rig until it is done.

    Args:
        config: how to reach the rig.
        collector: filled as it goes, so that an interrupted session keeps what there is.
        patience_s: how long pictures and head may stay silent.
        taken: called after new views.
        hint: called with what the person should do, whenever that changes.

    Raises:
        BusError: no router, or no picture or no pose of the head comes.
    """
    silent = {"pictures": "the feet's camera sends no pictures", "head": f"nobody publishes a measured {HEAD_KEY}"}
    heard_s = dict.fromkeys(silent, time.monotonic())
    done = asyncio.Event()

    async def follow_head(bus: Bus) -> None:
        async for _, pose in bus.events(HEAD_KEY).messages(HeadPose):
            if pose.state == "measured":
                heard_s["head"] = time.monotonic()
            if collector.add_head(pose):
                taken()
                if collector.done:
                    done.set()

    async def follow_pictures(bus: Bus) -> None:
        async for _, picture in bus.latest(_PICTURES).messages(CameraPicture):
            camera = _lens(picture)
            if camera is None:
                continue
            found = await asyncio.to_thread(_found, collector, picture.jpeg)
            heard_s["pictures"] = time.monotonic()
            collector.add_picture(picture.t_ns, found, camera)

    async def watch() -> None:
        said = ""
        while True:
            await asyncio.sleep(_LOOK_S)
            late = [what for what, at_s in heard_s.items() if time.monotonic() - at_s > patience_s]
            if late:
                raise BusError(
                    f"{' and '.join(silent[what] for what in late)}: are `rhot feet` and `rhot objects` running, and "
                    "the rig started (`rhot status`, `rhot start`)?"
                )
            if collector.hint != said:
                said = collector.hint
                hint(said)

    async with await Bus.open(config, timeout_s=CONNECT_S) as bus:
        tasks = [asyncio.create_task(work) for work in (follow_head(bus), follow_pictures(bus), watch(), _waited(done))]
        try:
            ended, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _waited(done: asyncio.Event) -> None:
    await done.wait()


def views_recorded(path: Path, collector: ViewCollector, step: Callable[[float], None] = lambda _: None) -> None:
    """Fill a collector from a recording of `rhot record --frames`.

    Args:
        path: its folder.
        collector: to fill, with all that is there.
        step: called with the share of pictures that were looked at.

    Raises:
        ConfigError: the recording holds no depth camera or no poses of the head, or a file cannot be read.
    """
    recording = load_recording(path)
    if recording.depth_camera is None:
        raise ConfigError(f"{path}: holds no pictures of the feet's camera; `rhot record --frames` takes them")
    frames = load_depth_recording(recording.depth_camera, complete=recording.complete)
    heads = recorded_heads(recording.depth_camera)
    next_head = 0
    for index, frame in enumerate(frames.frames()):
        collector.add_picture(frame.t_ns, collector.find(frame.color), frame.camera)
        while next_head < len(heads) and heads[next_head].t_ns <= frame.t_ns + _HEAD_AHEAD_NS:
            collector.add_head(heads[next_head])
            next_head += 1
        step((index + 1) / len(frames))


def _lens(picture: CameraPicture) -> CameraModel | None:
    lens = picture.lens
    if lens is None:
        return None
    return pinhole(lens.width, lens.height, np.array(lens.K), np.array(lens.distortion))


def _found(collector: ViewCollector, jpeg: bytes) -> MarkerDetection | None:
    image = decode_picture(jpeg)
    # What is no picture shows no marker.
    return None if image is None else collector.find(np.asarray(image, np.uint8))
