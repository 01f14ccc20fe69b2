"""What a recording folder holds, as data."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final, Literal

import numpy as np
from pydantic import Field

from rhot.arrays import FloatArray, IntArray
from rhot.errors import ConfigError
from rhot.messages import Name
from rhot.rig.file_model import FileModel, NotNegative

MOST_CAMERAS: Final = 64
"""Of a recording, as of a rig."""
_SHORTEST_PERIOD_NS: Final = 1_000_000
"""No camera of a rig takes more than 1,000 pictures a second: shorter intervals are counted in a coarser unit."""


class TrackTiming(FileModel):
    """How one camera scanned its pictures.

    A marker in row v of a picture of height h that began at t was true at t + readout_s · v / h + exposure_s / 2.

    Attributes:
        exposure_s: exposure time of each row.
        readout_s: time from the first row's start of exposure to the last row's (rolling shutter).
    """

    exposure_s: NotNegative = 0.0
    readout_s: NotNegative = 0.0


class RecordingFile(FileModel):
    """`recording.toml`, optional.

    Attributes:
        version: of the file's layout.
        notes: for people.
        complete: false while a recorder writes, and for ever where it was cut off: then the last pictures and their
            times need not match.
        cameras: timing per camera; what is absent counts as 0.
    """

    version: Literal[1] = 1
    notes: str = ""
    complete: bool = True
    cameras: Annotated[dict[Name, TrackTiming], Field(max_length=MOST_CAMERAS)] = {}


@dataclass(frozen=True, slots=True)
class PictureTrack:
    """A folder of pictures of one camera.

    Attributes:
        name: of the camera.
        files: the pictures in order of their frame numbers.
        frames: (N,) frame number of each picture.
        t_ns: (N,) start of the first row's exposure; empty when the recording states no times.
        timing: read-out and exposure.
    """

    name: str
    files: tuple[Path, ...]
    frames: IntArray
    t_ns: IntArray
    timing: TrackTiming

    @property
    def has_times(self) -> bool:
        """Whether the time of every picture is known."""
        return len(self.t_ns) == len(self.frames)


@dataclass(frozen=True, slots=True)
class VideoTrack:
    """A video of one camera.

    Attributes:
        name: of the camera.
        file: the video.
        frames: (N,) number of each frame in the video, from 0; empty when the recording states no times.
        t_ns: (N,) start of the first row's exposure; empty when the recording states no times.
        timing: read-out and exposure.
    """

    name: str
    file: Path
    frames: IntArray
    t_ns: IntArray
    timing: TrackTiming

    @property
    def has_times(self) -> bool:
        """Whether the time of every frame is known."""
        return len(self.t_ns) > 0


@dataclass(frozen=True, slots=True)
class MarkerTrack:
    """Marker positions of one camera, one row per marker and frame, in the order of the file.

    Attributes:
        name: of the camera.
        file: `markers.csv`.
        markers: names that occur, in order of appearance.
        frames: (N,) frame number of each row, not decreasing.
        t_ns: (N,) start of the first row's exposure of the frame.
        marker: (N,) index into `markers`.
        uv: (N, 2) pixels, raw image.
        timing: read-out and exposure.
    """

    name: str
    file: Path
    markers: tuple[str, ...]
    frames: IntArray
    t_ns: IntArray
    marker: IntArray
    uv: FloatArray
    timing: TrackTiming

    @property
    def has_times(self) -> bool:
        """Whether times are known: always, they stand in every row."""
        return True


CameraTrack = PictureTrack | VideoTrack | MarkerTrack


@dataclass(frozen=True, slots=True)
class Recording:
    """A loaded recording folder.

    Attributes:
        path: the folder.
        cameras: what each camera recorded, by name, in alphabetical order; empty where it holds a depth camera alone.
        notes: from `recording.toml`.
        depth_camera: folder of the feet's depth camera, see `rhot_feet.sources.depth_camera.recorded_frames`.
        complete: false where the recorder was cut off.
    """

    path: Path
    cameras: dict[str, CameraTrack]
    notes: str
    depth_camera: Path | None = None
    complete: bool = True

    @property
    def has_times(self) -> bool:
        """Whether all cameras have times; a still set for calibration may have none."""
        return all(track.has_times for track in self.cameras.values())

    @property
    def holds_markers(self) -> bool:
        """Whether all cameras hold marker tracks in place of pictures."""
        return all(isinstance(track, MarkerTrack) for track in self.cameras.values())

    def require_times(self) -> None:
        """Refuse a recording without times, or with times in another unit than nanoseconds, where they are needed.

        Raises:
            ConfigError: names the camera, and the unit that its times are probably in.
        """
        for name, track in self.cameras.items():
            if not track.has_times:
                raise ConfigError(
                    f"{self.path}: camera {name} has no times; add {name}/timestamps.csv (or {name}.csv) with the "
                    "header frame,t_ns and one row a frame"
                )
            times = np.unique(track.t_ns)
            period = float(np.median(np.diff(times))) if len(times) > 1 else _SHORTEST_PERIOD_NS
            if period < _SHORTEST_PERIOD_NS:
                # Intervals of less are milliseconds (33 at 30 Hz), other short ones microseconds
                # (33,333).
                unit, factor = ("milliseconds", "1000000") if period < 1_000 else ("microseconds", "1000")
                raise ConfigError(
                    f"{self.path}: frames of camera {name} are {period:g} apart, which as nanoseconds would be "
                    f"{1e9 / period:.3g} pictures a second; its t_ns seem to be in {unit}: multiply them by {factor}"
                )


def frozen_array(values: list[int]) -> IntArray:
    """Return a read-only integer array."""
    array = np.array(values, dtype=np.int64)
    array.setflags(write=False)
    return array
