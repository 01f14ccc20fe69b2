"""Time stamps of markers: mid-exposure of the marker's image row (rolling shutter).

    t(v) = t_first_row + readout · v / (H − 1) + exposure / 2

with t_first_row the start of the first row's exposure and readout the time between the read-out of the first and of
the last row.
"""

from __future__ import annotations

from collections.abc import Mapping

from rhot.messages import MarkerFrame
from rhot_capture.detection.result import Detection


def row_time_ns(t_first_row_ns: int, row: float, height: int, exposure_s: float, readout_s: float) -> int:
    """Return the mid-exposure time of an image row on the clock of `t_first_row_ns`.

    Args:
        t_first_row_ns: start of the first row's exposure, nanoseconds.
        row: v, pixels; may lie between rows.
        height: rows of the image.
        exposure_s: exposure time of each row.
        readout_s: time between the read-out of the first and of the last row.
    """
    rolling_s = readout_s * row / (height - 1) if height > 1 else 0.0
    return t_first_row_ns + round(1e9 * (rolling_s + 0.5 * exposure_s))


def marker_frame(
    camera: str,
    size: tuple[int, int],
    detections: Mapping[str, Detection],
    t_first_row_ns: int,
    exposure_s: float,
    readout_s: float,
    frame: int,
    timing: Mapping[str, float] | None = None,
    outlines: bool = False,
) -> MarkerFrame:
    """Return the message of one frame.

    The frame's time is that of its middle row; with a rolling shutter, each marker has the time of its own row.

    Args:
        camera: name of the camera.
        size: width and height, pixels.
        detections: markers seen.
        t_first_row_ns: start of the first row's exposure, rig clock.
        exposure_s: exposure time of each row.
        readout_s: time between the read-out of the first and of the last row.
        frame: the source's frame counter.
        timing: seconds of each part.
        outlines: send the outlines too.
    """
    width, height = size

    def time_of(row: float) -> int:
        return max(0, row_time_ns(t_first_row_ns, row, height, exposure_s, readout_s))

    markers = {
        name: _marker(detection, time_of(detection.v) if readout_s > 0.0 else None, outlines)
        for name, detection in detections.items()
    }
    # Validating all at once takes about half as long as validating each marker and then the frame.
    return MarkerFrame.model_validate(
        {
            "t_ns": time_of(0.5 * (height - 1)),
            "camera": camera,
            "width": width,
            "height": height,
            "markers": markers,
            "timing": dict(timing or {}),
            "frame": frame,
        }
    )


def _marker(detection: Detection, t_ns: int | None, with_outline: bool) -> dict[str, object]:
    """Return the fields of `rhot.messages.Marker`."""
    outline = None
    if with_outline:
        points = detection.outline
        # 512 points is what a message may carry.
        every = max(1, -(-len(points) // 256))
        outline = tuple(map(tuple, points[::every].tolist()))
    return {
        "u": detection.u,
        "v": detection.v,
        "area": detection.area,
        "score": detection.score,
        "t_ns": t_ns,
        "corners": None if detection.corners is None else tuple(map(tuple, detection.corners.tolist())),
        "outline": outline,
        "skin_side": detection.skin_side,
    }
