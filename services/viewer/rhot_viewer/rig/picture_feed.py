"""The cameras' live images, queried a few times a second while a browser is connected."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

from rhot.bus import Bus
from rhot.errors import BusError

FEET_CAMERA: Final = "feet"
"""Name of the depth camera that looks at the feet, on the bus."""
_TIMEOUT_S: Final = 0.8


@dataclass(frozen=True, slots=True)
class Picture:
    """A camera's answer.

    Attributes:
        jpeg: the image; empty without one.
        problem: why there is no image; empty otherwise.
    """

    jpeg: bytes = b""
    problem: str = ""


class PictureFeed:
    """Queries every camera's image, with the detected markers or the mask of one marker.

    Attributes:
        mask: marker whose mask is shown; None shows all markers, as always for the feet's camera.
        held: by camera, a JPEG that is shown instead of the live image.
    """

    def __init__(self, cameras: Iterable[str], show: Callable[[str, Picture], None]) -> None:
        """Prepare the feed.

        Args:
            cameras: their names.
            show: takes a camera's name and what it answered, on the event loop.
        """
        self.mask: str | None = None
        self.held: Mapping[str, bytes] = {}
        self._cameras = tuple(cameras)
        self._show = show
        self._now = asyncio.Event()

    def select(self, mask: str | None) -> None:
        """Show the mask of a marker, or the markers, from now on."""
        self.mask = mask
        self._now.set()

    def hold(self, pictures: Mapping[str, bytes]) -> None:
        """Show these pictures, by camera, in place of live ones until others are held; empty = all live."""
        if pictures != self.held:
            self.held = pictures
            self._now.set()

    async def run(self, bus: Bus, interval_s: Callable[[], float], looked_at: Callable[[], Awaitable[object]]) -> None:
        """Query until cancelled.

        Args:
            bus: connection to the cameras.
            interval_s: returns the interval of the queries, seconds.
            looked_at: returns once a browser is connected.
        """
        while True:
            await looked_at()
            for camera, picture in zip(
                self._cameras, await asyncio.gather(*(self._ask(bus, name) for name in self._cameras)), strict=True
            ):
                self._show(camera, picture)
            try:
                await asyncio.wait_for(self._now.wait(), interval_s())
            except TimeoutError:
                continue
            self._now.clear()

    async def _ask(self, bus: Bus, camera: str) -> Picture:
        if camera in self.held:
            return Picture(jpeg=self.held[camera])
        what = "overlay=markers" if self.mask is None or camera == FEET_CAMERA else f"mask={self.mask}"
        try:
            replies = await bus.get(f"rhot/preview/{camera}?{what}", timeout_s=_TIMEOUT_S)
        except BusError as error:
            return Picture(problem=str(error))
        if not replies:
            service = "rhot feet" if camera == FEET_CAMERA else f"rhot capture --camera {camera}"
            return Picture(problem=f"no answer; is `{service}` running?")
        return Picture(problem=replies[0].error) if replies[0].error else Picture(jpeg=replies[0].payload)
