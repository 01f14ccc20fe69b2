"""How long each part takes, from light to pose (the thesis's tables 6.1 and 6.2)."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from rhot.arrays import FloatArray, ImageArray
from rhot.messages import MarkerFrame
from rhot_capture.detection.detector import MarkerDetector
from rhot_tools.measures.rows import Row, Section
from rhot_tools.rig.heard import Heard
from rhot_tools.rig.statistics import Figure, deviation, figure_row, mean, truth_row

_MS: Final = 1e3
_THESIS: Final = {"detection": "thesis: 17–19 ms on a Pi 3"}
_ABOUT: Final = {
    "retrieval": "from mid-exposure of the middle row until detection begins: read-out, driver, waiting",
    "detection": "all markers of a frame",
    "sending": "from the end of detection until the message is here: encoding, network, bus",
    "in all": "from mid-exposure until the message is here",
}
_BY_BOTH_CLOCKS: Final = ("sending", "in all")
_ROUNDS: Final = 10


@dataclass(frozen=True, slots=True)
class Latencies:
    """Seconds of each frame of one camera, in order.

    Attributes:
        parts: by name: (N,) seconds; `retrieval`, `detection`, and where arrivals were timed `sending` and `in all`.
            The first two are taken by the camera's clock alone, the others begin by it and end by the rig's.
        clock_s: bound of the error between the two clocks.
        stamped_late_s: (N,) how much later than it truly was each frame's stamp is; only of a simulated rig.
    """

    parts: Mapping[str, FloatArray]
    clock_s: float
    stamped_late_s: FloatArray | None = None


def latencies_of(heard: Heard, true_ns: Callable[[MarkerFrame], int | None] = lambda _: None) -> dict[str, Latencies]:
    """Return the latency of each camera whose frames tell them.

    Args:
        heard: frames of all cameras.
        true_ns: when a frame's middle row was truly exposed, rig clock, where that is known.
    """
    rows: dict[str, list[tuple[float, float, float, float]]] = {}
    timed = len(heard.arrived_ns) == len(heard.frames)
    for number, frame in enumerate(heard.frames):
        if {"age", "detect"} <= frame.timing.keys():
            whole_s = 1e-9 * (heard.arrived_ns[number] - frame.t_ns) if timed else float("nan")
            truly = true_ns(frame)
            late_s = float("nan") if truly is None else 1e-9 * (frame.t_ns - truly)
            rows.setdefault(frame.camera, []).append((frame.timing["age"], frame.timing["detect"], whole_s, late_s))
    found = {}
    for camera, each in sorted(rows.items()):
        age, detect, whole, late = np.array(each).T
        parts = {"retrieval": age, "detection": detect}
        if timed:
            parts |= {"sending": whole - age - detect, "in all": whole}
        status = heard.statuses.get(f"capture/{camera}")
        clock_s = ((status.clock_uncertainty_s if status is not None else None) or 0.0) + heard.clock_s
        found[camera] = Latencies(parts, clock_s, late if np.isfinite(late).all() else None)
    return found


def latency_sections(heard: Heard, times: Mapping[str, Latencies]) -> list[Section]:
    """Return a table a camera, and one of the services behind them."""
    sections = []
    for camera, of in times.items():
        rows: list[Row] = []
        for name, seconds in of.parts.items():
            figure = _mean_of(of, name)
            spread = deviation(seconds).scaled(_MS)
            rows.append(
                figure_row(f"{name}, mean", figure.scaled(_MS), "ms", peer=_THESIS.get(name, ""), note=_ABOUT[name])
            )
            rows.append(figure_row(f"{name}, deviation", spread, "ms"))
        sections.append(Section(f"Latency of camera {camera}", tuple(rows)))
    beside = [row for camera, of in times.items() for row in _beside_truth(camera, of)]
    if beside:
        sections.append(Section("Latency beside the simulator's truth (1: within its interval)", tuple(beside)))
    behind = [
        Row(f"{who}, {part}, {share}", _MS * seconds, "ms", note="from the service's status: its last seconds")
        for who, status in sorted(heard.statuses.items())
        if who.split("/", 1)[0] in ("fusion", "ik", "objects")
        for part, shares in status.latency_s.items()
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


def _mean_of(of: Latencies, name: str) -> Figure:
    """Return the mean of a part; what the clocks may be off shifts one that spans both as a whole."""
    figure = mean(of.parts[name])
    by = of.clock_s if name in _BY_BOTH_CLOCKS else 0.0
    return replace(figure, low=figure.low - by, high=figure.high + by)


def _beside_truth(camera: str, of: Latencies) -> list[Row]:
    """Return how the camera's stamps and the parts that begin with them stand to the simulated world's own time."""
    if of.stamped_late_s is None:
        return []
    late_s = float(of.stamped_late_s.mean())
    clock = Figure(0.0, -of.clock_s, of.clock_s, len(of.stamped_late_s), len(of.stamped_late_s))
    rows = [truth_row(f"{camera}, its clock against the rig's", clock.scaled(_MS), _MS * late_s, "ms")]
    for name in _BY_BOTH_CLOCKS:
        if name in of.parts:
            true_s = float((of.parts[name] + of.stamped_late_s).mean())
            rows.append(truth_row(f"{camera}, {name}", _mean_of(of, name).scaled(_MS), _MS * true_s, "ms"))
    return rows
