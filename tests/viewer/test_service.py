"""How the viewer ends."""

from __future__ import annotations

import subprocess
import sys

_STUCK = """
import threading, time
from rhot_viewer.process_priority import end_within
threading.Thread(target=time.sleep, args=(600,)).start()
end_within(130, 0.1)
"""


def test_work_that_cannot_be_interrupted_does_not_hold_up_the_end() -> None:
    ended = subprocess.run([sys.executable, "-c", _STUCK], timeout=120.0, check=False)
    assert ended.returncode == 130
