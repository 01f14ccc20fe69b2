"""Finding and validating what lies in a recording folder."""

from __future__ import annotations

import heapq
import logging
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from rhot.arrays import IntArray
from rhot.atomic_file import why_unread
from rhot.errors import ConfigError
from rhot.messages import Marker, MarkerFrame, first_problem
from rhot.recording.model import (
    CameraTrack,
    MarkerTrack,
    PictureTrack,
    Recording,
    RecordingFile,
    TrackTiming,
    VideoTrack,
    frozen_array,
)
from rhot.recording.tables import read_marker_track, read_times
from rhot.rig import Rig
from rhot.rig.calibration import CameraCalibration
from rhot.text import parse_toml, read_text

# Marker tracks as the messages that capture would have published.


class MarkerTrackFrames:
    """The MarkerFrames of a recording of marker tracks, all cameras merged in order of time; iterable repeatedly.

    A track states neither area nor score, so these are 0 and 1. A position outside the picture is no measurement: the
    marker is absent in that frame. A frame without any row does not appear.

    Attributes:
        outside: rows left out because they lie outside the picture, by camera.
    """

    def __init__(self, rig: Rig, recording: Recording) -> None:
        self._tracks: list[tuple[MarkerTrack, CameraCalibration]] = []
        self.outside: dict[str, int] = {}
        for name, track in recording.cameras.items():
            if not isinstance(track, MarkerTrack):
                raise ConfigError(
                    f"{recording.path}: camera {name} holds pictures, not marker tracks; detect markers in them first"
                )
            if name not in rig.cameras:
                raise ConfigError(
                    f"{recording.path}: camera {name} is not in {rig.path / 'rig.toml'}, which has "
                    f"{', '.join(rig.cameras)}; rename the folder or add the camera"
                )
            unknown = [marker for marker in track.markers if marker not in rig.config.markers]
            if unknown:
                raise ConfigError(
                    f"{track.file}: marker {unknown[0]} is not in {rig.path / 'rig.toml'}, which has "
                    f"{', '.join(rig.config.markers)}; add [markers.{unknown[0]}] there"
                )
            self._tracks.append((track, rig.cameras[name]))
            self.outside[name] = int(np.count_nonzero(~_inside(track, rig.cameras[name])))

    def __iter__(self) -> Iterator[MarkerFrame]:
        """Return the frames from the beginning."""
        streams = [_frames(track, camera) for track, camera in self._tracks]
        return heapq.merge(*streams, key=lambda frame: frame.t_ns)


def marker_track_frames(rig: Rig, recording: Recording) -> MarkerTrackFrames:
    """Return the MarkerFrames of a recording of marker tracks in order of time.

    Raises:
        ConfigError: the recording holds pictures, or a camera or marker that the rig does not know.
    """
    return MarkerTrackFrames(rig, recording)


def _inside(track: MarkerTrack, camera: CameraCalibration) -> NDArray[np.bool_]:
    size = np.array([camera.width, camera.height])
    inside: NDArray[np.bool_] = np.all((track.uv > -0.5) & (track.uv < size - 0.5), axis=1)
    return inside


def _frames(track: MarkerTrack, camera: CameraCalibration) -> Iterator[MarkerFrame]:
    inside = _inside(track, camera).tolist()
    u, v = track.uv[:, 0].tolist(), track.uv[:, 1].tolist()
    delay_ns = (1e9 * (track.timing.readout_s * track.uv[:, 1] / camera.height + 0.5 * track.timing.exposure_s)).astype(
        np.int64
    )
    row_times = (track.t_ns + delay_ns).tolist()
    names = [track.markers[index] for index in track.marker.tolist()]
    rolling = track.timing.readout_s > 0.0
    starts = np.flatnonzero(np.diff(track.frames, prepend=-1)).tolist()
    mid_ns = round(1e9 * 0.5 * (track.timing.readout_s + track.timing.exposure_s))
    for seq, (start, end) in enumerate(zip(starts, [*starts[1:], len(names)], strict=True)):
        markers = {
            names[row]: Marker(u=u[row], v=v[row], area=0.0, score=1.0, t_ns=row_times[row] if rolling else None)
            for row in range(start, end)
            if inside[row]
        }
        yield MarkerFrame(
            t_ns=int(track.t_ns[start]) + mid_ns,
            seq=seq,
            camera=track.name,
            width=camera.width,
            height=camera.height,
            markers=markers,
            frame=int(track.frames[start]),
        )


logger = logging.getLogger(__name__)

