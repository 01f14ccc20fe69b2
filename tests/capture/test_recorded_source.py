from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from rhot.arrays import ImageArray
from rhot.clock import SystemClock
from rhot.errors import ConfigError
from rhot.recording import PictureTrack
from rhot.rig import load_rig
from rhot.rig.colors import nominal_colors
from rhot_capture.settings import CameraSettings
from rhot_capture.sources import Frame, Source, open_source
from rhot_capture.sources.recorded import read_pictures

SIZE = "width = 32\nheight = 24\n"


class ManualClock:
    """A clock that a test sets; a wait for it would never end, so a test sets it past what is due."""

    def __init__(self, now_ns: int) -> None:
        self.time_ns = now_ns

    def now_ns(self) -> int:
        return self.time_ns


def write_pictures(folder: Path, times_ns: list[int], times: bool = True) -> None:
    folder.mkdir(parents=True)
    for number in range(len(times_ns)):
        cv2.imwrite(str(folder / f"{number:06d}.png"), np.full((24, 32, 3), 10 * number, np.uint8))
    if times:
        rows = "".join(f"{number},{t_ns}\n" for number, t_ns in enumerate(times_ns))
        (folder / "timestamps.csv").write_text("frame,t_ns\n" + rows)


def read_all(source: Source) -> list[Frame]:
    frames = []
    while (frame := source.read()) is not None:
        frames.append(frame)
    return frames


