"""Reads the images of a recording in order."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.errors import ConfigError
from rhot.recording import PictureTrack, VideoTrack
from rhot.recording.picture_file import read_picture


def read_pictures(track: PictureTrack | VideoTrack) -> Iterator[ImageArray]:
    """Yield the pictures of a track, (H, W, 3) uint8 BGR, in the order of `track.t_ns`.

    Raises:
        ConfigError: a picture or the video cannot be read; names the file.
    """
    if isinstance(track, PictureTrack):
        for file in track.files:
            yield read_picture(file)
        return
    yield from _read_video(track)


def _read_video(track: VideoTrack) -> Iterator[ImageArray]:
    capture = cv2.VideoCapture(str(track.file))
    if not capture.isOpened():
        raise ConfigError(f"{track.file}: not a video that OpenCV can read")
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
        if wanted is not None and next_wanted is not None:
            raise ConfigError(
                f"{track.file}: ends after {number} frames, its times go on to frame {int(track.frames[-1])}"
            )
    finally:
        capture.release()