RECORDING_FILE = "recording.toml"
MARKERS_FILE = "markers.csv"
TIMES_FILE = "timestamps.csv"
PICTURE_SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff")
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi")
COLOR_FOLDER = "color"
"""Below the folder of a depth camera."""
DEPTH_FOLDER = "depth"
INTRINSICS_FILE = "intrinsics.json"

_NUMBERED = re.compile(r"(?:.*[^0-9])?([0-9]{1,18})")
_CAMERA_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_NO_TIMES = frozen_array([])


def load_recording(path: Path, timing: Mapping[str, TrackTiming] | None = None) -> Recording:
    """Load and validate a recording folder.

    Each camera is either a folder of numbered pictures or of `markers.csv`, or a video beside it; pictures and videos
    have their times in `<camera>/timestamps.csv` or `<camera>.csv`. Pictures and videos without such a table load
    too, as still sets for calibration; `Recording.require_times` refuses them.

    Args:
        path: the folder.
        timing: by camera, what holds for those of which `recording.toml` states nothing, such as the rig's own; absent
            = 0.

    Raises:
        ConfigError: missing, empty, ambiguous or wrong; names file and line.
    """
    if not path.is_dir():
        raise ConfigError(f"{path}: {_no_folder(path)}")
    settings = _settings(path)
    entries = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
    origins: dict[str, Path] = {}
    depth_cameras = [entry for entry in entries if (entry / COLOR_FOLDER).is_dir()]
    if len(depth_cameras) > 1:
        both = " and ".join(entry.name for entry in depth_cameras[:2])
        raise ConfigError(f"{path}: holds two depth cameras, {both}; keep one")
    for entry in entries:
        if entry in depth_cameras:
            continue
        if entry.is_dir() and _is_camera_folder(entry):
            name = entry.name
        elif entry.is_file() and entry.suffix.lower() in VIDEO_SUFFIXES:
            name = entry.stem
        else:
            continue
        if not _CAMERA_NAME.fullmatch(name):
            raise ConfigError(f"{entry}: {name!r} is not a camera name; rename it to letters, digits, _ . - only")
        if name in origins:
            raise ConfigError(f"{path}: camera {name} is there twice, {origins[name].name} and {entry.name}; keep one")
        origins[name] = entry
    if not (origins or depth_cameras):
        raise ConfigError(
            f"{path}: holds no camera; expected <camera>/NNNNNN.jpg, <camera>.mp4, <camera>/{MARKERS_FILE}, or "
            f"<camera>/{COLOR_FOLDER} of a depth camera"
        )
    unknown = [name for name in settings.cameras if name not in origins]
    if unknown:
        raise ConfigError(
            f"{path / RECORDING_FILE}: cameras.{unknown[0]} is not in this recording, which holds "
            f"{', '.join(origins) or 'none but a depth camera'}"
        )
    cameras = {
        name: load_camera(
            origin, name, settings.cameras.get(name) or (timing or {}).get(name), complete=settings.complete
        )
        for name, origin in origins.items()
    }
    return Recording(path, cameras, settings.notes, next(iter(depth_cameras), None), settings.complete)


def _no_folder(path: Path) -> str:
    if not path.exists():
        return "no such recording folder"
    if path.suffix == ".mcap":
        return (
            "a file of messages; only a folder of pictures can be tracked again, as `rhot record --frames` writes it "
            "beside such a file"
        )
    return "a file; a recording is a folder with one folder or video per camera"


