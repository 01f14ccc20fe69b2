"""The page's process beside those that track: its priority, and its end when it is asked to."""

from __future__ import annotations

import os
import threading
from typing import Final

_END_LIMIT_S: Final = 0.9
"""From Ctrl-C to the end of the process, at most; with two busy processes beside it that was 12 s without a limit."""
NICE: Final = 10
"""Where processors are short, tracking goes first and the page shows fewer frames."""


def end_within(exit_code: int, limit_s: float = _END_LIMIT_S) -> None:
    """End this process after a while whatever still runs: a thread that fits colours cannot be interrupted."""
    timer = threading.Timer(limit_s, os._exit, (exit_code,))
    timer.daemon = True
    timer.start()
