"""Preview of the depth camera with the detected feet and their predictions."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.bus import Answer, Request, json_answer
from rhot.errors import ConfigError, DeviceError
from rhot.geometry.camera import CameraModel
from rhot.messages import Side
from rhot_feet.depth.tracker import DepthObservations
from rhot_feet.frames import ColorImage, DepthFrame
from rhot_feet.marker.tracker import MarkerObservations
from rhot_feet.prediction import GATE_SIGMAS, FootPrediction

# An image of the feet with its camera's pose, the predictions and the detections.

HEAD_ROTATION_RAD: Final = float(np.radians(0.1))
"""Noise of the head's orientation, per axis; it swings the camera's line of sight."""
HEAD_POSITION_M: Final = 0.0005
"""Noise of the head's position, per axis."""


@dataclass(frozen=True, slots=True)
class View:
    """A picture, where its camera was, and what it is expected to show.

    Attributes:
        frame: the picture.
        T_rig_camera: (4, 4) at the middle of its exposure.
        expected: foot to where the filter predicts it.
    """

    frame: DepthFrame
    T_rig_camera: FloatArray
    expected: Mapping[Side, FootPrediction]

    def in_rig(self, position: FloatArray) -> FloatArray:
        """Return a position (3,) of the camera frame in the rig frame."""
        rig: FloatArray = self.T_rig_camera[:3, :3] @ position + self.T_rig_camera[:3, 3]
        return rig

    def covariance_in_rig(self, position: FloatArray, covariance: FloatArray) -> FloatArray:
        """Return the covariance (3, 3) in the rig frame of a position seen from a head whose own pose is noisy."""
        R = self.T_rig_camera[:3, :3]
        rotation = HEAD_ROTATION_RAD**2 * (float(position @ position) * np.eye(3) - np.outer(position, position))
        rig: FloatArray = R @ (covariance + rotation) @ R.T + HEAD_POSITION_M**2 * np.eye(3)
        return rig


@dataclass(frozen=True, slots=True)
class FootDetections:
    """What a picture showed.

    Attributes:
        view: the picture.
        markers: by the marker stage.
        blobs: by the depth stage.
    """

    view: View
    markers: MarkerObservations
    blobs: DepthObservations


Color = tuple[int, int, int]

COLORS: Final[dict[Side, Color]] = {"left": (80, 220, 80), "right": (255, 170, 60)}
"""Blue, green, red."""
REFUSED: Final[Color] = (60, 60, 255)
_AROUND: Final = ((-1, 0), (1, 0), (0, -1), (0, 1))
_SHADOW: Final[Color] = (0, 0, 0)
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX
_FONT_SCALE: Final = 0.5
_LINE_SCALE: Final = 0.85
"""The page shows the picture at half its width."""
_LINE_PX: Final = 28
_SHADED: Final = 0.35
"""Share of the picture's light that is left behind the lines."""
_QUALITY: Final = 85
_TINT: Final = 0.55
"""Share of a foot's colour on the pixels of its blob."""
_SUBPIXEL_BITS: Final = 4
NO_HEAD: Final = "no pose of the head for this picture: nothing is looked for"

_PERIOD_S: Final = 0.1
"""Between two pictures that are coded, however many ask."""
_WAIT_S: Final = 0.5
_KEEP_EVERY_S: Final = 1.0
"""A picture is kept so often while nobody looks, so that the first who asks gets one at once."""
_OVERLAYS: Final = ("markers", "depth", "none")


def draw(frame: DepthFrame, found: FootDetections | None, overlay: str = "markers") -> ColorImage:
    """Return a picture (H, W, 3) with what was found in it.

    Args:
        frame: is left as it is.
        found: what it showed; None = it was not looked at, because nobody knew where the head was.
        overlay: `markers`: over the colour picture; `depth`: over the depth image in false colours; `none`: nothing.
    """
    canvas = _false_colors(frame) if overlay == "depth" else frame.color.copy()
    if overlay == "none":
        return canvas
    lines: list[tuple[str, Color]] = []
    if found is None:
        lines.append((NO_HEAD, REFUSED))
    else:
        _draw_blobs(canvas, found.blobs, frame.camera)
        for side, expected in found.view.expected.items():
            _draw_gate(canvas, side, expected, frame.camera)
        _draw_markers(canvas, found.markers)
        lines += _lines(found)
    if lines:
        strip = canvas[-(_LINE_PX * len(lines) + 10) :]
        strip[:] = (_SHADED * strip).astype(np.uint8)
    for row, (text, color) in enumerate(lines):
        place = (8, frame.camera.height - 12 - _LINE_PX * (len(lines) - 1 - row))
        _write(canvas, text, place, color, _fitting(text, frame.camera.width - 16))
    return canvas


