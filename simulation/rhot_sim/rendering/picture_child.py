"""What the child processes that draw simulated pictures have in common.

In one process with tracking, drawing would hold Python's interpreter lock while a picture waits to be looked at, and
latency would measure the simulator. A child reads requests from its standard input, writes pictures to its standard
output, and ends with its parent, whose death closes that input.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
from typing import Final

_NICE: Final = 5
_STOP_S: Final = 0.5


def keep_out_of_the_way() -> None:
    """Make this process a drawing child: lower priority, one thread, deaf to Ctrl-C, which is for the parent."""
    import cv2  # noqa: PLC0415  # the parent may do without

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(_NICE)
    cv2.setNumThreads(1)


def end(child: subprocess.Popen[bytes]) -> None:
    """End a drawing child, whatever it is doing."""
    child.terminate()
    try:
        child.wait(_STOP_S)
    except subprocess.TimeoutExpired:
        child.kill()
        child.wait()
