"""How long each stage takes, from light to pose (the thesis's tables 6.1 and 6.2)."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot_bench.measures.rows import Row, Section
from rhot_bench.rig.heard import Heard
from rhot_bench.rig.rows import figure_row
from rhot_bench.rig.statistics import Figure, deviation, mean
from rhot_capture.detection.color_table import ImageArray
from rhot_capture.detection.detector import MarkerDetector

_MS: Final = 1e3
_THESIS: Final = {"detection": "thesis: 17–19 ms on a Pi 3"}
_ABOUT: Final = {
    "retrieval": "from mid-exposure of the middle row until detection begins: read-out, driver, waiting",
    "detection": "all markers of a frame",
    "sending": "from the end of detection until the message is here: encoding, network, bus",
    "in all": "from mid-exposure until the message is here",
}
_ROUNDS: Final = 3


@dataclass(frozen=True, slots=True)
class StageTimes:
    """Seconds of each frame of one camera, in order.

    Attributes:
        stages: by name: (N,) seconds; `retrieval`, `detection`, and where arrivals were timed `sending` and `in all`.
        clock_s: bound of the error of the camera's clock, which retrieval and sending share with opposite signs.
    """

    stages: Mapping[str, FloatArray]
    clock_s: float


def stage_times(heard: Heard) -> dict[str, StageTimes]:
    """Return the stages of each camera whose frames tell them."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    timed = len(heard.arrived_ns) == len(heard.frames)
    for number, frame in enumerate(heard.frames):
        if {"age", "detect"} <= frame.timing.keys():
            whole_s = 1e-9 * (heard.arrived_ns[number] - frame.t_ns) if timed else float("nan")
            rows.setdefault(frame.camera, []).append((frame.timing["age"], frame.timing["detect"], whole_s))
    found = {}
    for camera, each in sorted(rows.items()):
        age, detect, whole = np.array(each).T
        stages = {"retrieval": age, "detection": detect}
        if timed:
            stages |= {"sending": whole - age - detect, "in all": whole}
        status = heard.statuses.get(f"capture/{camera}")
        found[camera] = StageTimes(stages, (status.clock_uncertainty_s if status is not None else None) or 0.0)
    return found


def stage_sections(heard: Heard, times: Mapping[str, StageTimes]) -> list[Section]:
    """Return a table a camera, and one of the services behind them."""
    sections = []
    for camera, of in times.items():
        rows: list[Row] = []
        for name, seconds in of.stages.items():
            # What the clock may be off shifts a stage between two machines as a whole.
            figure = _widened(mean(seconds), of.clock_s if name in ("retrieval", "sending", "in all") else 0.0)
            spread = deviation(seconds).scaled(_MS)
            rows.append(
                figure_row(f"{name}, mean", figure.scaled(_MS), "ms", peer=_THESIS.get(name, ""), note=_ABOUT[name])
            )
            rows.append(figure_row(f"{name}, deviation", spread, "ms"))
        sections.append(Section(f"Stages of camera {camera}", tuple(rows)))
    behind = [
        Row(f"{who}, {stage}, {share}", _MS * seconds, "ms", note="from the service's status: its last seconds")
        for who, status in sorted(heard.statuses.items())
        if who.split("/", 1)[0] in ("fusion", "ik", "objects")
        for stage, shares in status.latency_s.items()
        for share, seconds in shares.items()
    ]
    return [*sections, Section("Services behind the cameras", tuple(behind))] if behind else sections


def thread_section(
    pictures: Mapping[str, Sequence[ImageArray]], detectors: Mapping[str, MarkerDetector], threads: Sequence[int]
) -> Section:
    """Return the time of a frame with so many threads of OpenCV, on this machine; numbers of threads take turns.

    Args:
        pictures: of each camera, in order.
        detectors: of each camera.
        threads: how many to try.
    """
    before = cv2.getNumThreads()
    seconds: dict[tuple[str, int], list[float]] = {}
    try:
        for _ in range(_ROUNDS):
            for count in threads:
                cv2.setNumThreads(count)
                for camera, frames in pictures.items():
                    for picture in frames:
                        begun = time.perf_counter()
                        detectors[camera].detect(picture)
                        seconds.setdefault((camera, count), []).append(time.perf_counter() - begun)
    finally:
        cv2.setNumThreads(before)
    rows = []
    for (camera, count), taken in sorted(seconds.items()):
        name = f"{camera}, {count} thread{'' if count == 1 else 's'}"
        rows.append(figure_row(f"{name}, mean", mean(np.array(taken)).scaled(_MS), "ms"))
    return Section("Threads against time of a frame, on this machine", tuple(rows))


def _widened(figure: Figure, by: float) -> Figure:
    return Figure(figure.value, figure.low - by, figure.high + by, figure.independent, figure.samples)
