"""What a process holds at a moment: memory, file descriptors, threads, processor time."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

_TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK")
_MEGA: Final = 1e-3
"""The kernel counts in kilobytes."""


@dataclass(frozen=True, slots=True)
class ProcessCost:
    """One process at one moment.

    Attributes:
        rss_mb: resident memory, megabytes.
        pss_mb: the same with shared pages divided by those who share them.
        descriptors: open files, sockets, pipes.
        threads: of the process.
        cpu_s: processor time since its start.
    """

    rss_mb: float
    pss_mb: float
    descriptors: int
    threads: int
    cpu_s: float


def process_cost(pid: int) -> ProcessCost | None:
    """Return what a process holds now; None when it has ended."""
    folder = Path(f"/proc/{pid}")
    try:
        status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines() if ":" in line)
        memory = dict(line.split(":", 1) for line in (folder / "smaps_rollup").read_text().splitlines()[1:])
        words = (folder / "stat").read_text().rpartition(")")[2].split()
        descriptors = len(list((folder / "fd").iterdir()))
        return ProcessCost(
            rss_mb=int(status["VmRSS"].split()[0]) * _MEGA,
            pss_mb=int(memory["Pss"].split()[0]) * _MEGA,
            descriptors=descriptors,
            threads=int(status["Threads"]),
            cpu_s=(int(words[11]) + int(words[12])) * _TICK_S,
        )
    except (OSError, KeyError):  # it ended, between two of these files perhaps
        return None


class ForeignLoad:
    """How many processors others keep busy, from one look to the next."""

    def __init__(self) -> None:
        self._at_s, self._busy_s, self._own_s = time.monotonic(), _busy_s(), float("nan")

    def since_last(self, own_s: float) -> float:
        """Return the average since the last look; NaN at the first.

        Args:
            own_s: processor time that our processes have used since their start, seconds.
        """
        at_s, busy_s = time.monotonic(), _busy_s()
        others = (busy_s - self._busy_s - (own_s - self._own_s)) / max(at_s - self._at_s, 1e-3)
        self._at_s, self._busy_s, self._own_s = at_s, busy_s, own_s
        return others


def _busy_s() -> float:
    """Return the processor time that anything has used on this machine, and that its host took from it, seconds."""
    words = Path("/proc/stat").read_text(encoding="utf-8").splitlines()[0].split()
    user, nice, system, _, _, irq, softirq, steal = (int(word) for word in words[1:9])
    return (user + nice + system + irq + softirq + steal) * _TICK_S
