"""The figures that a service keeps about itself."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from rhot.text import printable


@dataclass(slots=True)
class StatusBoard:
    """Counts, rates and latencies of one service; written from its event loop, read once a second.

    Attributes:
        state: what the service does now.
        session: id of the running session.
        last_error: newest error, for people.
        counts: events since start.
    """

    state: str = "starting"
    session: str = ""
    last_error: str = ""
    counts: Counter[str] = field(default_factory=Counter)
    _started: float = field(default_factory=time.monotonic)
    _rated: set[str] = field(default_factory=set)
    _before: dict[str, int] = field(default_factory=dict)
    _before_at: float = field(default_factory=time.monotonic)
    _sources: list[Callable[[], Mapping[str, int]]] = field(default_factory=list)
    _watched: list[Callable[[], tuple[Mapping[str, float], str]]] = field(default_factory=list)
    _latencies: dict[str, deque[float]] = field(default_factory=dict)

    def count(self, name: str, number: int = 1) -> None:
        """Count events that should not happen, or happen rarely."""
        self.counts[name] += number

    def include(self, source: Callable[[], Mapping[str, int]]) -> None:
        """Show the counts that somebody else keeps, such as a stage, beside our own."""
        self._sources.append(source)

    def watch(self, source: Callable[[], tuple[Mapping[str, float], str]]) -> None:
        """Show the figures that somebody keeps, and the problem that it sees."""
        self._watched.append(source)

    def figures_and_problem(self) -> tuple[dict[str, float], str]:
        """Return the watched figures, and the first problem there is."""
        figures: dict[str, float] = {}
        problem = ""
        for source in self._watched:
            more, seen = source()
            figures.update(more)
            problem = problem or seen
        return figures, problem

    def all_counts(self) -> dict[str, int]:
        """Return all counts, our own and the included ones."""
        counts = dict(self.counts)
        for source in self._sources:
            counts.update(source())
        return counts

    def tick(self, name: str) -> None:
        """Count one event whose rate is shown."""
        self._rated.add(name)
        self.counts[name] += 1

    def latency(self, stage: str, seconds: float) -> None:
        """Note how long a stage took, or how old a result was."""
        samples = self._latencies.get(stage)
        if samples is None:
            # Newest latencies kept per stage: ten seconds at 60 Hz.
            samples = self._latencies[stage] = deque(maxlen=600)
        samples.append(seconds)

    def error(self, text: str) -> None:
        """Note the newest error."""
        self.last_error = printable(text, 4000)

    def clear_latencies(self) -> None:
        """Forget latencies of an earlier session."""
        self._latencies.clear()

    def uptime_s(self) -> float:
        """Return the seconds since the service was made."""
        return time.monotonic() - self._started

    def rates(self) -> dict[str, float]:
        """Return events per second since the last call, for everything ticked."""
        now = time.monotonic()
        elapsed = max(now - self._before_at, 1e-3)
        rates = {name: (self.counts[name] - self._before.get(name, 0)) / elapsed for name in sorted(self._rated)}
        self._before = {name: self.counts[name] for name in self._rated}
        self._before_at = now
        return rates

    def percentiles(self) -> dict[str, dict[str, float]]:
        """Return p50, p99 and the maximum of each stage's newest latencies, seconds."""
        result: dict[str, dict[str, float]] = {}
        for stage, samples in self._latencies.items():
            p50, p99 = np.percentile(np.array(samples), (50, 99))
            result[stage] = {"p50": float(p50), "p99": float(p99), "max": float(max(samples))}
        return result
