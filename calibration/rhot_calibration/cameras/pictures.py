"""Reading the pictures of a calibration: which camera, which moment, and where the board is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from rhot.errors import CalibrationError, ConfigError
from rhot.recording import MarkerTrack, PictureTrack, Recording, VideoTrack, load_recording
from rhot.recording.picture_file import open_video, read_picture
from rhot_calibration.cameras.board.detect import (
    detect_board,
    looks_mirrored,
    marker_share,
    seen_dictionary,
    wrong_count_hint,
)
from rhot_calibration.cameras.board.grid import GrayImage
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

# Pictures of a recording in the order in which they are searched for the board.

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


_MAX_EXPLAINED: Final = 4
_ENOUGH_FOUND: Final = 0.5
"""Where this share of the pictures shows the stated board, it is the right one."""
_THREADS: Final = 2
_FIRST: Final = 6
"""Number of pictures without the board after which some of them are searched for a board of another size: searching for
a board that is not there takes a second per picture."""
_LOOKED_UP: Final = 2
"""Of these, pictures in which markers of all dictionaries are looked for, half a second each."""
_FIRST_EXPLAINED: Final = 2

Progress = Callable[[int, int], None]
Warn = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class PictureReading:
    """Boards found in pictures, and reasons where none was found.

    Attributes:
        views: where the board was found.
        problems: label of a picture that was left out to the reason; pictures without a board are among them.
        counts: label to the (columns, rows) of inner corners that it shows in place of the stated ones; looked for in
            a few pictures without the board. Where the first ones agree on another count, no more are looked at.
        mirrored: labels of pictures that show the board mirrored; same.
        hint: what the markers in the pictures say of the stated board, as options to call with; empty = nothing.
    """

    views: ViewSet
    problems: dict[str, str] = field(default_factory=dict)
    counts: dict[str, tuple[int, int]] = field(default_factory=dict)
    mirrored: tuple[str, ...] = ()
    hint: str = ""

    @property
    def likely_count(self) -> tuple[int, int] | None:
        """The count of inner corners that most of the explained pictures show in place of the stated one, if any."""
        return Counter(self.counts.values()).most_common(1)[0][0] if self.counts else None


@dataclass(frozen=True, slots=True)
class _Looked:
    """What one picture gave; `size` is None when it could not be read."""

    picture: Picture
    size: tuple[int, int] | None
    view: BoardView | None


def read_views(
    recording: Recording | Path,
    board: Board,
    cameras: Sequence[str],
    progress: Progress | None = None,
    sizes: dict[str, tuple[int, int]] | None = None,
) -> ViewSet:
    """Return where the board is in the pictures of a recording; see `read_pictures`."""
    return read_pictures(recording, board, cameras, progress, sizes).views


def read_pictures(
    recording: Recording | Path,
    board: Board,
    cameras: Sequence[str],
    progress: Progress | None = None,
    sizes: dict[str, tuple[int, int]] | None = None,
    warn: Warn | None = None,
) -> PictureReading:
    """Find the board in every picture of a recording.

    Args:
        recording: loaded, or its folder: per camera a folder of numbered pictures or a video. Pictures and frames of
            the same number were taken together.
        board: what was shown.
        cameras: of the rig, in the order of `rig.toml`.
        progress: called with the number of pictures looked at and of all.
        sizes: camera name to the (width, height) that `rig.toml` states; None = whatever the pictures have.
        warn: called with one sentence if none of the first pictures shows the board.

    Raises:
        ConfigError: the recording cannot be used (no such folder, marker tracks, an empty or broken video).
        CalibrationError: its cameras are not those of the rig, or pictures of one camera differ in size.
    """
    loaded = load_recording(recording) if isinstance(recording, Path) else recording
    _require_same_cameras(loaded, cameras)
    # Pictures, spread over all, whose markers are looked at first.
    hint = _options_hint(list(islice(spread_pictures(loaded, cameras), 4)), board)
    if hint:
        return PictureReading(ViewSet(board, sizes or {}, {}, {}), hint=hint)
    total = sum(count_pictures(loaded, name) for name in cameras)
    views: dict[Key, BoardView] = {}
    labels: dict[Key, str] = {}
    problems: dict[str, str] = {}
    seen: dict[str, dict[tuple[int, int], list[str]]] = {name: {} for name in cameras}
    without: list[Picture] = []
    first: list[Picture] = []
    # Two at a time: OpenCV releases the interpreter, and videos must not be decoded far ahead.
    with ThreadPoolExecutor(_THREADS) as pool:
        pictures = spread_pictures(loaded, cameras)
        done = 0
        while batch := list(islice(pictures, 2 * _THREADS)):
            for looked in pool.map(lambda picture: _look(picture, board), batch):
                done += 1
                picture = looked.picture
                labels[picture.key] = picture.label
                if looked.size is None:
                    problems[picture.label] = "cannot be read as a picture: the file is empty, cut off or damaged"
                elif looked.view is None:
                    problems[picture.label] = "board not found"
                    without.append(picture)
                else:
                    views[picture.key] = looked.view
                if looked.size is not None:
                    seen[picture.key[0]].setdefault(looked.size, []).append(picture.label)
                if progress is not None:
                    progress(done, max(done, total))
            if warn is not None and not views and done - len(batch) < SAMPLED <= done < total:
                warn(
                    f"{done} pictures do not show {board}; if the board is another one, stop with "
                    "Ctrl-C and state --board CxR"
                )
            if not views and not first and len(without) >= _FIRST:
                first = without[:: len(without) // _FIRST_EXPLAINED][:_FIRST_EXPLAINED]
                counts, _ = _explain(first, board, problems)
                if len(counts) == len(first) and len(set(counts.values())) == 1:
                    so_far = {name: found for name, found in seen.items() if found}
                    return PictureReading(
                        ViewSet(board, _sizes(loaded.path, so_far, sizes), {}, labels), problems, counts
                    )

    def place(key: Key) -> tuple[int, int]:
        return cameras.index(key[0]), key[1]

    labels = {key: labels[key] for key in sorted(labels, key=place)}
    views = {key: views[key] for key in labels if key in views}
    problems = {label: problems[label] for label in labels.values() if label in problems}
    without.sort(key=lambda picture: place(picture.key))
    view_sizes = _sizes(loaded.path, seen, sizes)
    # Explaining takes seconds a picture; a board that is merely not wholly in view needs no explanation. A mirrored
    # ChArUco board is told quickly, and one picture may be mirrored alone.
    if len(views) >= _ENOUGH_FOUND * (len(views) + len(without)) and not board.is_charuco:
        without = []
    counts, mirrored = _explain(without, board, problems)
    return PictureReading(ViewSet(board, view_sizes, views, labels), problems, counts, mirrored)


def _look(picture: Picture, board: Board) -> _Looked:
    gray = picture.pixels()
    if gray is None:
        return _Looked(picture, None, None)
    return _Looked(picture, (gray.shape[1], gray.shape[0]), detect_board(gray, board))


def _options_hint(pictures: list[Picture], board: Board) -> str:
    """Return what the markers in a few pictures say of the stated board, as options to call with; empty = nothing.

    Without it, every picture would be searched for a board that is not there, and a marker of another size would only
    show as a calibration that does not fit.
    """
    grays = [gray for picture in pictures if (gray := picture.pixels()) is not None]
    shares = [share for gray in grays if (share := marker_share(gray, board)) is not None] if board.is_charuco else []
    if shares:
        return _size_hint(shares, board)
    for gray in grays[:_LOOKED_UP]:
        # First what is quick: a search of all dictionaries takes a hundred times as long.
        if not board.is_charuco and detect_board(gray, board):
            continue
        seen = seen_dictionary(gray)
        if seen is None or seen[0] == board.dictionary:
            continue
        if board.is_charuco:
            return f"its markers are of another dictionary: call again with --dictionary {seen[0]}"
        return (
            f"it is a ChArUco board: call again with --dictionary {seen[0]} and --marker-mm (a marker's measured side)"
        )
    return ""


def _size_hint(shares: list[float], board: Board) -> str:
    """Return the option that fits the markers' size; empty where the stated one does, or too few were seen."""
    if not shares or board.marker_m is None:
        return ""
    marker_mm = 1e3 * board.square_m * float(np.median(shares))
    # Smaller errors of the stated side are not told from those of measuring it: in drawn pictures 2 to 5 %.
    if abs(marker_mm / (1e3 * board.marker_m) - 1.0) <= 0.10:
        return ""
    return (
        f"its markers measure about {marker_mm:.1f} mm where squares measure {1e3 * board.square_m:g} mm, not "
        f"{1e3 * board.marker_m:g} mm: measure one, and call again with --marker-mm"
    )


