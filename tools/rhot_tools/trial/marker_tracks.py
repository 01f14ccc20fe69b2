"""Whole tracks of markers per camera, gathered from marker frames."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame
from rhot_tools.trial.epipolar_residuals import Track


class TrackGatherer:
    """Collects frames and gives the tracks of each camera.

    Attributes:
        frames: taken so far, by camera.
    """

    def __init__(self, cameras: Mapping[str, CameraModel]) -> None:
        self._cameras = cameras
        self._rows: dict[str, dict[str, dict[int, tuple[float, float]]]] = {name: {} for name in cameras}
        self._frame_times: dict[str, list[int]] = {name: [] for name in cameras}

    @property
    def frames(self) -> dict[str, int]:
        """Frames taken so far, by camera."""
        return {name: len(times) for name, times in self._frame_times.items()}

    def add(self, frames: Iterable[MarkerFrame]) -> None:
        """Take frames; those of cameras that are not known are left out."""
        for frame in frames:
            rows = self._rows.get(frame.camera)
            if rows is None:
                continue
            self._frame_times[frame.camera].append(frame.t_ns)
            for name, marker in frame.markers.items():
                t_ns = frame.t_ns if marker.t_ns is None else marker.t_ns
                rows.setdefault(name, {})[t_ns] = (marker.u, marker.v)

    def start_ns(self) -> int:
        """Return the time of the earliest frame; seconds of all tracks count from it."""
        return min((min(times) for times in self._frame_times.values() if times), default=0)

    def periods_s(self) -> dict[str, float]:
        """Return the usual time between two frames of each camera, seconds."""
        return {
            name: 1e-9 * float(np.median(np.diff(np.unique(times)))) if len(set(times)) > 1 else 0.0
            for name, times in self._frame_times.items()
        }

    def tracks(self) -> dict[str, dict[str, Track]]:
        """Return the tracks by camera and marker, undistorted; observations outside the picture are left out."""
        start_ns = self.start_ns()
        result: dict[str, dict[str, Track]] = {}
        for camera, markers in self._rows.items():
            model = self._cameras[camera]
            result[camera] = {}
            for marker, rows in markers.items():
                times = np.array(sorted(rows), dtype=np.int64)
                uv = np.array([rows[t_ns] for t_ns in times.tolist()])
                inside = model.contains(uv)
                if inside.any():
                    t_s = np.asarray((times[inside] - start_ns) * 1e-9, dtype=np.float64)
                    result[camera][marker] = Track(t_s, model.undistort(uv[inside]))
        return result
