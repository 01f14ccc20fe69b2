"""Run a service whose machine's clock is set while it runs: `python -m moved_clock FILE ARGUMENTS OF rhot…`.

`time.time_ns` and `time.time` of the process are off by what the file says: eight bytes of nanoseconds, then eight of
drift in parts per billion from the moment it was written. The monotonic clock goes on, as on a machine whose clock is
set (clock_settime(2): CLOCK_MONOTONIC is not affected).
"""

from __future__ import annotations

import mmap
import struct
import sys
import time
from pathlib import Path

FORMAT = "<qqq"


def move_clock(file: Path, offset_s: float, drift_ppm: float = 0.0) -> None:
    """Set the clock of a running process; in place, for it is mapped."""
    with file.open("r+b") as handle:
        handle.write(struct.pack(FORMAT, round(offset_s * 1e9), round(drift_ppm * 1e3), time.monotonic_ns()))


def make_clock(file: Path) -> None:
    """Make a clock that is right."""
    file.write_bytes(struct.pack(FORMAT, 0, 0, 0))


def _move(file: Path) -> None:
    with file.open("rb") as handle:
        shared = mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ)
    true_ns = time.time_ns

    def moved_ns() -> int:
        offset_ns: int
        drift_ppb: int
        since_ns: int
        offset_ns, drift_ppb, since_ns = struct.unpack(FORMAT, shared[:])
        return true_ns() + offset_ns + (drift_ppb * (time.monotonic_ns() - since_ns)) // 10**9

    time.time_ns = moved_ns
    time.time = lambda: moved_ns() / 1e9


if __name__ == "__main__":
    _move(Path(sys.argv.pop(1)))
    from rhot.cli import main

    main()
