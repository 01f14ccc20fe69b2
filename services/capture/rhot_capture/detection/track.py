"""Where a marker was, as a soft preference for where it is."""

from __future__ import annotations

import math
from typing import Final

from rhot_capture.detection.cutouts import Region

_MEMORY_FRAMES: Final = 10
"""Frames without the marker after which nothing is preferred any more; chosen: a sixth of a second at 60 Hz."""
_GATE_MIN_PX: Final = 25.0
_GATE_RATIO: Final = 1.5
_GATE_GROWTH: Final = 0.5
"""The gate is a standard deviation: the larger of a least one, pixels, and a multiple of the root of the marker's area,
and by so much of itself wider for each frame without the marker. Chosen: a fingertip that stops at once from 2 m/s is
22 pixels off the prediction at 60 Hz, 80 cm away."""
_SLIVER_FRAMES: Final = 3
_SLIVER_GATE_PX: Final = 6.0
"""What is left of a marker that is being covered is believed so many frames, and so near to the prediction; chosen."""
_FLOOR: Final = 0.05
"""A blob far from the prediction keeps this much: it must be 20 times better to win, and wins when it is alone."""
_MARGIN_PX: Final = 8.0
_MARGIN_PER_MOTION: Final = 0.5
"""What a hand turns aside of its motion from one frame to the next; a tip at 1.5 m/s moves 17 pixels in a frame of
1/60 s, 80 cm away."""


class MarkerTrack:
    """One marker's last position, motion per frame and size in one camera."""

    def __init__(self) -> None:
        self._u = 0.0
        self._v = 0.0
        self._motion_u = 0.0
        self._motion_v = 0.0
        self._area = 0.0
        self._reach = (0.0, 0.0)
        self._missed = _MEMORY_FRAMES

    @property
    def margin_px(self) -> float:
        """Room to leave around where the marker is expected; more the faster it moves."""
        return _MARGIN_PX + _MARGIN_PER_MOTION * max(abs(self._motion_u), abs(self._motion_v))

    @property
    def expected(self) -> tuple[float, float] | None:
        """U and v of where the marker is expected, pixels; None when it was not in the last frame."""
        return None if self._missed > 0 else (self._u + self._motion_u, self._v + self._motion_v)

    def region(self, margin_px: float, height: int, width: int) -> Region | None:
        """Return where in the picture the marker is expected; None when it was not in the last frame.

        Args:
            margin_px: room on all sides.
            height: of the picture, pixels.
            width: of the picture, pixels.
        """
        if (expected := self.expected) is None:
            return None
        u, v = expected
        reach_u, reach_v = self._reach[0] + margin_px, self._reach[1] + margin_px
        left, top = max(0, int(u - reach_u)), max(0, int(v - reach_v))
        right, bottom = min(width, int(u + reach_u) + 1), min(height, int(v + reach_v) + 1)
        return Region(left, top, right, bottom) if left < right and top < bottom else None

    def preference(self, u: float, v: float, area: float) -> float:
        """Return how well a blob continues the track, 0 to 1; 1 when there is no track.

        Args:
            u: middle of the blob, pixels to the right.
            v: middle of the blob, pixels down.
            area: of the blob, square pixels.
        """
        if self._missed >= _MEMORY_FRAMES:
            return 1.0
        frames = self._missed + 1
        gate = max(_GATE_MIN_PX, _GATE_RATIO * math.sqrt(self._area)) * (1.0 + _GATE_GROWTH * self._missed)
        away = math.hypot(u - self._u - frames * self._motion_u, v - self._v - frames * self._motion_v)
        ratio = min(area, self._area) / max(area, self._area)
        return max(_FLOOR, math.exp(-0.5 * (away / gate) ** 2) * math.sqrt(ratio))

    def continues(self, u: float, v: float) -> bool:
        """Tell whether a position is so near to where the marker must be that even a sliver of its colour is believed.

        Args:
            u: middle of the blob, pixels to the right.
            v: middle of the blob, pixels down.
        """
        frames = self._missed + 1
        away = math.hypot(u - self._u - frames * self._motion_u, v - self._v - frames * self._motion_v)
        return frames <= _SLIVER_FRAMES and away <= _SLIVER_GATE_PX

    def update(self, u: float, v: float, area: float, reach_px: tuple[float, float] = (0.0, 0.0)) -> None:
        """Update the track with the marker's position in this frame.

        Args:
            u: centre, pixels to the right.
            v: centre, pixels down.
            area: square pixels.
            reach_px: how far it extends from its centre to the sides, and up and down.
        """
        if self._missed == 0:
            self._motion_u, self._motion_v = u - self._u, v - self._v
        else:
            self._motion_u = self._motion_v = 0.0
        self._u, self._v, self._area, self._reach = u, v, area, reach_px
        self._missed = 0

    def miss(self) -> None:
        """Note that the marker was not seen in this frame."""
        self._missed += 1
