"""Detects the markers in the first pictures of one camera, on whatever machine this is.

Usage: detect.py RIG RECORDING CAMERA FRAMES tracked|searched ROUNDS OUT: the pictures are read once and looked at
ROUNDS times, so that two runs differ by nothing but whole rounds of detection; what the last one found goes to OUT.
"searched" forgets after each picture what it has found.
"""

from __future__ import annotations

import json
import sys
from itertools import islice
from pathlib import Path

import cv2

from rhot.anatomy.markers import own_paints
from rhot.messages import MarkerFrame
from rhot.recording import PictureTrack, load_recording
from rhot.rig import load_rig
from rhot.rig.colors import load_colors
from rhot_capture.detection.color_table import camera_tables
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.sources.recorded import read_pictures
from rhot_capture.timing import marker_frame


def main(rig_path: Path, recording_path: Path, camera: str, frames: int, how: str, rounds: int, out: Path) -> None:
    """Write the marker frames as JSON."""
    cv2.setNumThreads(1)
    rig, recording = load_rig(rig_path), load_recording(recording_path)
    track = recording.cameras[camera]
    assert isinstance(track, PictureTrack)
    tables = camera_tables(load_colors(rig.colors_path), list(own_paints(rig.config.markers)), recording.cameras)
    pictures = list(islice(read_pictures(track), frames))
    size = (rig.cameras[camera].width, rig.cameras[camera].height)
    found: list[MarkerFrame] = []
    for _ in range(rounds):
        found = list[MarkerFrame]()
        for number, picture in enumerate(pictures):
            if number == 0 or how == "searched":
                detector = MarkerDetector(rig.config.markers, tables[camera], *size)
            found.append(marker_frame(camera, size, detector.detect(picture), number, 0.0, 0.0, number))
    out.write_text(json.dumps([frame.model_dump(mode="json") for frame in found]))


if __name__ == "__main__":
    rig_name, recording_name, camera_name, frame_count, how_looked, round_count, out_name = sys.argv[1:]
    main(
        Path(rig_name),
        Path(recording_name),
        camera_name,
        int(frame_count),
        how_looked,
        int(round_count),
        Path(out_name),
    )
