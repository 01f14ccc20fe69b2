from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from rhot.arrays import ImageArray
from rhot.clock import SkewedClock, SystemClock
from rhot.errors import ConfigError
from rhot.rig import CameraConfig, load_rig
from rhot.rig.colors import nominal_colors
from rhot_capture.settings import CameraSettings
from rhot_capture.sources import Frame, open_source
from rhot_sim.sources.camera import SimulatedSource

RATE_HZ = 200.0


@dataclass(frozen=True)
class Moment:
    t_first_row_s: float
    delivered_s: float
    dropped: bool


class Schedule:
    """Frames every 5 ms, delivered 3 ms later; every fourth is lost."""

    def frame(self, index: int) -> Moment:
        return Moment(index / RATE_HZ, index / RATE_HZ + 0.003, index % 4 == 3)

    def first_after(self, t_s: float) -> int:
        return int(np.ceil(t_s * RATE_HZ))


class Renderer:
    """Small pictures whose grey level tells their time."""

    def __init__(self, loading_s: float = 0.0) -> None:
        self.loaded_s = time.monotonic() + loading_s
        self.begun: list[float] = []
        self.closed = False

    def wait_until_ready(self) -> None:
        time.sleep(max(0.0, self.loaded_s - time.monotonic()))

    def begin(self, *t_first_rows_s: float) -> None:
        self.begun += t_first_rows_s

    def finish(self) -> ImageArray:
        self.wait_until_ready()
        return np.full((4, 4, 3), round(1000 * self.begun.pop(0)) % 256, np.uint8)

    def close(self) -> None:
        self.closed = True


def source_with(clock: SystemClock | SkewedClock, loading_s: float = 0.0) -> SimulatedSource:
    camera = CameraConfig(source="simulated", rate_hz=RATE_HZ)
    return SimulatedSource("left", camera, Renderer(loading_s), Schedule(), clock)


def test_frames_come_when_due_and_lost_ones_do_not() -> None:
    source = source_with(SystemClock())
    start_t_ns = time.time_ns() + 10_000_000
    source.open(time.monotonic_ns() + 10_000_000, start_t_ns)
    frames: list[Frame] = []
    for _ in range(6):
        frame = source.read()
        assert frame is not None
        assert time.time_ns() >= start_t_ns + round(1e9 * (frame.index / RATE_HZ + 0.003))
        frames.append(frame)
    assert all(frame.index % 4 != 3 for frame in frames)
    for frame in frames:
        assert int(frame.image[0, 0, 0]) == round(1000 * frame.index / RATE_HZ) % 256


def test_frames_are_timed_on_the_nodes_own_wrong_clock() -> None:
    clock = SkewedClock(offset_ns=200_000_000, drift_ppm=40.0)
    source = source_with(clock)
    start_t_ns = time.time_ns() + 5_000_000
    source.open(clock.from_true_ns(start_t_ns), start_t_ns)
    frame = source.read()
    assert frame is not None
    assert frame.t_first_row_ns == clock.from_true_ns(start_t_ns + round(1e9 * frame.index / RATE_HZ))


def test_without_rig_time_the_nodes_start_is_converted() -> None:
    clock = SkewedClock(offset_ns=-150_000_000, drift_ppm=-40.0)
    source = source_with(clock)
    start_ns = clock.now_ns() + 5_000_000
    source.open(start_ns)
    frame = source.read()
    assert frame is not None
    assert frame.t_first_row_ns - start_ns == pytest.approx(1e9 * frame.index / RATE_HZ, abs=2_000)


def test_late_start_joins_at_the_frame_due_next() -> None:
    source = source_with(SystemClock())
    source.open(0, time.time_ns() - 2_000_000_000)
    frame = source.read()
    assert frame is not None
    assert frame.index >= 2.0 * RATE_HZ


def test_a_renderer_that_loads_delays_no_more_than_its_loading() -> None:
    source = source_with(SystemClock(), loading_s=0.5)
    start_t_ns = time.time_ns() - 2_000_000_000
    source.open(0, start_t_ns)
    begun_ns = time.time_ns()
    frame = source.read()
    assert frame is not None
    # Taken for drawing, the loading would have left out frames of another 0.8 s.
    assert (start_t_ns - begun_ns) / 1e9 + frame.index / RATE_HZ < 2.0 * 0.5


def test_close_ends_a_waiting_read() -> None:
    source = source_with(SystemClock())
    source.open(0, time.time_ns() + 60_000_000_000)
    results: list[Frame | None] = []
    reader = threading.Thread(target=lambda: results.append(source.read()))
    reader.start()
    source.close()
    reader.join(5.0)
    assert results == [None]


def test_the_real_simulation_shows_markers(write_rig: Callable[..., Path]) -> None:
    from rhot_capture.detection.color_table import build_color_table
    from rhot_capture.detection.detector import MarkerDetector
    from rhot_sim.world.paint import paints_of

    folder = write_rig({"left": 'source = "simulated"\n'}, "[sim]\nmotion = 'still'\ndrop_rate = 0.0\n")
    rig = load_rig(folder)
    source = open_source("left", rig, SystemClock())
    source.open(0, time.time_ns())
    frame = source.read()
    source.close()
    assert frame is not None
    assert frame.image.shape == (480, 640, 3)
    names = list(rig.config.markers)
    colors = nominal_colors({name: (red, green, blue) for name, (blue, green, red) in paints_of(names).items()})
    found = MarkerDetector(rig.config.markers, build_color_table(colors, names), 640, 480).detect(frame.image)
    assert set(found) == set(names)


def test_simulated_light_cannot_be_exposed_again() -> None:
    source = source_with(SystemClock())
    settings = CameraSettings.from_config(CameraConfig(), nominal_colors({}))
    source.apply(settings)
    with pytest.raises(ConfigError, match="colours can change"):
        source.apply(settings.changed({"gain": 2.0}, 60.0))
    with pytest.raises(ConfigError, match="colours can change"):
        source_with(SystemClock()).apply(settings.changed({"gain": 2.0}, 60.0))


def test_picture_settings_change_the_simulated_picture() -> None:
    source = source_with(SystemClock())
    source.open(0, time.time_ns())
    settings = CameraSettings.from_config(CameraConfig(), nominal_colors({}))
    before = source.read()
    source.apply(settings.changed({"brightness": 1.0}, 60.0))
    after = source.read()
    source.close()
    assert before is not None
    assert after is not None
    assert before.image.max() < 255
    assert (after.image == 255).all()
