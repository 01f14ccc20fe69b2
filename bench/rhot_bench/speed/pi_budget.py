"""A paper budget for Raspberry Pis: times measured here, carried over by one anchor and two assumptions.

Anchor: the 2018 thesis measured 17 to 19 ms for a frame of six tracked markers on a Pi 3, single thread. Its detector,
re-implemented and run here on pictures of the same size, takes t ms; so a Pi 3 is taken to be 18 / t times slower than
this machine. That includes its grabbing of the frame and its C++ against the Python shell here, and is therefore rough.

Assumption for the others: one thread is faster by clock times the width of the core, in instructions decoded a cycle:
Pi 3 1.2 GHz · 2 (Cortex-A53), Pi 4 1.5 GHz · 3 (Cortex-A72), Pi 5 2.4 GHz · 4 (Cortex-A76).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rhot_tools.measures.rows import Row, Section

PI3_FRAME_S: Final = 0.018
CORES: Final[Mapping[str, tuple[float, int]]] = {"Pi 3": (1.2, 2), "Pi 4": (1.5, 3), "Pi 5": (2.4, 4)}
"""Clock, GHz, and instructions decoded a cycle."""


def slowness(thesis_frame_s: float) -> dict[str, float]:
    """Return how many times slower than this machine each Pi is taken to be.

    Args:
        thesis_frame_s: the thesis's tracked frame, measured here.
    """
    clock, width = CORES["Pi 3"]
    anchor = PI3_FRAME_S / thesis_frame_s
    return {name: anchor * clock * width / (ghz * decoded) for name, (ghz, decoded) in CORES.items()}


def budget_section(thesis_frame_s: float, frame_s: float, searched_s: float) -> Section:
    """Return what a tracked and a searched frame would take on each Pi, and the frame rate that this allows.

    Args:
        thesis_frame_s: the thesis's tracked frame, measured here.
        frame_s: our own tracked frame.
        searched_s: a frame in which all markers are searched.
    """
    rows = []
    for name, ratio in slowness(thesis_frame_s).items():
        note = f"ESTIMATE: {ratio:.1f} times this machine's time"
        rows.append(Row(f"{name}, all markers tracked, a frame", frame_s * ratio * 1e3, "ms", note=note))
        rows.append(Row(f"{name}, all markers searched, a frame", searched_s * ratio * 1e3, "ms", note=note))
        rows.append(Row(f"{name}, frames a second on one core", 1.0 / (frame_s * ratio), "Hz", note=note))
    return Section(
        "Paper budget for capture on a Pi: estimates from the thesis's 17–19 ms a frame on a Pi 3 and from "
        "clock × decode width (1.2·2, 1.5·3, 2.4·4)",
        tuple(rows),
    )
