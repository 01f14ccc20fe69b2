"""Keys that a person presses while a command follows a running rig."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def keyboard(pressed: Callable[[str], None]) -> Iterator[bool]:
    """Call back with each key while a terminal is there; yields whether it is."""
    if not sys.stdin.isatty() or not sys.stdout.isatty():
        yield False
        return
    import termios  # noqa: PLC0415  # not on every system
    import tty  # noqa: PLC0415

    loop, descriptor = asyncio.get_running_loop(), sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    tty.setcbreak(descriptor)
    loop.add_reader(descriptor, lambda: pressed(os.read(descriptor, 1).decode(errors="replace")))
    try:
        yield True
    finally:
        loop.remove_reader(descriptor)
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
