"""Recorded images or video, replayed at the original rate."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.clock import NodeClock
from rhot.errors import ConfigError
from rhot.recording import MarkerTrack, PictureTrack, TrackTiming, VideoTrack, load_camera
from rhot.recording.picture_file import open_video, read_picture
from rhot.rig import CameraConfig, Rig
from rhot.rig.colors import ColorsFile
from rhot_capture.settings import CameraSettings
from rhot_capture.sources.frame import Frame
from rhot_capture.sources.pacing import Pacer

# Reads the images of a recording in order.

logger = logging.getLogger(__name__)
_ENDS_EARLY: Final = "%s: ends after %d frames, its times go on to frame %d; rows without a frame are left out"


def read_pictures(track: PictureTrack | VideoTrack) -> Iterator[ImageArray]:
    """Yield the pictures of a track, (H, W, 3) uint8 BGR, in the order of `track.t_ns`.

    A video may end before its times do; the log says so first, as far as the video states its length.

    Raises:
        ConfigError: a picture or the video cannot be read; names the file.
    """
    if isinstance(track, PictureTrack):
        for file in track.files:
            yield read_picture(file)
        return
    yield from _read_video(track)


def _read_video(track: VideoTrack) -> Iterator[ImageArray]:
    capture = open_video(track.file)
    if not capture.isOpened():
        raise ConfigError(f"{track.file}: not a video that OpenCV can read")
    last, length = int(track.frames[-1]) if track.has_times else 0, int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    if 0 < length <= last:
        logger.warning(_ENDS_EARLY, track.file, length, last)
    wanted = iter(track.frames.tolist()) if track.has_times else None
    try:
        number = 0
        next_wanted = next(wanted, None) if wanted is not None else 0
        while next_wanted is not None:
            ok, image = capture.read()
            if not ok:
                break
            if wanted is None or number == next_wanted:
                yield np.asarray(image, dtype=np.uint8)
                next_wanted = next(wanted, None) if wanted is not None else 0
            number += 1
        if number == 0:
            raise ConfigError(f"{track.file}: the video holds no frame that OpenCV can read")
        if wanted is not None and next_wanted is not None and not 0 < length <= last:
            logger.warning(_ENDS_EARLY, track.file, number, last)
    finally:
        capture.release()


class RecordedSource:
    """Replays one camera of a recording like a live camera.

    The first frame is due at the start time; intervals between frames are preserved. A recording without times is
    replayed at the rate in `rig.toml`.
    """

    def __init__(self, name: str, camera: CameraConfig, track: PictureTrack | VideoTrack, clock: NodeClock) -> None:
        self._name = name
        self._camera = camera
        self._track = track
        self._pacer = Pacer(clock)
        self._frames: Iterator[Frame] = iter(())
        self._optics = CameraSettings.from_config(camera, ColorsFile(markers={})).optics

    @classmethod
    def from_rig(cls, name: str, rig: Rig, clock: NodeClock) -> RecordedSource:
        """Find the recording that `rig.toml` names for a camera.

        Raises:
            ConfigError: it is missing, empty or holds no pictures.
        """
        camera = rig.config.cameras[name]
        path = rig.resolve(camera.path or "")
        timing = TrackTiming(exposure_s=camera.exposure_s, readout_s=camera.readout_s)
        track = load_camera(path, name, timing)
        if isinstance(track, MarkerTrack):
            raise ConfigError(f"{path}: camera {name} holds marker tracks, not pictures; `rhot process` reads those")
        return cls(name, camera, track, clock)

    def open(self, start_ns: int, start_t_ns: int | None = None) -> None:
        """Start the replay at a time of the node's clock; if it has passed, start with the frame that is due now."""
        self._pacer.restart()
        self._frames = self._replay(start_ns)

    def read(self) -> Frame | None:
        """Wait until the next frame is due and return it; None at the recording's end."""
        return next(self._frames, None)

    def apply(self, settings: CameraSettings) -> None:
        """Accept settings with the camera's configured optics, because a recording cannot be exposed again.

        Raises:
            ConfigError: exposure, gain, white balance, focus or picture differ.
        """
        if settings.optics != self._optics:
            raise ConfigError(
                f"camera {self._name} replays {self._camera.path}: exposure, gain, white balance, focus and "
                "picture are what they were; only colours can change"
            )

    def close(self) -> None:
        """Stop; a waiting `read` returns None."""
        self._pacer.stop()

    def _replay(self, start_ns: int) -> Iterator[Frame]:
        timing = self._track.timing
        index, pass_start_ns = 0, start_ns
        period_ns = round(1e9 / self._camera.rate_hz)
        scan_ns = round(1e9 * (timing.exposure_s + timing.readout_s))
        joined = False
        while True:
            first_index, t_first_row_ns = index, pass_start_ns
            pictures = read_pictures(self._track)
            for offset_ns in self._offsets_ns(period_ns):
                due_ns = pass_start_ns + offset_ns + scan_ns
                # Decoded half a period ahead: directly after the last frame, it would delay the detection in it.
                if joined and not self._pacer.wait_until(due_ns - period_ns // 2):
                    return
                if (image := next(pictures, None)) is None:
                    break
                index, t_first_row_ns = index + 1, pass_start_ns + offset_ns
                if not joined and due_ns + period_ns < self._pacer.now_ns():
                    continue
                joined = True
                if not self._pacer.wait_until(due_ns):
                    return
                self._require_size(image.shape)
                yield Frame(image, index - 1, t_first_row_ns, timing.exposure_s, timing.readout_s)
            if not self._camera.loop or index == first_index or self._pacer.stopped:
                return
            pass_start_ns = t_first_row_ns + period_ns

    def _offsets_ns(self, period_ns: int) -> Iterator[int]:
        """Return each frame's time since the first one, nanoseconds."""
        if self._track.has_times:
            return iter((self._track.t_ns - self._track.t_ns[0]).tolist())
        offsets = itertools.count(0, period_ns)
        return itertools.islice(offsets, len(self._track.files)) if isinstance(self._track, PictureTrack) else offsets

    def _require_size(self, shape: tuple[int, ...]) -> None:
        if shape[:2] != (self._camera.height, self._camera.width):
            raise ConfigError(
                f"camera {self._name}: {self._camera.path} holds pictures of {shape[1]}x{shape[0]}, rig.toml says "
                f"{self._camera.width}x{self._camera.height}; set width and height to the recording's"
            )
