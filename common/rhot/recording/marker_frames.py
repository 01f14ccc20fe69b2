"""Marker tracks as the messages that capture would have published."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rhot.errors import ConfigError
from rhot.messages import Marker, MarkerFrame
from rhot.recording.model import MarkerTrack, Recording
from rhot.rig import Rig
from rhot.rig.calibration import CameraCalibration


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
