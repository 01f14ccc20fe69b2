"""Timing several ways of doing the same, turn by turn, so that a busy machine slows all of them alike."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from random import Random
from typing import TypeVar

import numpy as np

from rhot.arrays import FloatArray
from rhot_tools.measures.rows import Row

T = TypeVar("T")
_SEED = 1


@dataclass(frozen=True, slots=True)
class Spread:
    """Times of one way.

    Attributes:
        seconds: (N,) of each turn.
    """

    seconds: FloatArray

    def percentile(self, share: float) -> float:
        """Return a percentile, seconds; NaN without a turn."""
        return float(np.percentile(self.seconds, share)) if self.seconds.size else float("nan")

    @property
    def median(self) -> float:
        """Seconds."""
        return self.percentile(50.0)

    @property
    def p95(self) -> float:
        """Seconds."""
        return self.percentile(95.0)


@contextmanager
def no_collection() -> Iterator[None]:
    """Keep the garbage collector out of what is timed."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def timed(work: Callable[[], object]) -> float:
    """Return how long a call takes, seconds."""
    began = time.perf_counter()
    work()
    return time.perf_counter() - began


def interleaved(items: Iterable[T], ways: Mapping[str, Callable[[T], object]]) -> dict[str, Spread]:
    """Give each item to every way and return their times, without the first five items.

    The order is another one with each item, always the same ones in every run: what comes after a way that fills the
    processor's caches pays for it.
    """
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    names, rng = list(ways), Random(_SEED)
    with no_collection():
        for turn, item in enumerate(items):
            rng.shuffle(names)
            for name in names:
                began = time.perf_counter()
                ways[name](item)
                spent = time.perf_counter() - began
                if turn >= 5:
                    seconds[name].append(spent)
    return {name: Spread(np.array(values)) for name, values in seconds.items()}


def lockstep(
    ways: Mapping[str, Callable[[T], object]], streams: Mapping[str, Sequence[T]], warm_up: int = 10
) -> dict[str, Spread]:
    """Feed each way its own stream, one item of each in turn, and return the processor time of each item.

    For comparing costs on streams that differ; processor time, as growth is asked for and not speed.
    """
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    with no_collection():
        for turn in range(min(map(len, streams.values()), default=0)):
            for name, way in ways.items():
                item = streams[name][turn]
                began = time.thread_time()
                way(item)
                spent = time.thread_time() - began
                if turn >= warm_up:
                    seconds[name].append(spent)
    return {name: Spread(np.array(values)) for name, values in seconds.items()}


def time_rows(name: str, ours: Spread, unit: str, scale: float, *, most: float | None = None) -> tuple[Row, Row]:
    """Return rows of the median, against a target, and of the 95th percentile."""
    return (
        Row(f"{name}, median", ours.median * scale, unit, most=most),
        Row(f"{name}, p95", ours.p95 * scale, unit),
    )


def ratio_rows(name: str, ours: Spread, thesis: Spread, *, most: float | None = None) -> tuple[Row, Row]:
    """Return rows of the ratio of the medians, against a target, and of the 95th percentiles."""
    return (
        Row(f"{name}, ours / thesis, medians", ours.median / thesis.median, "×", most=most),
        Row(f"{name}, ours / thesis, p95", ours.p95 / thesis.p95, "×"),
    )
