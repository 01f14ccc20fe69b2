"""Reading the depth recording of one camera: colour and depth pictures, their times and the lens.

    <camera>/color/NNNNNN.jpg|png      8-bit pictures
    <camera>/depth/NNNNNN.png          16-bit, millimetres along the optical axis, aligned to colour, 0 = none
    <camera>/timestamps.csv            `frame,t_ns`: middle of the colour picture's exposure, rig clock
    <camera>/intrinsics.json           `{"width", "height", "K": 3x3, "distortion": [k1, k2, p1, p2, …]}`

A frame without a depth picture has no depth; a depth picture without a colour picture is an error. Where the recording
states no times or no lens, the caller may: `rate_hz` and `camera`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from pydantic import ValidationError

from rhot.arrays import IntArray
from rhot.atomic_file import why_unread
from rhot.errors import ConfigError
from rhot.geometry.camera import CameraModel
from rhot.messages import first_problem
from rhot.recording.folder import COLOR_FOLDER, DEPTH_FOLDER, INTRINSICS_FILE, TIMES_FILE, numbered_pictures
from rhot.recording.picture_file import read_picture
from rhot.recording.tables import read_times
from rhot.rig.calibration import Intrinsics
from rhot.text import parse_json, read_text
from rhot_feet.frames import DepthFrame, DepthImage, pinhole

# A depth recording, delivered at the pace at which it was taken.


class RecordedDepthSource:
    """Replays a recording as if it were live.

    The first frame's time becomes the start of the session; the distances between frames stay. Frames that nobody asked
    for in time are left out, as a camera would.
    """

    def __init__(
        self,
        load: Callable[[], DepthRecording],
        now_ns: Callable[[], int],
        *,
        loop: bool = False,
    ) -> None:
        """Prepare; `open` looks at the files.

        Args:
            load: finds the recording.
            now_ns: rig time.
            loop: start again at the end.
        """
        self._load = load
        self._now_ns = now_ns
        self._loop = loop
        self._recording: DepthRecording | None = None
        self._start_ns = 0
        self._next = 0
        self._closed = threading.Event()

    def open(self, start_ns: int) -> None:
        """Find the pictures; the first one is due at `start_ns`.

        Raises:
            ConfigError: the recording cannot be used.
        """
        self._recording = self._load()
        self._start_ns, self._next = start_ns, 0
        self._closed.clear()

    @property
    def finished(self) -> bool:
        """Whether the last frame was delivered."""
        recording = self._recording
        return recording is not None and not self._loop and self._next >= len(recording)

    def read(self, timeout_s: float) -> DepthFrame | None:
        """Wait for the next frame that is due and return the newest."""
        recording = self._recording
        if recording is None or self.finished:
            return None
        newest = self._newest_due(recording)
        if newest < self._next:
            if self._closed.wait(
                max(0.0, min(timeout_s, 1e-9 * (self._due_ns(recording, self._next) - self._now_ns())))
            ):
                return None
            newest = self._newest_due(recording)
            if newest < self._next:
                return None
        self._next = newest + 1
        frame = recording.frame(newest % len(recording))
        return replace(frame, t_ns=self._due_ns(recording, newest), index=newest)

    def close(self) -> None:
        """Stop; a waiting `read` returns None."""
        self._closed.set()
        self._recording = None

    def _period_ns(self, recording: DepthRecording) -> int:
        """Return how long one pass takes: one more mean step after the last frame."""
        length_ns = int(recording.t_ns[-1] - recording.t_ns[0])
        return length_ns + max(1, length_ns // max(1, len(recording) - 1))

    def _due_ns(self, recording: DepthRecording, number: int) -> int:
        passes, index = divmod(number, len(recording))
        return self._start_ns + passes * self._period_ns(recording) + int(recording.t_ns[index] - recording.t_ns[0])

    def _newest_due(self, recording: DepthRecording) -> int:
        """Return the number of the newest frame that is due; −1 before the first."""
        elapsed_ns = self._now_ns() - self._start_ns
        if elapsed_ns < 0:
            return -1
        passes, within_ns = divmod(elapsed_ns, self._period_ns(recording)) if self._loop else (0, elapsed_ns)
        index = int(np.searchsorted(recording.t_ns - recording.t_ns[0], within_ns, side="right")) - 1
        return passes * len(recording) + index


_COLOR_SUFFIXES = (".jpg", ".jpeg", ".png")
_DEPTH_SUFFIXES = (".png",)


@dataclass(frozen=True, slots=True)
class DepthRecording:
    """What a depth recording holds; its pictures are read one by one.

    Attributes:
        path: the camera's folder.
        color: colour pictures in order of their numbers.
        depth: their depth pictures, None where a frame has none.
        numbers: (N,) frame numbers.
        t_ns: (N,) times, nanoseconds, strictly increasing.
        camera: the lens.
    """

    path: Path
    color: tuple[Path, ...]
    depth: tuple[Path | None, ...]
    numbers: IntArray
    t_ns: IntArray
    camera: CameraModel

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.color)

    def frame(self, index: int) -> DepthFrame:
        """Read one frame by its position in the recording, with the recording's own time.

        Raises:
            ConfigError: a picture cannot be read, or has another size or type; names the file.
        """
        file = self.color[index]
        color = read_picture(file)
        self._require_size(file, color.shape)
        depth_file = self.depth[index]
        depth = None if depth_file is None else self._read_depth(depth_file)
        return DepthFrame(
            int(self.t_ns[index]), np.asarray(color, dtype=np.uint8), depth, self.camera, int(self.numbers[index])
        )

    def frames(self) -> Iterator[DepthFrame]:
        """Yield all frames in order, as fast as they are asked for."""
        return (self.frame(index) for index in range(len(self)))

    def _read_depth(self, file: Path) -> DepthImage:
        depth = read_picture(file, cv2.IMREAD_UNCHANGED)
        if depth.dtype != np.uint16 or depth.ndim != 2:
            kind = f"{depth.dtype} with {1 if depth.ndim == 2 else depth.shape[2]} channel(s)"
            raise ConfigError(f"{file}: depth must be one channel of 16 bits, millimetres; this is {kind}")
        self._require_size(file, depth.shape)
        return np.asarray(depth, dtype=np.uint16)

    def _require_size(self, file: Path, shape: tuple[int, ...]) -> None:
        if shape[:2] != (self.camera.height, self.camera.width):
            raise ConfigError(
                f"{file}: {shape[1]}x{shape[0]} pixels, the lens in use is for {self.camera.width}x"
                f"{self.camera.height}; colour, aligned depth and {INTRINSICS_FILE} must agree"
            )


def load_depth_recording(
    path: Path, *, camera: CameraModel | None = None, rate_hz: float | None = None, complete: bool = True
) -> DepthRecording:
    """Load the folder of one camera.

    Args:
        path: the camera's folder.
        camera: lens to use where the recording has no `intrinsics.json`.
        rate_hz: frames per second where the recording has no `timestamps.csv`; the first frame is then at 0.
        complete: false where the recorder was cut off: its last pictures and their times need not match then.

    Raises:
        ConfigError: missing, empty or contradictory; names the file and what to do.
    """
    if not path.is_dir():
        raise ConfigError(f"{path}: no such folder; a depth recording is a folder with {COLOR_FOLDER}/ in it")
    color = _numbered(path / COLOR_FOLDER, _COLOR_SUFFIXES)
    if not color:
        raise ConfigError(f"{path / COLOR_FOLDER}: holds no numbered pictures such as 000042.jpg")
    depth = _numbered(path / DEPTH_FOLDER, _DEPTH_SUFFIXES)
    orphans = [file for number, file in depth.items() if number not in color]
    if orphans:
        raise ConfigError(
            f"{orphans[0]}: has no picture of its number in {path / COLOR_FOLDER} (and {len(orphans) - 1} more)"
        )
    if not complete:
        color, depth = _whole(color), _whole(depth)
    numbers, t_ns = _times(path, list(color), rate_hz, complete=complete)
    return DepthRecording(
        path,
        tuple(color[number] for number in numbers.tolist()),
        tuple(depth.get(number) for number in numbers.tolist()),
        numbers,
        t_ns,
        _camera(path, camera),
    )


def _numbered(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    return numbered_pictures(folder, suffixes) if folder.is_dir() else {}


def _whole(pictures: dict[int, Path]) -> dict[int, Path]:
    """Return the pictures that are not empty, as a power cut leaves them."""
    return {number: file for number, file in pictures.items() if file.stat().st_size}


def _times(
    path: Path, numbers: list[int], rate_hz: float | None, *, complete: bool = True
) -> tuple[IntArray, IntArray]:
    table = path / TIMES_FILE
    if not table.exists():
        if rate_hz is None:
            raise ConfigError(f"{path}: has no {TIMES_FILE} (`frame,t_ns`); write one, or state the frame rate")
        frames = np.array(numbers, dtype=np.int64)
        return frames, np.round((frames - frames[0]) * (1e9 / rate_hz)).astype(np.int64)
    frames, t_ns = read_times(table, complete=complete)
    listed, present = set(frames.tolist()), set(numbers)
    if not complete:
        there = np.isin(frames, numbers)
        if not there.any():
            raise ConfigError(f"{path}: the recording was cut off before its first picture was on the disk")
        return frames[there], t_ns[there]
    for frame in frames.tolist():
        if frame not in present:
            raise ConfigError(f"{table}: frame {frame} has no picture in {path / COLOR_FOLDER}")
    for number in numbers:
        if number not in listed:
            raise ConfigError(f"{table}: no row for frame {number} of {path / COLOR_FOLDER}")
    return frames, t_ns


def _camera(path: Path, camera: CameraModel | None) -> CameraModel:
    file = path / INTRINSICS_FILE
    if not file.exists():
        if camera is None:
            raise ConfigError(f"{path}: has no {INTRINSICS_FILE} (width, height, K, distortion); write one")
        return camera
    try:
        lens = Intrinsics.model_validate(parse_json(read_text(file)))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    except ValidationError as error:
        raise ConfigError(f"{file}: {first_problem(error)}") from error
    except ValueError as error:
        raise ConfigError(f"{file}: not JSON: {error}") from error
    return pinhole(lens.width, lens.height, np.array(lens.K), np.array(lens.distortion))