def _fitting(text: str, width_px: int) -> float:
    """Return the size of letters that is read best and still fits."""
    (long_px, _), _ = cv2.getTextSize(text, _FONT, _LINE_SCALE, 1)
    return _LINE_SCALE * min(1.0, width_px / max(long_px, 1))


def _lines(found: FootDetections) -> list[tuple[str, Color]]:
    """Return a line per foot: what was believed, or why nothing was."""
    lines: list[tuple[str, Color]] = []
    for side, color in COLORS.items():
        expected = found.view.expected.get(side)
        known = "not expected anywhere"
        if expected is not None:
            sigma_mm = 1e3 * float(np.sqrt(np.trace(expected.covariance)))
            known = f"expected to {sigma_mm:.0f} mm"
        if side in found.markers.markers:
            seen = "marker"
        elif side in found.blobs.feet:
            seen = f"depth, {found.blobs.feet[side].points} points"
        else:
            refused = [
                f"{stage} refused ({reasons[side]})"
                for stage, reasons in (("marker", found.markers.refused), ("depth", found.blobs.refused))
                if side in reasons
            ]
            seen = ", ".join(refused) or "not seen"
        lines.append((f"{side}: {seen}; {known}", color))
    return lines


def _draw_markers(canvas: ColorImage, markers: MarkerObservations) -> None:
    for detection in markers.found:
        _outline(canvas, detection.corners, REFUSED, 1)
    for side, marker in markers.markers.items():
        _outline(canvas, marker.corners, COLORS[side], 2)
        u, v = marker.corners.max(axis=0)
        unsure = "" if marker.orientation_known else ", orientation open"
        _write(canvas, f"{side}{unsure}", (round(u) + 6, round(v)), COLORS[side])


def _draw_blobs(canvas: ColorImage, blobs: DepthObservations, camera: CameraModel) -> None:
    for side, points in blobs.points.items():
        if not len(points):
            continue
        uv = np.rint(camera.project(points)).astype(int)
        # Depth is looked at in every other pixel.
        for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
            u, v = uv[:, 0] + du, uv[:, 1] + dv
            within = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
            rows, columns = v[within], u[within]
            mixed = (1.0 - _TINT) * canvas[rows, columns] + _TINT * np.array(COLORS[side])
            canvas[rows, columns] = mixed.astype(np.uint8)
    for side, foot in blobs.feet.items():
        u, v = camera.project(foot.position[None])[0]
        for color, thickness in ((_SHADOW, 3), (COLORS[side], 1)):
            cv2.drawMarker(canvas, (round(u), round(v)), color, cv2.MARKER_CROSS, 15, thickness)


def _draw_gate(canvas: ColorImage, side: Side, expected: FootPrediction, camera: CameraModel) -> None:
    """Draw where a foot is expected: outside of the ellipse nothing is believed to be it."""
    x, y, z = expected.position
    # A foot that is expected nearer than this, or behind the camera, has no gate in the picture.
    if z < 0.1:
        return
    u, v = camera.project(expected.position[None])[0]
    fx, fy = camera.K[0, 0], camera.K[1, 1]
    J = np.array([[fx / z, 0.0, -fx * x / z**2], [0.0, fy / z, -fy * y / z**2]])
    variances, axes = np.linalg.eigh(J @ expected.covariance @ J.T)
    radii = GATE_SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    largest_gate_px = 2000.0
    if not np.isfinite([u, v, *radii]).all() or max(abs(u), abs(v), *radii) > largest_gate_px:
        return
    scale = 1 << _SUBPIXEL_BITS
    angle_deg = float(np.degrees(np.arctan2(axes[1, 0], axes[0, 0])))
    cv2.ellipse(
        canvas,
        (round(scale * u), round(scale * v)),
        (max(1, round(scale * radii[0])), max(1, round(scale * radii[1]))),
        angle_deg,
        0.0,
        360.0,
        COLORS[side],
        1,
        cv2.LINE_AA,
        _SUBPIXEL_BITS,
    )


