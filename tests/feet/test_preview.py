"""The picture of the feet: what is drawn where, how often it is coded, and who waits for it."""

from __future__ import annotations

import threading
from dataclasses import replace

import cv2
import numpy as np
import pytest
from still_feet import FEET, head, picture

from rhot.bus import Request
from rhot.errors import ConfigError, DeviceError
from rhot_feet import preview
from rhot_feet.depth.tracker import DepthObservations
from rhot_feet.foot_core import FootCore
from rhot_feet.frames import ColorImage, DepthFrame
from rhot_feet.preview import COLORS, REFUSED, FeetPreview, FootDetections, draw

START_NS = 1_700_000_000_000_000_000


def request(**parameters: str) -> Request:
    return Request("rhot/preview/feet", parameters, b"")


@pytest.fixture(scope="module")
def seen() -> tuple[DepthFrame, FootDetections]:
    """A standing person's picture, after the tracker has known the feet for a while."""
    stage = FootCore(FEET)
    for step in range(49):
        stage.add_head_pose(head(START_NS + step * 20_000_000))
    for index in range(16):
        found = stage.process(picture(index, START_NS + (index + 1) * 50_000_000))
        stage.poses(START_NS + (index + 1) * 50_000_000)
        if found is not None and len(found.view.expected) == len(found.markers.markers) == 2:
            points = {
                side: marker.position + 0.01 * np.random.default_rng(1).uniform(-1.0, 1.0, (200, 3))
                for side, marker in found.markers.markers.items()
            }
            return found.view.frame, replace(found, blobs=DepthObservations({}, {}, None, points))
    raise AssertionError("the feet were not found")


def near(canvas: np.ndarray, color: tuple[int, int, int], tolerance: int = 40) -> np.ndarray:
    return np.asarray((np.abs(canvas.astype(int) - color) < tolerance).all(axis=2))


def test_markers_blobs_and_gates_are_drawn_where_they_are(seen: tuple[DepthFrame, FootDetections]) -> None:
    frame, found = seen
    canvas = draw(frame, found)
    changed = (canvas != frame.color).any(axis=2)
    for side, marker in found.markers.markers.items():
        outline = np.zeros(canvas.shape[:2], np.uint8)
        cv2.polylines(outline, [np.rint(marker.corners).astype(np.int32)], True, 255, 3)
        assert (near(canvas, COLORS[side]) & (outline > 0)).sum() > 0.5 * np.ptp(marker.corners, axis=0).sum()
        uv = np.rint(frame.camera.project(found.blobs.points[side])).astype(int)
        assert changed[uv[:, 1], uv[:, 0]].mean() > 0.9
        expected = found.view.expected[side]
        wide = replace(expected, covariance=0.03**2 * np.eye(3))
        gated = replace(found, view=replace(found.view, expected={side: wide}))
        u, v = frame.camera.project(expected.position[None])[0]
        radius = 4.0 * 0.03 * frame.camera.K[0, 0] / expected.position[2]
        ring = near(draw(frame, gated), COLORS[side])
        assert any(ring[round(v) + dv, round(u + radius) + du] for du in (-2, -1, 0, 1, 2) for dv in (-1, 0, 1))
    assert np.array_equal(draw(frame, found, "none"), frame.color)
    assert not np.array_equal(draw(frame, found, "depth"), canvas)


def test_a_refused_marker_is_red_and_says_why(seen: tuple[DepthFrame, FootDetections]) -> None:
    frame, found = seen
    markers = replace(found.markers, markers={}, refused={"left": "motion"})
    canvas = draw(frame, replace(found, markers=markers))
    assert near(canvas, REFUSED).sum() > 40
    assert near(draw(frame, None), REFUSED).sum() > 40, "says that the head's pose is missing"


class Asking:
    """Answers one question on a thread, as a worker of the bus does."""

    def __init__(self, shown: FeetPreview, **parameters: str) -> None:
        self.got: bytes | Exception = b""
        self._shown, self._parameters = shown, parameters
        self.thread = threading.Thread(target=self._ask)
        self.thread.start()

    def _ask(self) -> None:
        try:
            self.got = self._shown.answer(request(**self._parameters)).payload
        except Exception as error:
            self.got = error


def test_who_asks_waits_for_the_next_picture(
    seen: tuple[DepthFrame, FootDetections], monkeypatch: pytest.MonkeyPatch
) -> None:
    frame, found = seen
    drawn: list[str] = []

    def drawn_plainly(frame: DepthFrame, found: FootDetections | None, overlay: str) -> ColorImage:
        drawn.append(overlay)
        return frame.color

    monkeypatch.setattr(preview, "draw", drawn_plainly)
    monkeypatch.setattr(preview, "_WAIT_S", 60.0)
    monkeypatch.setattr(preview, "_PERIOD_S", 60.0)
    shown = FeetPreview()
    with pytest.raises(DeviceError, match="no picture yet; is the rig started"):
        shown.answer(request())
    shown.begin()
    asking = Asking(shown)
    while asking.thread.is_alive():
        shown.offer(frame, found)
    assert isinstance(asking.got, bytes) and asking.got.startswith(b"\xff\xd8")
    assert shown.answer(request()).payload == asking.got
    assert drawn == ["markers"], "within the period the same picture serves all who ask"
    with pytest.raises(ConfigError, match="overlay=x: only overlay=markers, overlay=depth"):
        shown.answer(request(overlay="x"))
    assert b"overlay=depth" in shown.answer(request(format="json")).payload
