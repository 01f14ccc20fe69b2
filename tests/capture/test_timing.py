from __future__ import annotations

import numpy as np
import pytest

from rhot.messages import MarkerFrame, decode, encode
from rhot_capture.detection.blob import Blob
from rhot_capture.detection.result import Detection
from rhot_capture.timing import marker_frame, row_time_ns

CORNERS = np.array([[1.0, 2.0], [5.0, 2.0], [5.0, 6.0], [1.0, 6.0]])


def detection(v: float, corners: bool = False, points: int = 8) -> Detection:
    contour = np.ones((points, 1, 2), np.int32)
    mask = np.ones((2, 2), np.uint8)
    everywhere = slice(0, 2), slice(0, 2)
    blob = Blob(0, 0, mask, everywhere, mask, (contour,), (0, 0, 2, 2), (0, 0), 4.0, 0.0, False)
    return Detection(10.0, v, 50.0, 0.9, CORNERS if corners else None, blob)


def test_rows_are_exposed_one_after_the_other() -> None:
    assert row_time_ns(1_000, 0.0, 480, 0.004, 0.016) == 1_000 + 2_000_000
    assert row_time_ns(1_000, 479.0, 480, 0.004, 0.016) == 1_000 + 2_000_000 + 16_000_000
    assert row_time_ns(1_000, 100.0, 1, 0.004, 0.016) == 1_000 + 2_000_000


def test_each_marker_has_its_rows_time_and_the_frame_its_middle_rows() -> None:
    message = marker_frame(
        "left", (640, 480), {"a": detection(0.0), "b": detection(479.0)}, 10**18, 0.004, 0.016, 7, {"detect": 0.001}
    )
    assert message.markers["a"].t_ns == 10**18 + 2_000_000
    assert message.markers["b"].t_ns == 10**18 + 18_000_000
    assert message.t_ns == 10**18 + 10_000_000
    assert (message.camera, message.width, message.height, message.frame) == ("left", 640, 480, 7)
    assert message.timing == {"detect": 0.001}


def test_a_global_shutter_has_one_time() -> None:
    message = marker_frame("left", (640, 480), {"a": detection(100.0)}, 10**18, 0.004, 0.0, 0)
    assert message.markers["a"].t_ns is None
    assert message.t_ns == 10**18 + 2_000_000


def test_message_survives_the_wire_with_corners_and_a_long_outline() -> None:
    message = marker_frame(
        "left", (640, 480), {"base": detection(3.0, corners=True, points=1500)}, 10**18, 0.0, 0.0, 0, None, True
    )
    back = decode(encode(message), MarkerFrame)
    assert back == message
    assert back.markers["base"].corners == tuple(tuple(corner) for corner in CORNERS.tolist())
    assert back.markers["base"].outline is not None
    assert 200 < len(back.markers["base"].outline) <= 512


def test_outlines_stay_at_home_unless_asked_for() -> None:
    message = marker_frame("left", (640, 480), {"a": detection(3.0)}, 10**18, 0.0, 0.0, 0)
    assert message.markers["a"].outline is None


def test_times_before_the_epoch_do_not_break_the_message() -> None:
    assert marker_frame("left", (640, 480), {}, -5, 0.0, 0.0, 0).t_ns == pytest.approx(0)
