"""Track of a marker in one camera: a soft preference for blobs near the predicted position."""

from __future__ import annotations

import math
from typing import Final

from rhot.geometry.region import Region

_MEMORY_FRAMES: Final = 10
"""Frames without the marker after which the track is dropped; chosen: a sixth of a second at 60 Hz."""
_GATE_MIN_PX: Final = 25.0
_GATE_RATIO: Final = 1.5
_GATE_GROWTH: Final = 0.5
"""The gate is a standard deviation: the maximum of this many pixels and this multiple of the root of the marker's area,
growing by this share with each frame without the marker. Chosen: a fingertip that stops suddenly from 2 m/s is 22
pixels from the prediction at 60 Hz and 80 cm."""
_SLIVER_FRAMES: Final = 3
_SLIVER_GATE_PX: Final = 6.0
"""Thin remains of a marker being occluded are accepted after at most this many frames, counted from the last detection,
and within this distance from the prediction; chosen."""
_MARGIN_PX: Final = 8.0
_MARGIN_PER_MOTION: Final = 0.5
"""Change of motion between two frames, as a share of it; a tip at 1.5 m/s moves 17 pixels in 1/60 s at 80 cm."""


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
    def is_recent(self) -> bool:
        """Whether the marker was seen recently, so that its position is predicted."""
        return self._missed < _MEMORY_FRAMES

    @property
    def margin_px(self) -> float:
        """Margin around the predicted position; grows with the speed."""
        return _MARGIN_PX + _MARGIN_PER_MOTION * max(abs(self._motion_u), abs(self._motion_v))

    @property
    def expected(self) -> tuple[float, float] | None:
        """Predicted u and v, pixels; None if the marker was not in the last frame."""
        return None if self._missed > 0 else (self._u + self._motion_u, self._v + self._motion_v)

    def region(self, margin_px: float, height: int, width: int) -> Region | None:
        """Return the region in which the marker is predicted; None if it was not in the last frame.

        Args:
            margin_px: on all sides.
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
        """Return the agreement of a blob with the track, 0 to 1; 1 if there is no track.

        Args:
            u: centre of the blob, pixels to the right.
            v: centre of the blob, pixels down.
            area: of the blob, square pixels.
        """
        if not self.is_recent:
            return 1.0
        frames = self._missed + 1
        gate = max(_GATE_MIN_PX, _GATE_RATIO * math.sqrt(self._area)) * (1.0 + _GATE_GROWTH * self._missed)
        away = math.hypot(u - self._u - frames * self._motion_u, v - self._v - frames * self._motion_v)
        ratio = min(area, self._area) / max(area, self._area)
        # Smallest preference: a blob far from the prediction must be 20 times better to be chosen, unless it
        # is alone.
        return max(0.05, math.exp(-0.5 * (away / gate) ** 2) * math.sqrt(ratio))

    def continues(self, u: float, v: float) -> bool:
        """Return whether a blob is near enough to the prediction to accept even a thin one.

        Args:
            u: centre of the blob, pixels to the right.
            v: centre of the blob, pixels down.
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
            reach_px: half of its width and of its height, pixels.
        """
        if self._missed == 0:
            self._motion_u, self._motion_v = u - self._u, v - self._v
        else:
            self._motion_u = self._motion_v = 0.0
        self._u, self._v, self._area, self._reach = u, v, area, reach_px
        self._missed = 0

    def miss(self) -> None:
        """Update the track with a frame without the marker."""
        self._missed += 1
