"""Limits on the wall clock, the only failures that a machine may excuse: how busy others keep it, how slow it is."""

from __future__ import annotations

import os
import statistics
import threading
import time
from collections.abc import Mapping
from pathlib import Path

BUSY = 0.3
"""Processors that others keep busy beyond which wall-clock limits say nothing of the tracker: it takes most of two."""

_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")
_EVERY_S = 0.25
_WORK = 20_000
_WORK_S = 0.8e-3
"""Processor time of so many additions on the machines that the limits are for: CPython 3.11 at some 3 GHz."""


class WallClockMissed(AssertionError):  # noqa: N818  # it names a verdict, not a fault
    """What was asked for came, but too late or too seldom; `times` as late or as seldom as its limit says."""

    def __init__(self, words: str, times: float) -> None:
        super().__init__(words)
        self.times = times


def in_time(took: float, limit: float, what: str, unit: str = "s") -> None:
    """Check that something took no longer than its limit, both in `unit`.

    Raises:
        WallClockMissed: it took longer.
    """
    if not took < limit:
        raise WallClockMissed(f"{what}: {took:.3g} {unit}, limit {limit:.3g} {unit}", took / limit)


def figures_in_time(missed: Mapping[str, float]) -> None:
    """Check that none of the figures that hang on the machine's speed has missed its limit.

    Args:
        missed: those that have, in words, and how many times as late or as seldom as their limit; inf where that is
            not a question of speed.

    Raises:
        WallClockMissed: there are some.
    """
    if missed:
        raise WallClockMissed("; ".join(missed), max(missed.values()))


def excuse(error: BaseException, others: float, slowness: float) -> str:
    """Return why a failure is not judged, empty when it is.

    Args:
        error: what ended the test.
        others: processors that others kept busy meanwhile.
        slowness: how many times as long the machine computed meanwhile as those that the limits are for.
    """
    if not isinstance(error, WallClockMissed):
        return ""
    if others > BUSY:
        return f"not judged: others kept {others:.1f} processors busy meanwhile; {error}"
    if error.times <= slowness:
        return f"not judged: this machine takes {slowness:.1f} times as long as those the limit is for; {error}"
    return ""


class MachineWatch:
    """Counts what others use of the machine, and measures its speed, from `start` on.

    What runs in other containers and what the hypervisor takes for others is the machine's count less the processor
    time of this process and all it started. A core that is clocked down or shared with a neighbour's thread counts as
    busy with our own work: it shows in the processor time of a fixed piece of work, which waiting does not add to.
    """

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._own: dict[int, float] = {}
        self._first: dict[int, float] = {}
        self._begun_s = self._busy_s = 0.0
        self._work_s: list[float] = []
        self._thread = threading.Thread(target=self._run, name="machine-watch", daemon=True)

    def start(self) -> None:
        """Begin to count."""
        self._begun_s, self._busy_s = time.monotonic(), _busy_s()
        self._look(first=True)
        self._thread.start()

    def stop(self) -> tuple[float, float]:
        """End, and return how many processors others kept busy on average, and the slowness as `excuse` takes it."""
        self._ended.set()
        self._thread.join()
        self._look()
        own_s = sum(used - self._first.get(pid, 0.0) for pid, used in self._own.items())
        others = (_busy_s() - self._busy_s - own_s) / max(time.monotonic() - self._begun_s, 1e-3)
        return max(0.0, others), statistics.median(self._work_s) / _WORK_S

    def _run(self) -> None:
        while not self._ended.wait(_EVERY_S):
            self._look()

    def _look(self, first: bool = False) -> None:
        """Note what each of our processes has used, where one whose parent was killed stays ours, and work a little."""
        self._work_s.append(_work_s())
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


def _work_s() -> float:
    """Return the processor time that a fixed piece of work takes this thread, seconds."""
    begun_s, total = time.thread_time(), 0
    for number in range(_WORK):
        total += number
    return time.thread_time() - begun_s
