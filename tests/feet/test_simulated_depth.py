from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rhot_feet.frames import ColorImage, DepthImage, pinhole
from rhot_sim.sources.depth_camera import SimulatedDepthSource

CAMERA = pinhole(8, 6, np.diag([10.0, 10.0, 1.0]), np.empty(0))


class Clock:
    def __init__(self) -> None:
        self.ns = 1_000_000_000

    def now(self) -> int:
        return self.ns


@dataclass(frozen=True)
class Moment:
    t_s: float
    delivered_s: float
    dropped: bool


class World:
    """Ten pictures a second, there 20 ms later; every fifth is lost. Drawing takes its time on the clock."""

    intrinsics = np.diag([10.0, 10.0, 1.0])

    def __init__(self, clock: Clock, drawing_ns: int) -> None:
        self.clock = clock
        self.drawing_ns = drawing_ns

    def timing(self, index: int) -> Moment:
        return Moment(0.1 * index, 0.1 * index + 0.02, index % 5 == 4)

    def frame(self, index: int) -> tuple[float, ColorImage, DepthImage]:
        self.clock.ns += self.drawing_ns
        return 0.1 * index, np.full((6, 8, 3), index, np.uint8), np.full((6, 8), index, np.uint16)


def run(drawing_ns: int, until_ns: int) -> list[tuple[int, int, int]]:
    """Read in steps of 5 ms; (index, time of the picture, when it came)."""
    clock = Clock()
    source = SimulatedDepthSource(World(clock, drawing_ns), 10.0, CAMERA, clock.now)
    source.open(1_000_000_000)
    taken = []
    while clock.ns < until_ns:
        frame = source.read(0.0)
        if frame is not None:
            taken.append((frame.index, frame.t_ns, clock.ns))
        clock.ns += 5_000_000
    source.close()
    assert source.read(0.0) is None
    return taken


def test_frames_come_when_a_camera_would_deliver_them() -> None:
    taken = run(1_000_000, 2_000_000_000)
    assert [index for index, _, _ in taken][-6:] == [2, 3, 5, 6, 7, 8]
    for index, t_ns, came_ns in taken:
        assert t_ns == 1_000_000_000 + index * 100_000_000
        assert 20_000_000 <= came_ns - t_ns <= 27_000_000


def test_slow_drawing_leaves_frames_out_and_keeps_them_in_time() -> None:
    taken = run(150_000_000, 5_000_000_000)
    assert 15 <= len(taken) <= 25
    lateness = [came_ns - t_ns for _, t_ns, came_ns in taken]
    assert np.median(lateness) < 40_000_000
