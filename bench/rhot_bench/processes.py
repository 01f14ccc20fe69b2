"""Long computations that do not depend on each other, on several processors."""

from __future__ import annotations

import contextlib
import csv
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from multiprocessing import get_context
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import ConfigError

# Tables of numbers in CSV files.


def read_table(path: Path) -> dict[str, FloatArray]:
    """Return the columns of a CSV file of numbers.

    Raises:
        ConfigError: it cannot be read, or a cell is not a number.
    """
    try:
        with path.open(encoding="utf-8", newline="") as file:
            head, *rows = list(csv.reader(file))
        values = np.array(rows, dtype=np.float64)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror or error}; is DATA the right folder?") from error
    except (ValueError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not a table of numbers under one header: {error}") from error
    if values.ndim != 2 or values.shape[1] != len(head) or not np.isfinite(values).all():
        raise ConfigError(f"{path}: holds {values.shape} numbers under {len(head)} columns; rows must be whole, finite")
    return dict(zip(head, values.T, strict=True))


def read_columns(path: Path, names: Sequence[str]) -> dict[str, FloatArray]:
    """Return the columns of a CSV file of numbers, with all of these among them.

    Raises:
        ConfigError: it cannot be read, a cell is not a number, or a column is missing.
    """
    table = read_table(path)
    missing = [name for name in names if name not in table]
    if missing:
        raise ConfigError(f"{path}: holds no column {', '.join(missing)}; {','.join(names)} are needed")
    return table


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
    with _without_interrupts():
        # Forked processes would inherit OpenCV's threads in an unknown state.
        pool = get_context("spawn").Pool(min(processes, len(tasks)), _begin)
    with pool:
        # Leaving early, by an error or Ctrl-C, ends the processes.
        yield from pool.imap(work, tasks)


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Hold Ctrl-C back during the block, where a system can."""
    if sys.platform == "win32":
        yield
    else:
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _begin() -> None:
    """Leave Ctrl-C to the process that waits for the results."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    cv2.setNumThreads(1)
