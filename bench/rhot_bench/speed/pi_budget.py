"""A paper budget for capture on Raspberry Pis: instructions that were counted, and what cores execute.

Counted: the arm64 wheels on the rendered pictures, 640x480, under an emulator, on one thread (`make stacks
STACKS=arm64`, which fails when they grow by more than 5 %).

Assumed: a core executes between a quarter and a half of the instructions that it can decode a cycle, which leaves room
for its caches and for Python. Clock and decode width are the makers': Zero 2 W 1.0 GHz and Pi 3 1.2 GHz · 2
(Cortex-A53), Pi 4 1.5 GHz · 3 (Cortex-A72), Pi 5 2.4 GHz · 4 (Cortex-A76). Grabbing the picture is not in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from rhot_tools.measures.rows import Row, Section

INSTRUCTIONS: Final[Mapping[str, float]] = {"tracked": 5.50e6, "searched": 6.53e6}
"""A picture of a hand whose markers are followed, with one search in twenty pictures; one in which all are searched."""
CORES: Final[Mapping[str, tuple[float, int]]] = {
    "Zero 2 W": (1.0, 2),
    "Pi 3": (1.2, 2),
    "Pi 4": (1.5, 3),
    "Pi 5": (2.4, 4),
}
"""Clock, GHz, and instructions decoded a cycle."""
_SHARES: Final = (0.25, 0.5)
"""Of the instructions that a core can decode: least and most that it is taken to execute."""


def frame_s(board: str, how: str) -> tuple[float, float]:
    """Return the least and the most seconds that a picture takes on one core of a board."""
    clock_ghz, width = CORES[board]
    slow, fast = (INSTRUCTIONS[how] / (1e9 * clock_ghz * width * share) for share in _SHARES)
    return fast, slow


def budget_section() -> Section:
    """Return what a picture would take on each Pi, and the frame rate that this allows."""
    rows = []
    for board in CORES:
        for how in INSTRUCTIONS:
            fast, slow = frame_s(board, how)
            note = f"ESTIMATE: {1e3 * fast:.1f} to {1e3 * slow:.1f} ms"
            rows.append(Row(f"{board}, all markers {how}, a frame, at most", 1e3 * slow, "ms", note=note))
        rows.append(Row(f"{board}, frames a second on one core, at least", 1.0 / frame_s(board, "tracked")[1], "Hz"))
    return Section(
        "Paper budget for capture on a Pi: instructions counted under an emulator, a quarter to a half of the "
        "instructions decoded a cycle (1.0·2, 1.2·2, 1.5·3, 2.4·4)",
        tuple(rows),
    )
