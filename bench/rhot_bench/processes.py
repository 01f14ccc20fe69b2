"""Long computations that do not depend on each other, on several processors."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context
from typing import TypeVar

import cv2

Task = TypeVar("Task")
Result = TypeVar("Result")


def each(work: Callable[[Task], Result], tasks: Sequence[Task], processes: int) -> Iterator[Result]:
    """Yield the result of each task, in their order, as soon as it and those before it are there.

    Args:
        work: a function of a module, for it is called in other processes.
        tasks: what it is called with.
        processes: so many at once, with one thread each.
    """
    # Held back while they start: Python would show a traceback of each that is not yet where `_begin` is called.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        # Forked processes would inherit OpenCV's threads in an unknown state.
        pool = get_context("spawn").Pool(min(processes, len(tasks)), _begin)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    with pool:
        # Leaving early, by an error or Ctrl-C, ends the processes.
        yield from pool.imap(work, tasks)


def _begin() -> None:
    """Leave Ctrl-C to the process that waits for the results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
