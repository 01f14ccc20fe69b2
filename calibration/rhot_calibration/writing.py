"""Writing what a calibration command found into the rig folder."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from pydantic import BaseModel
from rich.console import Console

from rhot.atomic_file import write_atomic
from rhot.rig import write_json_model

# Keys that a person presses while a command follows a running rig.

_POLL_S: Final = 0.05
"""Between two looks for a key, on Windows."""


@contextlib.contextmanager
def keyboard(pressed: Callable[[str], None]) -> Iterator[bool]:
    """Call back with each key while a terminal is there; yields whether it is."""
    if not sys.stdin.isatty() or not sys.stdout.isatty():
        yield False
        return
    loop = asyncio.get_running_loop()
    if sys.platform == "win32":
        import msvcrt  # noqa: PLC0415

        async def poll() -> None:
            while True:
                while msvcrt.kbhit():
                    pressed(msvcrt.getwch())
                await asyncio.sleep(_POLL_S)

        polling = loop.create_task(poll())
        try:
            yield True
        finally:
            polling.cancel()
    else:
        import termios  # noqa: PLC0415
        import tty  # noqa: PLC0415

        descriptor = sys.stdin.fileno()
        before = termios.tcgetattr(descriptor)
        tty.setcbreak(descriptor)
        loop.add_reader(descriptor, lambda: pressed(os.read(descriptor, 1).decode(errors="replace")))
        try:
            yield True
        finally:
            loop.remove_reader(descriptor)
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def write_found(
    console: Console, file: Path, found: BaseModel, then: str, *, before: Path | None = None, dry_run: bool = False
) -> None:
    """Write a file of the rig folder, keep the one that it replaces as NAME.previous.json, and say so.

    Args:
        console: where it is said.
        file: of the rig folder.
        found: what is to stand in it.
        then: who takes it, and when; a sentence.
        before: the file that it replaces, where that has another name.
        dry_run: write nothing.

    Raises:
        ConfigError: the folder cannot be written.
    """
    if dry_run:
        console.print(f"nothing was written (--dry-run); {file} is as before", markup=False, highlight=False)
        return
    replaced, kept = before or file, ""
    if replaced.exists():
        # Byte by byte: one that cannot be read is replaced, too.
        previous = file.with_suffix(".previous.json")
        write_atomic(previous, replaced.read_bytes())
        kept = f"; the one before is {previous}"
    write_json_model(file, found)
    console.print(f"written: {file}{kept}. {then}", markup=False, highlight=False)
