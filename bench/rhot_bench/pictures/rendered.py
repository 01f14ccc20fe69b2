"""Rendered stereo pictures as a stranger's rig: set up, calibrated by our own commands, and its markers found.

The folder holds chessboards (`C`), one pair of the open hand with boxes round its markers (`K`), sequences (`G1`,
`G2`), `calib.json` with the true timing, and a scorer; see its README. Nothing of the truth reaches the rig but what a
person would know: the picture size, the rate, exposure and read-out that the camera was set to, the size of the patch
that was glued on, and two measures of the hand by a ruler.
"""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from rhot.errors import CalibrationError, ConfigError
from rhot.messages import MarkerFrame, Side
from rhot.offline import core
from rhot.recording import Recording, load_recording
from rhot.recording.picture_file import read_picture
from rhot.rig import Rig, load_rig
from rhot.rig.folder import CAMERAS_FILE, COLORS_FILE, HAND_FILE, RIG_FILE, write_text_atomic
from rhot.rig.template import rig_template
from rhot.rig.toml_edit import change_rig_file

CAMERAS: Final = ("left", "right")
SEQUENCES: Final = ("G1", "G2")
BOARDS, COLOURS = "C", "K"
_PARTS: Final = (
    *(f"{sequence}/{camera}/timestamps.csv" for sequence in (BOARDS, COLOURS, *SEQUENCES) for camera in CAMERAS),
    *(f"{sequence}/{truth}" for sequence in SEQUENCES for truth in ("truth_frames.csv", "truth_500hz.csv.gz")),
    f"{COLOURS}/boxes.json",
    "calib.json",
    "hand.json",
)
MARKER_FRAMES: Final = "{sequence}.jsonl"


_BOARD: Final = "9x6 inner corners, 25.0 mm"


@dataclass(frozen=True, slots=True)
class Measures:
    """What a person measures with a ruler before the first recording.

    Attributes:
        length_m: of the hand, wrist crease to the tip of the middle finger.
        width_m: of the same hand across the knuckles.
        patch_m: the patch across and along the hand.
        board: the chessboard's inner corners along and across.
        square_m: side of one of its squares.
        side: of the hand.
    """

    length_m: float
    width_m: float
    patch_m: tuple[float, float]
    board: tuple[int, int]
    square_m: float
    side: Side = "right"

    @classmethod
    def of(cls, data: Path, *, width_m: float | None = None, side: Side = "right") -> Measures:
        """Return what a ruler would have shown, in whole millimetres, of the things in a set of pictures.

        Args:
            data: the rendered pictures; `hand.json` describes the hand, `C/truth_boards.json` names the board.
            width_m: of the hand, which the set does not state; by proportion when not given.
            side: of the hand.

        Raises:
            ConfigError: the set does not say it in the form that its README gives.
        """
        hand_path, board_path = data / "hand.json", data / BOARDS / "truth_boards.json"
        try:
            hand = json.loads(hand_path.read_text(encoding="utf-8"))
            knuckle = math.hypot(*hand["mcp_in_hand_frame_mm"]["middle"])
            length_m = 1e-3 * round(knuckle + sum(hand["bone_lengths_mm"]["middle"].values()))
            across, along, *_ = (1e-3 * float(edge) for edge in hand["base_patch_mm"])
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise ConfigError(f"{hand_path}: does not describe a hand and its patch ({error!r})") from error
        try:
            # Changed copies have no truth of their boards.
            pattern = json.loads(board_path.read_text(encoding="utf-8"))["pattern"] if board_path.exists() else _BOARD
            columns, rows, square_mm = re.findall(r"[\d.]+", pattern)
            board = int(columns), int(rows)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{board_path}: does not name its pattern as `{_BOARD}`") from error
        # Width of a hand by its length where nobody measured it: what a ruler gave of the first set's hand.
        width_m = 1e-3 * round(1e3 * (74.0 / 172.0) * length_m) if width_m is None else width_m
        return cls(length_m, width_m, (across, along), board, 1e-3 * float(square_mm), side)


def require_pictures(data: Path) -> Path:
    """Return the folder that holds the rendered pictures: `data` itself or `data/rendered`.

    Raises:
        ConfigError: neither holds them, or parts are missing.
    """
    for folder in (data, data / "rendered"):
        if (folder / "score.py").is_file() and (folder / SEQUENCES[0]).is_dir():
            if missing := [part for part in _PARTS if not (folder / part).exists()]:
                raise ConfigError(
                    f"{folder}: {', '.join(missing)} missing; copy the whole set of rendered pictures again"
                )
            return folder
    raise ConfigError(
        f"{data}: holds no rendered pictures (score.py, {', '.join(SEQUENCES)}); name the folder that does"
    )