def load_camera(path: Path, name: str, timing: TrackTiming | None = None, *, complete: bool = True) -> CameraTrack:
    """Load one camera of a recording: a folder of pictures or of `markers.csv`, or a video file.

    Args:
        path: the folder or the video.
        name: of the camera.
        timing: read-out and exposure; absent = 0.
        complete: false where the recorder was cut off: the last pictures and their times need not match then.

    Raises:
        ConfigError: missing, empty, ambiguous or wrong; names file and line.
    """
    timing = timing or TrackTiming()
    if path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES:
        frames, t_ns = _times_of(path.parent / f"{path.stem}.csv", None)
        return VideoTrack(name, path, frames, t_ns, timing)
    if not path.is_dir():
        wanted = ", ".join(VIDEO_SUFFIXES)
        raise ConfigError(f"{path}: camera {name} needs a folder of pictures or a video ({wanted}), found neither")
    pictures = numbered_pictures(path)
    markers = path / MARKERS_FILE
    if markers.exists():
        if pictures:
            raise ConfigError(f"{path}: holds both pictures and {MARKERS_FILE}; keep one of them")
        return read_marker_track(markers, name, timing)
    if not pictures:
        raise ConfigError(f"{path}: holds neither numbered pictures (000000.jpg or .png) nor {MARKERS_FILE}")
    frames, t_ns = _times_of(path / TIMES_FILE, path.parent / f"{path.name}.csv", complete=complete)
    if not len(t_ns):
        return PictureTrack(name, tuple(pictures.values()), frozen_array(list(pictures)), _NO_TIMES, timing)
    table = path / TIMES_FILE if (path / TIMES_FILE).exists() else path.parent / f"{path.name}.csv"
    if not complete:
        frames, t_ns = _up_to_the_cut(path, pictures, frames, t_ns)
    listed = set(frames.tolist())
    without_time = [file for frame, file in pictures.items() if frame not in listed]
    if without_time == [pictures[max(pictures)]] and max(pictures) > int(frames[-1]):
        # A recorder that was killed had written its last picture and not yet the picture's time.
        without_time.clear()
    if without_time:
        raise ConfigError(f"{table}: no row for {without_time[0]} (and {len(without_time) - 1} more pictures)")
    for row, frame in enumerate(frames.tolist()):
        if frame not in pictures:
            raise ConfigError(f"{table}: frame {frame} (row {row + 1} of the table) has no picture in {path}")
    return PictureTrack(name, tuple(pictures[frame] for frame in frames.tolist()), frames, t_ns, timing)


def _up_to_the_cut(
    path: Path, pictures: dict[int, Path], frames: IntArray, t_ns: IntArray
) -> tuple[IntArray, IntArray]:
    """Return the times of a recording that was cut off, up to its last picture that is whole.

    After a power cut the last pictures may be empty or without a row, and the last rows without a picture.
    """
    numbers = frames.tolist()
    count = len(numbers)
    while count and not (numbers[count - 1] in pictures and pictures[numbers[count - 1]].stat().st_size):
        count -= 1
    if not count:
        raise ConfigError(f"{path}: the recording was cut off before its first picture was on the disk")
    later = [frame for frame in pictures if frame > numbers[count - 1]]
    if count < len(numbers) or later:
        logger.warning("%s: the recording was cut off; its last %d pictures are left out", path, len(later))
    for frame in later:
        del pictures[frame]
    return frozen_array(numbers[:count]), frozen_array(t_ns.tolist()[:count])


def _settings(path: Path) -> RecordingFile:
    file = path / RECORDING_FILE
    if not file.exists():
        return RecordingFile()
    try:
        return RecordingFile.model_validate(parse_toml(read_text(file)))
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{file}: cannot be read: {why_unread(error)}") from error
    except ValidationError as error:
        raise ConfigError(f"{file}: {first_problem(error)}") from error
    except ValueError as error:
        raise ConfigError(f"{file}: not TOML: {error}") from error


def _is_camera_folder(path: Path) -> bool:
    return (
        (path / MARKERS_FILE).exists()
        or (path / TIMES_FILE).exists()
        or (path.parent / f"{path.name}.csv").exists()
        or any(file.suffix.lower() in PICTURE_SUFFIXES for file in path.iterdir())
    )


def numbered_pictures(path: Path, suffixes: tuple[str, ...] = PICTURE_SUFFIXES) -> dict[int, Path]:
    """Return the pictures of a folder by their frame numbers, in order.

    Raises:
        ConfigError: a picture's name does not end in a number, or a number is there twice.
    """
    pictures: dict[int, Path] = {}
    for file in sorted(path.iterdir()):
        if file.suffix.lower() not in suffixes or file.name.startswith("."):
            continue
        number = _NUMBERED.fullmatch(file.stem)
        if number is None:
            example = f"000042{suffixes[0]}"
            raise ConfigError(
                f"{file}: a picture's name ends in its frame number, such as {example} or img_42{suffixes[0]}; rename "
                "or remove it"
            )
        frame = int(number[1])
        if frame in pictures:
            raise ConfigError(f"{file}: frame {frame} is there twice, also as {pictures[frame].name}; keep one")
        pictures[frame] = file
    return dict(sorted(pictures.items()))


def _times_of(first: Path, second: Path | None, *, complete: bool = True) -> tuple[IntArray, IntArray]:
    present = [file for file in (first, second) if file is not None and file.exists()]
    if len(present) == 2:
        raise ConfigError(f"{present[0]} and {present[1]} both state this camera's times; keep one")
    return read_times(present[0], complete=complete) if present else (_NO_TIMES, np.array(_NO_TIMES))
