"""Limits on the wall clock, the only failures that a busy machine may excuse, and how busy others keep it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Iterable
from pathlib import Path

BUSY = 0.3
"""Processors that others keep busy beyond which wall-clock limits say nothing of the tracker: it takes most of two."""


_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_EVERY_S = 0.25


class WallClockMissed(AssertionError):  # noqa: N818  # it names a verdict, not a fault
    """What was asked for came, but too late or too seldom."""


def in_time(took: float, limit: float, what: str, unit: str = "s") -> None:
    """Check that something took no longer than its limit, both in `unit`.

    Raises:
        WallClockMissed: it took longer.
    """
    if not took < limit:
        raise WallClockMissed(f"{what}: {took:.3g} {unit}, limit {limit:.3g} {unit}")


def figures_in_time(missed: Iterable[str]) -> None:
    """Check that none of the figures that hang on the machine's speed has missed its limit.

    Raises:
        WallClockMissed: some have; `missed` names them with their values.
    """
    if words := "; ".join(missed):
        raise WallClockMissed(words)


def excuse(error: BaseException, others: float) -> str:
    """Return why a failure is not judged, empty when it is.

    Args:
        error: what ended the test.
        others: processors that others kept busy meanwhile.
    """
    if isinstance(error, WallClockMissed) and others > BUSY:
        return f"not judged: others kept {others:.1f} processors busy meanwhile; {error}"
    return ""


class ForeignLoad:
    """Counts the processor time of this process and all it started, and of everybody else, from `start` on.

    What runs in other containers and what the hypervisor takes for others is the machine's count less our own.
    """

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._own: dict[int, float] = {}
        self._first: dict[int, float] = {}
        self._begun_s = self._busy_s = 0.0
        self._thread = threading.Thread(target=self._run, name="foreign-load", daemon=True)

    def start(self) -> None:
        """Begin to count."""
        self._begun_s, self._busy_s = time.monotonic(), _busy_s()
        self._look(first=True)
        self._thread.start()

    def stop(self) -> float:
        """End, and return how many processors others kept busy on average."""
        self._ended.set()
        self._thread.join()
        self._look()
        own_s = sum(used - self._first.get(pid, 0.0) for pid, used in self._own.items())
        return max(0.0, (_busy_s() - self._busy_s - own_s) / max(time.monotonic() - self._begun_s, 1e-3))

    def _run(self) -> None:
        while not self._ended.wait(_EVERY_S):
            self._look()

    def _look(self, first: bool = False) -> None:
        """Note what each of our processes has used; one whose parent was killed stays ours."""
        used: dict[int, tuple[int, float]] = {}
        for folder in Path("/proc").iterdir():
            if folder.name.isdigit():
                try:
                    words = (folder / "stat").read_text().rpartition(")")[2].split()
                except OSError:  # it has just ended
                    continue
                used[int(folder.name)] = int(words[1]), (int(words[11]) + int(words[12])) * _TICK_S
        ours = {os.getpid(), *self._own} & used.keys()
        while more := {pid for pid, (parent, _) in used.items() if parent in ours} - ours:
            ours |= more
        self._own.update({pid: used[pid][1] for pid in ours})
        if first:
            self._first = dict(self._own)


def _busy_s() -> float:
    """Return the processor time that anything has used on this machine, and that its host took from it, seconds."""
    user, nice, system, _, _, irq, softirq, steal = (
        int(word) for word in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]
    )
    return (user + nice + system + irq + softirq + steal) * _TICK_S