def _explain(
    without: list[Picture], board: Board, problems: dict[str, str]
) -> tuple[dict[str, tuple[int, int]], tuple[str, ...]]:
    """Look in a few pictures without the board, spread over all, for a mirrored one or one of another count."""
    counts: dict[str, tuple[int, int]] = {}
    mirrored: list[str] = []
    for picture in without[:: max(1, -(-len(without) // _MAX_EXPLAINED))]:
        gray = picture.pixels()
        if gray is None:
            continue
        if looks_mirrored(gray, board):
            mirrored.append(picture.label)
            problems[picture.label] = "board is mirrored"
        elif (count := wrong_count_hint(gray, board)) is not None:
            counts[picture.label] = count
            problems[picture.label] = (
                f"board not found; shows {count[0]}x{count[1]} inner corners, not {board.columns}x{board.rows}"
            )
    return counts, tuple(mirrored)


def _require_same_cameras(recording: Recording, cameras: Sequence[str]) -> None:
    unknown = [name for name in recording.cameras if name not in cameras]
    missing = [name for name in cameras if name not in recording.cameras]
    if unknown:
        raise CalibrationError(
            f"{recording.path / unknown[0]}: the rig has no camera {unknown[0]}, only {', '.join(cameras)}; rename the "
            "folder or the camera in rig.toml"
        )
    if missing:
        raise CalibrationError(
            f"{recording.path}: no pictures of camera {missing[0]}, only of {', '.join(recording.cameras)}; "
            f"add the folder {missing[0]} or remove the camera from rig.toml"
        )
    for name in cameras:
        if isinstance(recording.cameras[name], MarkerTrack):
            raise ConfigError(
                f"{recording.path / name}: holds 2D marker tracks; a calibration needs pictures of a board, "
                f"{name}/000001.jpg and so on, or a video {name}.mp4"
            )


def _sizes(
    path: Path, seen: dict[str, dict[tuple[int, int], list[str]]], stated: dict[str, tuple[int, int]] | None
) -> dict[str, tuple[int, int]]:
    """Return the size of each camera's pictures, refusing more than one and others than `rig.toml` states."""
    sizes = {name: _one_size(path, name, found) for name, found in seen.items()}
    for name, size in sizes.items():
        _require_size(path, name, size, (stated or {}).get(name, size))
    return sizes


def _one_size(path: Path, name: str, found: dict[tuple[int, int], list[str]]) -> tuple[int, int]:
    if not found:
        raise CalibrationError(
            f"{path / name}: not one picture of camera {name} can be read: they are empty, cut off or damaged; record "
            "them again"
        )
    ranked = sorted(found.items(), key=lambda item: -len(item[1]))
    if len(ranked) > 1:
        (most, _), (other, labels) = ranked[:2]
        raise CalibrationError(
            f"{path / labels[0]} is {other[0]}x{other[1]} pixels, other pictures of camera {name} are "
            f"{most[0]}x{most[1]}; a calibration holds for one picture size: remove or retake the odd ones"
        )
    return ranked[0][0]


def _require_size(path: Path, name: str, size: tuple[int, int], stated: tuple[int, int]) -> None:
    if size != stated:
        raise CalibrationError(
            f"{path / name}: pictures of {size[0]}x{size[1]} pixels, rig.toml says {stated[0]}x{stated[1]} for camera "
            f"{name}; take the pictures in the size that is tracked with, or change rig.toml"
        )
