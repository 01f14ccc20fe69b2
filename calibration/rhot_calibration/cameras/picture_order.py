"""Pictures of a recording in the order in which they are searched for the board."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from rhot.errors import ConfigError
from rhot.recording import PictureTrack, Recording, VideoTrack
from rhot.recording.picture_file import open_video, read_picture
from rhot_calibration.cameras.board.grid import GrayImage

MAX_VIDEO_PICTURES: Final = 60
SAMPLED: Final = 24
"""Number of pictures, evenly spread over all cameras, that are searched first. If none shows the board, the user is
warned, after about 15 s: 120 pictures of noise took 75 s."""

Key = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture: in a file, or already decoded from a video."""

    key: Key
    label: str
    file: Path | None
    gray: GrayImage | None

    def pixels(self) -> GrayImage | None:
        """Return its pixels (height, width) in grey; None if the file is no picture."""
        return self.gray if self.file is None else read_gray(self.file)


def count_pictures(recording: Recording, name: str) -> int:
    """Return the number of pictures of a camera; of a video, an upper bound."""
    track = recording.cameras[name]
    return MAX_VIDEO_PICTURES if isinstance(track, VideoTrack) else len(track.frames)


def spread_pictures(recording: Recording, cameras: Sequence[str]) -> Iterator[Picture]:
    """Yield all pictures: some evenly spread ones first, then the others in order. Videos are only read in order."""
    tracks = [recording.cameras[name] for name in cameras]
    in_order = (picture for name in cameras for picture in _pictures(recording, name))
    if any(isinstance(track, VideoTrack) for track in tracks):
        yield from in_order
        return
    every = list(in_order)
    count = min(SAMPLED, len(every))
    first = [every[k] for k in np.linspace(0, len(every) - 1, count).round().astype(int)] if every else []
    yield from first
    early = {picture.key for picture in first}
    yield from (picture for picture in every if picture.key not in early)


def _pictures(recording: Recording, name: str) -> Iterator[Picture]:
    track = recording.cameras[name]
    if isinstance(track, PictureTrack):
        for number, file in zip(track.frames.tolist(), track.files, strict=True):
            yield Picture((name, number), f"{name}/{file.name}", file, None)
    elif isinstance(track, VideoTrack):
        yield from _video_pictures(track)


def _video_pictures(track: VideoTrack) -> Iterator[Picture]:
    """Yield evenly spaced frames of a video, the same numbers in videos of the same length to within a few frames."""
    capture = open_video(track.file)
    try:
        length = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) if capture.isOpened() else 0
        if length <= 0:
            raise ConfigError(f"{track.file}: cannot be read as a video, or holds no frame; record it again")
        # A power of two, so that videos of nearly the same length give the same frame numbers.
        step = 1
        while length > step * MAX_VIDEO_PICTURES:
            step *= 2
        for number in range(length):
            if not capture.grab():
                return
            if number % step:
                continue
            decoded, image = capture.retrieve()
            if decoded:
                gray = np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
                yield Picture((track.name, number), f"{track.file.name} frame {number}", None, gray)
    finally:
        capture.release()


def read_gray(file: Path) -> GrayImage | None:
    """Return a picture file (height, width) in grey, or None when it is no whole picture."""
    try:
        return np.asarray(read_picture(file, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
    except ConfigError:
        return None
