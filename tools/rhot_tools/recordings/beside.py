"""What belongs to a recording of messages: the pictures beside it, the rig folder inside it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot.recording.folder import load_recording
from rhot.recording.model import MarkerTrack, PictureTrack, Recording, VideoTrack

# A part of a recording folder, by time.

Track = TypeVar("Track", bound=MarkerTrack | PictureTrack | VideoTrack)


def between(recording: Recording, from_ns: int, to_ns: int) -> Recording:
    """Return the frames of a recording that began within a span, both ends included; cameras without any are left out.

    Raises:
        ConfigError: the recording has no times, or no frame lies in the span.
    """
    recording.require_times()
    cameras = {
        name: _part(track, np.flatnonzero((track.t_ns >= from_ns) & (track.t_ns <= to_ns)))
        for name, track in recording.cameras.items()
    }
    cameras = {name: track for name, track in cameras.items() if len(track.t_ns)}
    if not cameras:
        first_ns, last_ns = time_span(recording)
        raise ConfigError(
            f"{recording.path}: no frame at t_ns {from_ns} to {to_ns}; it runs from {first_ns} to {last_ns}, "
            f"{(last_ns - first_ns) / 1e9:.3f} s"
        )
    return replace(recording, cameras=cameras)


def newest(track: PictureTrack | VideoTrack, count: int) -> PictureTrack | VideoTrack:
    """Return the last frames of a camera, `count` at most."""
    return _part(track, np.arange(max(0, len(track.t_ns) - count), len(track.t_ns)))


def time_span(recording: Recording) -> tuple[int, int]:
    """Return the times of the first and of the last frame.

    Raises:
        ConfigError: the recording has no times.
    """
    recording.require_times()
    if not recording.cameras:
        raise ConfigError(f"{recording.path}: holds a depth camera alone, no camera of hands")
    times = [track.t_ns for track in recording.cameras.values()]
    return min(int(t_ns[0]) for t_ns in times), max(int(t_ns[-1]) for t_ns in times)


def _part(track: Track, rows: NDArray[np.intp]) -> Track:
    if isinstance(track, MarkerTrack):
        return replace(
            track, frames=track.frames[rows], t_ns=track.t_ns[rows], marker=track.marker[rows], uv=track.uv[rows]
        )
    if isinstance(track, PictureTrack):
        files = tuple(track.files[row] for row in rows.tolist())
        return replace(track, files=files, frames=track.frames[rows], t_ns=track.t_ns[rows])
    return replace(track, frames=track.frames[rows], t_ns=track.t_ns[rows])


_PART: Final = re.compile(r"-\d{3}$")


@dataclass(frozen=True, slots=True)
class StoredPicture:
    """One picture of a recording folder.

    Attributes:
        camera: its camera.
        frame: its number.
        t_ns: mid-exposure of the middle row: the time of the markers found in it.
        file: where it is.
    """

    camera: str
    frame: int
    t_ns: int
    file: Path


def pictures_beside(file: Path) -> Recording | None:
    """Return the pictures that `rhot record --frames` wrote beside an MCAP file; none where there is no such folder.

    Raises:
        ConfigError: the folder is there and is no recording.
    """
    stem = file.with_suffix("")
    for folder in (stem, stem.with_name(_PART.sub("", stem.name))):
        if folder != file and folder.is_dir():
            return load_recording(folder)
    return None


def stored_pictures(recording: Recording) -> Iterator[StoredPicture]:
    """Yield the pictures with times of a recording, camera by camera."""
    for name, track in recording.cameras.items():
        if isinstance(track, PictureTrack) and track.has_times:
            mid_ns = round(5e8 * (track.timing.exposure_s + track.timing.readout_s))
            for picture, frame, t_ns in zip(track.files, track.frames.tolist(), track.t_ns.tolist(), strict=True):
                yield StoredPicture(name, frame, t_ns + mid_ns, picture)
