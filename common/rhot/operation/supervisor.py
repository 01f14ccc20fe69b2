"""Child processes that end with their parent, whichever way it goes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from rhot.errors import RhotError
from rhot.service.stop import EXIT_WITH_PARENT

logger = logging.getLogger(__name__)

_STOP_LIMIT_S: Final = 1.2
_TAIL_LINES: Final = 12


@dataclass(slots=True)
class Child:
    """One running child process.

    Attributes:
        name: for people, such as `capture left`.
        process: the process; its standard input is the leash by which it notices our end.
        log: file that takes its output, None when it goes to ours.
    """

    name: str
    process: asyncio.subprocess.Process
    log: Path | None

    def tail(self) -> str:
        """Return the last lines of its log."""
        if self.log is None:
            return ""
        with contextlib.suppress(OSError):
            return "\n".join(self.log.read_text(errors="replace").splitlines()[-_TAIL_LINES:])
        return ""


class Supervisor:
    """Starts `rhot …` children and ends all of them within two seconds."""

    def __init__(self, log_folder: Path | None = None) -> None:
        self._log_folder = log_folder
        self.children: list[Child] = []

    async def start(self, name: str, arguments: Sequence[str], *, module: str = "rhot") -> Child:
        """Start `rhot ARGUMENTS…`, or another module, with this interpreter."""
        log = None if self._log_folder is None else self._log_folder / f"{name.replace(' ', '-')}.log"
        with contextlib.ExitStack() as stack:
            output: IO[bytes] | None = None if log is None else stack.enter_context(log.open("ab"))
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                module,
                *arguments,
                stdin=asyncio.subprocess.PIPE,
                stdout=output,
                stderr=output,
                env={**os.environ, EXIT_WITH_PARENT: "1"},
                # Its own group: Ctrl-C reaches the parent alone, which then ends the children in order.
                start_new_session=True,
            )
        child = Child(name, process, log)
        self.children.append(child)
        return child

    async def wait_for_failure(self) -> Child:
        """Return the first child that ends by itself."""
        waits = {asyncio.create_task(child.process.wait()): child for child in self.children}
        try:
            done, _ = await asyncio.wait(waits, return_when=asyncio.FIRST_COMPLETED)
            return waits[done.pop()]
        finally:
            for task in waits:
                task.cancel()

    def failure(self, child: Child) -> RhotError:
        """Return the error that names a child that ended by itself."""
        tail = child.tail()
        said = f"; it said:\n{tail}" if tail else ""
        return RhotError(f"{child.name} ended by itself with exit code {child.process.returncode}{said}")

    async def stop(self) -> None:
        """End all children: asked first, killed after a second."""
        running = [child for child in self.children if child.process.returncode is None]
        for child in running:
            with contextlib.suppress(ProcessLookupError):
                child.process.send_signal(signal.SIGTERM)
        try:
            async with asyncio.timeout(_STOP_LIMIT_S):
                await asyncio.gather(*(child.process.wait() for child in running))
        except TimeoutError:
            for child in running:
                if child.process.returncode is None:
                    logger.warning("%s did not end within %.1f s and is killed", child.name, _STOP_LIMIT_S)
                    with contextlib.suppress(ProcessLookupError):
                        child.process.kill()
            await asyncio.gather(*(child.process.wait() for child in running))
