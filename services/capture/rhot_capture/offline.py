"""Detection in recorded images or video, with the same detector as live."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Iterator

from rhot.anatomy.markers import own_paints
from rhot.errors import ConfigError
from rhot.messages import MarkerFrame
from rhot.recording import MarkerTrack, PictureTrack, Recording, VideoTrack
from rhot.rig import Rig
from rhot.rig.colors import load_colors
from rhot_capture.detection.color_table import ColorTable, camera_tables
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.sources.recorded import read_pictures
from rhot_capture.timing import marker_frame

Progress = Callable[[int], None]


def marker_frames(rig: Rig, recording: Recording, progress: Progress | None = None) -> Iterator[MarkerFrame]:
    """Yield the marker frames of all cameras, merged in order of time.

    Args:
        rig: with colours; its cameras are looked up by the recording's camera names.
        recording: holds pictures or videos with times.
        progress: called with the number of frames done so far.

    Raises:
        ConfigError: the recording has no times, holds marker tracks, names a camera that the rig does not have, or
            its pictures cannot be read or are of another size.
        CalibrationError: `colors.json` is missing or wrong.
    """
    recording.require_times()
    tables = camera_tables(load_colors(rig.colors_path), list(own_paints(rig.config.markers)), recording.cameras)
    streams = []
    for name, track in recording.cameras.items():
        if isinstance(track, MarkerTrack):
            raise ConfigError(
                f"{recording.path}: camera {name} holds marker tracks, not pictures; there is nothing to detect"
            )
        if name not in rig.cameras:
            raise ConfigError(
                f"{recording.path}: camera {name} is not in {rig.path / 'rig.toml'}, which has "
                f"{', '.join(rig.cameras)}; rename the folder or add the camera"
            )
        streams.append(_camera_frames(rig, track, tables[name]))
    for done, frame in enumerate(heapq.merge(*streams, key=lambda frame: frame.t_ns), start=1):
        if progress is not None:
            progress(done)
        yield frame


def _camera_frames(rig: Rig, track: PictureTrack | VideoTrack, table: ColorTable) -> Iterator[MarkerFrame]:
    camera = rig.cameras[track.name]
    size = (camera.width, camera.height)
    detector = MarkerDetector(rig.config.markers, table, *size)
    moments = zip(track.frames.tolist(), track.t_ns.tolist(), strict=True)
    for image, (number, t_ns) in zip(read_pictures(track), moments, strict=False):
        if image.shape[:2] != (camera.height, camera.width):
            raise ConfigError(
                f"camera {track.name}: frame {number} is {image.shape[1]}x{image.shape[0]}, rig.toml says "
                f"{camera.width}x{camera.height}; set width and height to the recording's"
            )
        exposure_s, readout_s = track.timing.exposure_s, track.timing.readout_s
        yield marker_frame(track.name, size, detector.detect(image), t_ns, exposure_s, readout_s, number)
