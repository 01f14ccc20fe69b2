"""Preview pictures: the last frame with its detections, or with the mask of one marker's colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.errors import ConfigError
from rhot_capture.detection.result import Detection

_QUALITY: Final = 85
_LINE: Final = (255, 255, 255)
_SHADOW: Final = (0, 0, 0)
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_FONT_SCALE: Final = 0.45
_LINE_PX: Final = 13
"""Smallest distance between two lines of text."""


def preview_jpeg(
    image: ImageArray,
    detections: Mapping[str, Detection] | None = None,
    mask: ImageArray | None = None,
) -> bytes:
    """Return a JPEG of a frame.

    Args:
        image: (H, W, 3) uint8 BGR; not modified.
        detections: markers to draw: outline, centre and name.
        mask: (H, W) uint8; pixels that are 0 are darkened.

    Raises:
        ConfigError: the picture cannot be encoded.
    """
    return _coded(image, detections, mask, ".jpg", (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))


def preview_png(
    image: ImageArray,
    detections: Mapping[str, Detection] | None = None,
    mask: ImageArray | None = None,
) -> bytes:
    """Return a PNG of a frame, lossless for measurements; see `preview_jpeg`."""
    # Lowest compression level: noise hardly compresses, and the camera's CPU is busy.
    return _coded(image, detections, mask, ".png", (cv2.IMWRITE_PNG_COMPRESSION, 1))


def _coded(
    image: ImageArray,
    detections: Mapping[str, Detection] | None,
    mask: ImageArray | None,
    suffix: str,
    options: Sequence[int],
) -> bytes:
    canvas = image.copy()
    if mask is not None:
        canvas[mask == 0] //= 5
    for detection in (detections or {}).values():
        _draw_rim(canvas, detection)
    mark_positions(canvas, {f"{name} {each.score:.2f}": (each.u, each.v) for name, each in (detections or {}).items()})
    ok, data = cv2.imencode(suffix, canvas, options)
    if not ok:
        raise ConfigError(f"preview: a frame of shape {image.shape} cannot be encoded as a picture")
    return bytes(data)


def mark_positions(canvas: ImageArray, positions: Mapping[str, tuple[float, float]]) -> None:
    """Draw a cross at each position (u, v) with its text beside it; overlapping texts are moved down."""
    taken: list[tuple[int, int, int]] = []
    for text, (u, v) in sorted(positions.items(), key=lambda each: each[1][1]):
        centre = (round(u), round(v))
        width = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)[0][0]
        x, y = centre[0] + 8, centre[1] - 8
        while any(x < right and left < x + width and abs(y - other) < _LINE_PX for left, right, other in taken):
            y += 2
        taken.append((x, x + width, y))
        for color, thickness in ((_SHADOW, 3), (_LINE, 1)):
            cv2.drawMarker(canvas, centre, color, cv2.MARKER_CROSS, 11, thickness)
            cv2.putText(canvas, text, (x, y), _FONT, _FONT_SCALE, color, thickness, cv2.LINE_AA)


def _draw_rim(canvas: ImageArray, detection: Detection) -> None:
    outline = np.round(detection.outline).astype(np.int32).reshape(-1, 1, 2)
    for point in outline[:, 0]:
        cv2.circle(canvas, (int(point[0]), int(point[1])), 0, _LINE, 1)
    if detection.corners is not None:
        corners = np.round(detection.corners * 16.0).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(canvas, [corners], True, (0, 255, 255), 1, cv2.LINE_AA, 4)
