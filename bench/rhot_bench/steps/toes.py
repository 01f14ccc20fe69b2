"""Depth pictures of really walking feet with toes marked by hand: followed from the first marks alone.

There is no headset and no sensor: each foot is expected where it would be if it went on as before. The lens is not
known; a D435's colour camera at 640x480 has a focal length of about 610 px.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.aruco_dictionary import marker_dictionary
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import Side
from rhot_bench.feet.runs import SIDES
from rhot_bench.number_table import read_columns
from rhot_bench.thesis.feet import ThesisFeet
from rhot_feet.depth.tracker import DepthTracker
from rhot_feet.frames import DepthFrame, pinhole
from rhot_feet.prediction import FootPrediction
from rhot_feet.sources.depth_camera.recorded_frames import load_depth_recording

NEAR_PX: Final = 15.0
FOCAL_PX: Final = 610.0
_RATE_HZ: Final = 30.0
_DEPTH_RANGE_M: Final = (0.3, 4.0)
_MARKED_M: Final = 0.01
"""How well the first marks tell a foot's position, standard deviation per axis."""
_EXPECTED_M: Final = 0.04
"""The same of a foot that goes on as before, 1/30 s later."""
_MARKS: Final = "manual_toe_tips.csv"


class ToeWalk:
    """A recording, and pixels that somebody has marked in some of its pictures.

    Attributes:
        camera: its lens.
        marks: number of a picture to its toes: side to (u, v, depth), pixels and millimetres.
    """

    def __init__(self, folder: Path, focal_px: float = FOCAL_PX) -> None:
        """Look at the files.

        Raises:
            ConfigError: something is missing or unreadable; names the file.
        """
        K = np.array([[focal_px, 0.0, 320.0], [0.0, focal_px, 240.0], [0.0, 0.0, 1.0]])
        self.camera = pinhole(640, 480, K, np.empty(0))
        self.recording = load_depth_recording(folder, camera=self.camera, rate_hz=_RATE_HZ)
        columns = {side: [f"{side}_toe_{name}" for name in ("u", "v", "depth_mm")] for side in SIDES}
        table = read_columns(folder / _MARKS, ["frame", *columns["left"], *columns["right"]])
        positions = {side: np.stack([table[name] for name in names], axis=1) for side, names in columns.items()}
        numbers = [int(number) for number in table["frame"]]
        self.marks = {number: {side: positions[side][row] for side in SIDES} for row, number in enumerate(numbers)}
        first = self.recording.frame(0).index
        if first not in self.marks:
            raise ConfigError(f"{folder / _MARKS}: the toes of the first picture ({first}) are not marked")

    def off_px(self, frame: DepthFrame, positions: Mapping[Side, FloatArray]) -> list[float]:
        """Return how far positions (3,), metres, camera frame, lie from a picture's marks; nothing without marks."""
        marks = self.marks.get(frame.index, {})
        return [
            float(np.linalg.norm(self.camera.project(position[None])[0] - marks[side][:2]))
            for side, position in positions.items()
            if side in marks
        ]


def follow_toes(walk: ToeWalk) -> FloatArray:
    """Return the distances from the marks, pixels, of the feet's depth stage; one not found is where it was bound."""
    tracker = DepthTracker(_DEPTH_RANGE_M)
    positions: dict[Side, FloatArray] = {}
    speeds = {side: np.zeros(3) for side in SIDES}
    off: list[float] = []
    for frame in walk.recording.frames():
        if not positions:
            positions = {side: _seen_at(mark, walk.camera) for side, mark in walk.marks[frame.index].items()}
            sure = {side: FootPrediction(position, _MARKED_M**2 * np.eye(3)) for side, position in positions.items()}
            tracker.detect(frame, {}, sure)
            continue
        bound = {side: FootPrediction(positions[side] + speeds[side], _EXPECTED_M**2 * np.eye(3)) for side in SIDES}
        found = tracker.detect(frame, bound, {}).feet
        for side in SIDES:
            now = found[side].position if side in found else positions[side] + speeds[side]
            speeds[side] = 0.5 * speeds[side] + 0.5 * (now - positions[side])
            positions[side] = now
        off += walk.off_px(frame, positions)
    return np.array(off)


def thesis_toes(walk: ToeWalk) -> FloatArray:
    """Return the same of the thesis's depth stage, of the feet that it reports."""
    thesis = ThesisFeet(marker_dictionary("4X4_50"), {"left": 0, "right": 1}, 0.04)
    off: list[float] = []
    for number, frame in enumerate(walk.recording.frames()):
        if frame.depth_mm is None:
            continue
        if number == 0:
            for side, (u, v, depth_mm) in walk.marks[frame.index].items():
                thesis.start(side, (float(u), float(v)), float(depth_mm))
        feet = thesis.detect(frame.color, frame.depth_mm, walk.camera)
        if number:
            off += walk.off_px(frame, {side: foot.position for side, foot in feet.items()})
    return np.array(off)


def _seen_at(mark: FloatArray, camera: CameraModel) -> FloatArray:
    """Return the position (3,), metres, camera frame, of a mark: u, v, depth in millimetres."""
    x, y = camera.undistort(mark[None, :2])[0]
    position: FloatArray = np.array([x, y, 1.0]) * mark[2] * 1e-3
    return position