def prepare_rig(data: Path, folder: Path, measures: Measures | None = None) -> Rig:
    """Set up a rig in a folder and calibrate it by our own commands; what is already calibrated stays.

    Args:
        data: the rendered pictures.
        folder: of the rig; made when it is not there.
        measures: by ruler; those of a right hand when not given.

    Raises:
        CalibrationError: one of the commands refused.
    """
    measures = measures or Measures.of(data)
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / RIG_FILE).exists():
        write_rig(data, folder, measures)
    columns, rows = measures.board
    if not (folder / CAMERAS_FILE).exists():
        square = f"{1e3 * measures.square_m:g}"
        _calibrate(folder, "cameras", str(data / BOARDS), "--board", f"{columns}x{rows}", "--square-mm", square)
    if not (folder / COLORS_FILE).exists():
        _calibrate(folder, "colors", *_colour_boxes(data / COLOURS))
    if not (folder / HAND_FILE).exists():
        length, width = f"{1e3 * measures.length_m:g}", f"{1e3 * measures.width_m:g}"
        _calibrate(folder, "hand", "--length-mm", length, "--width-mm", width)
    return load_rig(folder)


def write_rig(data: Path, folder: Path, measures: Measures) -> None:
    """Write `rig.toml` as a person would who set the cameras up and measured the patch."""
    timing = load_recording(data / SEQUENCES[0]).cameras[CAMERAS[0]].timing
    text = rig_template(
        folder=str(folder),
        name="rendered",
        exposure_s=timing.exposure_s,
        readout_s=timing.readout_s,
        sides=(measures.side,),
    )
    write_text_atomic(folder / RIG_FILE, text)
    down, across = read_picture(min((data / COLOURS / CAMERAS[0]).glob("*.jpg"))).shape[:2]
    change_rig_file(folder, {("markers", "base"): {"size_m": list(measures.patch_m)}})
    change_rig_file(folder, {("cameras", camera): {"width": across, "height": down} for camera in CAMERAS})
    centre = json.loads((data / "calib.json").read_text(encoding="utf-8"))["right_camera_centre_in_left_frame"]
    if centre[0] < 0.0:
        # Of a mirrored copy; on which side a camera stands, everybody sees.
        change_rig_file(folder, {("cameras", CAMERAS[1]): {"position_m": [-0.1, 0.0, 0.0]}})


def at_rate_of(rig: Rig, recording: Recording) -> Rig:
    """Return the rig with its cameras set to the rate that the recording was taken at, as its user would have."""
    cameras = {}
    for name, camera in rig.config.cameras.items():
        period_s = float(np.median(np.diff(recording.cameras[name].t_ns))) * 1e-9
        cameras[name] = camera.model_copy(update={"rate_hz": round(1.0 / period_s, 3)})
    return replace(rig, config=rig.config.model_copy(update={"cameras": cameras}))


def found_markers(
    rig: Rig, data: Path, sequence: str, keep: Path | None, advance: Callable[[], None] = lambda: None
) -> list[MarkerFrame]:
    """Return the marker frames of a sequence: as kept by an earlier run, or found in its pictures.

    Args:
        rig: calibrated.
        data: the rendered pictures.
        sequence: `G1` or `G2`.
        keep: folder for the frames as JSON Lines; None = keep nothing.
        advance: called after each frame.
    """
    file = None if keep is None else keep / MARKER_FRAMES.format(sequence=sequence)
    if file is not None and file.exists():
        frames = list(read_marker_frames(file))
        for _ in frames:
            advance()
        return frames
    frames = []
    for frame in core("capture")(rig, load_recording(data / sequence)):
        frames.append(frame)
        advance()
    if file is not None:
        write_text_atomic(file, "".join(_line(frame) for frame in frames))
    return frames


def read_marker_frames(file: Path) -> Iterator[MarkerFrame]:
    """Yield the marker frames of a file as `found_markers` keeps it, or of `rhot process`; other keys are left out."""
    with file.open(encoding="utf-8") as lines:
        for line in lines:
            message = json.loads(line)
            if message["key"].startswith("rhot/markers/"):
                yield MarkerFrame.model_validate_json(json.dumps(message["value"]))


def _line(frame: MarkerFrame) -> str:
    value = frame.model_dump_json(exclude_none=True)
    return f'{{"key": "rhot/markers/{frame.camera}", "value": {value}}}\n'


def _colour_boxes(data: Path) -> list[str]:
    """Return pictures and boxes as the arguments of `rhot calibrate colors`."""
    boxes: dict[str, Any] = json.loads((data / "boxes.json").read_text(encoding="utf-8"))["cameras"]
    pictures, picks = [], []
    for number, camera in enumerate(CAMERAS, start=1):
        pictures.append(str(min((data / camera).glob("*.jpg"))))
        for marker, seen in boxes[camera].items():
            left, top, right, bottom = seen["box"]
            picks += ["--box", f"{marker}={left:.0f},{top:.0f},{right - left:.0f},{bottom - top:.0f}@{number}"]
    return [*pictures, *picks]


def _calibrate(rig: Path, what: str, *arguments: str) -> None:
    command: Sequence[str] = [sys.executable, "-m", "rhot", "-q", "calibrate", what, *arguments, "--rig", str(rig)]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL, env=environment
    )
    if done.returncode:
        raise CalibrationError(f"`rhot calibrate {what}` refused the rendered pictures: {done.stderr.strip()}")