def _outline(canvas: ColorImage, corners: FloatArray, color: Color, thickness: int) -> None:
    points = np.rint(corners * (1 << _SUBPIXEL_BITS)).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(canvas, [points], True, color, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _write(canvas: ColorImage, text: str, corner: tuple[int, int], color: Color, scale: float = _FONT_SCALE) -> None:
    # A thicker shadow would not do: OpenCV 5 spaces thick letters wider.
    for (du, dv), each in (*((shift, _SHADOW) for shift in _AROUND), ((0, 0), color)):
        cv2.putText(canvas, text, (corner[0] + du, corner[1] + dv), _FONT, scale, each, 1, cv2.LINE_AA)


def _false_colors(frame: DepthFrame) -> ColorImage:
    if frame.depth_mm is None:
        return np.zeros_like(frame.color)
    depth_span_mm = (300.0, 2500.0)
    near, far = depth_span_mm
    level = np.clip(255.0 * (far - frame.depth_mm) / (far - near), 0.0, 255.0).astype(np.uint8)
    colored = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_TURBO), np.uint8)
    colored[frame.depth_mm == 0] = 0
    return colored


@dataclass(frozen=True, slots=True)
class _Seen:
    frame: DepthFrame
    found: FootDetections | None


class FeetPreview:
    """Keeps the newest picture and answers with it; drawing and coding happen where it is asked, not where feet are.

    `offer` is called on the event loop, `answer` on a worker thread.
    """

    def __init__(self) -> None:
        self._seen: _Seen | None = None
        self._seen_s = -_KEEP_EVERY_S
        self._passed_over = 0
        self._running = False
        self._wanted, self._fresh = threading.Event(), threading.Event()
        self._coding = threading.Lock()
        self._coded: dict[str, tuple[float, bytes]] = {}

    def begin(self) -> None:
        """Forget the pictures of an earlier session: they show what is there no longer."""
        self._seen, self._running = None, True
        self._coded.clear()

    def end(self) -> None:
        """Let nobody wait for pictures any more."""
        self._running = False

    def offer(self, frame: DepthFrame, found: FootDetections | None) -> None:
        """Keep a picture if somebody waits for one, or has not got one for long.

        Args:
            frame: its images are copied, because a camera may write over them.
            found: see `draw`.
        """
        now_s = time.monotonic()
        wanted = self._wanted.is_set()
        if not wanted and now_s - self._seen_s < _KEEP_EVERY_S:
            return
        # The depth stage looks at one of so many pictures while all markers are seen; that one shows more.
        if found is not None and not found.blobs.points and self._passed_over < 4 - 1:
            self._passed_over += 1
            return
        self._passed_over = 0
        depth_mm = None if frame.depth_mm is None else frame.depth_mm.copy()
        self._seen = _Seen(replace(frame, color=frame.color.copy(), depth_mm=depth_mm), found)
        self._seen_s = now_s
        if wanted:
            self._wanted.clear()
            self._fresh.set()

    def answer(self, request: Request) -> Answer:
        """Answer with a JPEG of the newest picture.

        Raises:
            ConfigError: an overlay that there is not.
            DeviceError: there is no picture yet.
        """
        if request.wants_json:
            return json_answer(_ABOUT)
        overlay = request.parameters.get("overlay", _OVERLAYS[0])
        if overlay not in _OVERLAYS:
            raise ConfigError(f"overlay={overlay}: only {', '.join(f'overlay={each}' for each in _OVERLAYS)} are known")
        with self._coding:
            coded_s, jpeg = self._coded.get(overlay, (-_PERIOD_S, b""))
            if jpeg and time.monotonic() - coded_s < _PERIOD_S:
                return Answer(jpeg, "image/jpeg")
            if self._running:
                self._fresh.clear()
                self._wanted.set()
                self._fresh.wait(_WAIT_S)
            seen = self._seen
            if seen is None:
                raise DeviceError("the depth camera has delivered no picture yet; is the rig started (`rhot start`)?")
            _, data = cv2.imencode(".jpg", draw(seen.frame, seen.found, overlay), (cv2.IMWRITE_JPEG_QUALITY, _QUALITY))
            self._coded[overlay] = time.monotonic(), bytes(data)
            return Answer(bytes(data), "image/jpeg")


_ABOUT: Final[dict[str, Any]] = {
    "query": "?overlay=markers (without any), ?overlay=depth or ?overlay=none",
    "markers": "believed markers in the foot's colour, others red; blobs tinted; ellipses: where a foot is expected",
}