def test_pictures_keep_their_distances_and_begin_at_the_start(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": f'source = "images"\npath = "left"\nreadout_s = 0.01\n{SIZE}'})
    write_pictures(folder / "left", [5_000, 7_000, 12_000])
    clock = ManualClock(1_000_000_000)
    source = open_source("left", load_rig(folder), clock)
    clock.time_ns += 14_100_000
    source.open(1_000_000_000)
    frames = read_all(source)
    assert [frame.t_first_row_ns - 1_000_000_000 for frame in frames] == [0, 2_000, 7_000]
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [0, 10, 20]
    assert frames[0].readout_s == 0.01
    assert frames[0].exposure_s == load_rig(folder).config.cameras["left"].exposure_s


def test_a_frame_is_not_there_before_it_was_read_out(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": f'source = "images"\npath = "left"\nrate_hz = 100\nreadout_s = 0.02\n{SIZE}'})
    write_pictures(folder / "left", [0, 10_000_000, 20_000_000])
    clock = SystemClock()
    source = open_source("left", load_rig(folder), clock)
    start_ns = clock.now_ns()
    source.open(start_ns)
    while (frame := source.read()) is not None:
        assert clock.now_ns() >= frame.t_first_row_ns + 24_000_000


def test_a_picture_is_decoded_in_the_second_half_of_the_wait_for_it(
    write_rig: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_rig({"left": f'source = "images"\npath = "left"\nrate_hz = 10\n{SIZE}'})
    write_pictures(folder / "left", [0, 100_000_000, 200_000_000])
    clock = SystemClock()
    decoded_ns = []

    def read_and_note(track: PictureTrack) -> Iterator[ImageArray]:
        for image in read_pictures(track):
            decoded_ns.append(clock.now_ns())
            yield image

    monkeypatch.setattr("rhot_capture.sources.recorded.read_pictures", read_and_note)
    source = open_source("left", load_rig(folder), clock)
    source.open(clock.now_ns())
    frames = read_all(source)
    for frame, when_ns in list(zip(frames, decoded_ns, strict=True))[1:]:
        # While the picture before it is searched for markers, the cores are wanted there.
        assert when_ns > frame.t_first_row_ns - 50_000_000


def test_late_start_joins_at_what_is_due(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": f'source = "images"\npath = "left"\nrate_hz = 100\n{SIZE}'})
    write_pictures(folder / "left", [10_000_000 * number for number in range(10)])
    clock = ManualClock(1_000_000_000)
    source = open_source("left", load_rig(folder), clock)
    clock.time_ns += 75_000_000
    source.open(1_000_000_000)
    frame = source.read()
    assert frame is not None
    assert frame.index == 7


def test_without_times_the_rate_of_the_rig_counts(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": f'source = "images"\npath = "left"\nrate_hz = 50\n{SIZE}'})
    write_pictures(folder / "left", [0, 0, 0], times=False)
    clock = ManualClock(0)
    source = open_source("left", load_rig(folder), clock)
    source.open(0)
    for number in range(3):
        clock.time_ns = 20_000_000 * number + 4_000_000
        frame = source.read()
        assert frame is not None
        assert frame.t_first_row_ns == 20_000_000 * number
    assert source.read() is None


def test_a_loop_starts_again_without_a_gap_in_time_or_number(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": f'source = "images"\npath = "left"\nrate_hz = 100\nloop = true\n{SIZE}'})
    write_pictures(folder / "left", [0, 10_000_000])
    clock = ManualClock(0)
    source = open_source("left", load_rig(folder), clock)
    source.open(0)
    frames = []
    for number in range(5):
        clock.time_ns = 10_000_000 * number + 5_000_000
        frame = source.read()
        assert frame is not None
        frames.append(frame)
    assert [frame.t_first_row_ns for frame in frames] == [10_000_000 * number for number in range(5)]
    assert [frame.index for frame in frames] == list(range(5))


def test_close_ends_a_waiting_read(write_rig: Callable[..., Path]) -> None:
    import threading

    folder = write_rig({"left": f'source = "images"\npath = "left"\n{SIZE}'})
    write_pictures(folder / "left", [0])
    source = open_source("left", load_rig(folder), ManualClock(0))
    source.open(10**15)
    results: list[Frame | None] = []
    reader = threading.Thread(target=lambda: results.append(source.read()))
    reader.start()
    begun = time.monotonic()
    source.close()
    reader.join(5.0)
    assert results == [None]
    assert time.monotonic() - begun < 1.0


def test_a_video_plays_like_pictures(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": 'source = "video"\npath = "left.avi"\nwidth = 64\nheight = 48\n'})
    writer = cv2.VideoWriter(str(folder / "left.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for number in range(3):
        writer.write(np.full((48, 64, 3), 80 * number, np.uint8))
    writer.release()
    (folder / "left.csv").write_text("frame,t_ns\n0,100\n2,300\n")
    clock = ManualClock(10**9)
    source = open_source("left", load_rig(folder), clock)
    source.open(10**9 - 4_001_000)
    frames = read_all(source)
    assert [frame.t_first_row_ns - (10**9 - 4_001_000) for frame in frames] == [0, 200]
    assert [round(float(frame.image.mean()) / 80) for frame in frames] == [0, 2]


def test_wrong_size_is_named(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": 'source = "images"\npath = "left"\n'})
    write_pictures(folder / "left", [0])
    source = open_source("left", load_rig(folder), ManualClock(10**9))
    source.open(10**9 - 4_000_000)
    with pytest.raises(ConfigError, match=r"32x24.*640x480"):
        source.read()


def test_a_broken_picture_is_named(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": f'source = "images"\npath = "left"\n{SIZE}'})
    write_pictures(folder / "left", [0])
    (folder / "left" / "000000.png").write_bytes(b"no picture")
    source = open_source("left", load_rig(folder), ManualClock(10**9))
    source.open(10**9 - 4_000_000)
    with pytest.raises(ConfigError, match=r"000000\.png"):
        source.read()


def test_missing_recording_and_unknown_camera_are_named(write_rig: Callable[..., Path]) -> None:
    rig = load_rig(write_rig({"left": 'source = "images"\npath = "nowhere"\n'}))
    with pytest.raises(ConfigError, match="nowhere"):
        open_source("left", rig, ManualClock(0))
    with pytest.raises(ConfigError, match=r"no camera middle.*left"):
        open_source("middle", rig, ManualClock(0))


def test_a_recording_takes_new_colours_but_no_new_exposure(write_rig: Callable[..., Path]) -> None:
    folder = write_rig({"left": f'source = "images"\npath = "left"\n{SIZE}'})
    write_pictures(folder / "left", [0])
    rig = load_rig(folder)
    source = open_source("left", rig, ManualClock(0))
    settings = CameraSettings.from_config(rig.config.cameras["left"], nominal_colors({"thumb": (30, 120, 60)}))
    for _ in range(2):
        with pytest.raises(ConfigError, match="only colours"):
            source.apply(settings.changed({"exposure_s": 0.001}, 60.0))
        source.apply(settings.changed({"tolerances": {"thumb": 1.3}}, 60.0))
