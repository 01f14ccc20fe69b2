"""Pictures from the cameras of a running rig, by the previews that its capture services answer with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from rhot.arrays import ImageArray
from rhot.bus import Bus, Reply
from rhot.errors import BusError, DeviceError
from rhot.recording.picture_file import decode_picture
from rhot.rig import BusConfig

_CONNECT_TIMEOUT_S: Final = 2.0


async def live_pictures(bus: BusConfig, cameras: Sequence[str]) -> dict[str, ImageArray]:
    """Return the newest picture of each camera, (H, W, 3) uint8 BGR.

    Raises:
        BusError: no router, or no capture service answers for a camera.
        DeviceError: a camera has no picture yet, or what came is none.
    """
    async with await Bus.open(bus, timeout_s=_CONNECT_TIMEOUT_S) as session:
        # PNG where the service knows it; JPEG blurs colours over blocks of pixels.
        answer_timeout_s = 3.0
        return {
            camera: decoded(camera, await session.get(f"rhot/preview/{camera}?format=png", timeout_s=answer_timeout_s))
            for camera in cameras
        }


def decoded(camera: str, replies: Sequence[Reply]) -> ImageArray:
    """Return the picture in the answers to a preview query.

    Raises:
        BusError: there is no answer.
        DeviceError: only refusals, or bytes that are no picture.
    """
    if not replies:
        raise BusError(
            f"camera {camera}: no capture service answers; `rhot status` shows who is there, "
            f"`rhot capture --camera {camera}` starts one"
        )
    pictures = [reply for reply in replies if not reply.error]
    if not pictures:
        raise DeviceError(f"camera {camera}: {replies[0].error}")
    data = pictures[0].payload
    image = decode_picture(data)
    if image is None:
        raise DeviceError(
            f"camera {camera}: the preview is no picture but {len(data)} bytes of {pictures[0].encoding}; do the "
            "capture service and this program have the same version?"
        )
    return np.asarray(image, dtype=np.uint8)
