"""Reads the images of a recording in order."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Final

import cv2
import numpy as np

from rhot.arrays import ImageArray
from rhot.errors import ConfigError
from rhot.recording import PictureTrack, VideoTrack
from rhot.recording.picture_file import open_video, read_picture

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
