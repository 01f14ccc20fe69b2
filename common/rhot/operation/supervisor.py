"""Child processes that end with their parent, whichever way it goes."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

from rhot.errors import EXIT_AGAIN, RhotError
from rhot.service.stop import EXIT_WITH_PARENT

logger = logging.getLogger(__name__)

if sys.platform == "win32":
    _OWN_GROUP: Final[dict[str, Any]] = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
else:
    _OWN_GROUP: Final[dict[str, Any]] = {"start_new_session": True}
_STOP_LIMIT_S: Final = 1.2
_TAIL_LINES: Final = 12
_PROVEN_S: Final = 5.0
"""A service that has run for so long is able to: what ends it then is a fault that may pass."""
_AGAIN_FIRST_S: Final = 0.5
_AGAIN_MOST_S: Final = 5.0
"""Before a service is restarted; twice as long each time that it did not prove itself."""
_MOST_CRASHES: Final = 4
"""In a row, of a service that did not prove itself in between."""


@dataclass(slots=True)
class Child:
    """One running child process.

    Attributes:
        name: for people, such as `capture left`.
        process: the process; its standard input is the leash by which it notices our end.
        log: file that takes its output, None when it goes to ours.
        module, arguments: what it was started with.
        started_s: when, by the monotonic clock.
        crashes: how often in a row it ended by itself before it had proved itself.
    """

    name: str
    process: asyncio.subprocess.Process
    log: Path | None
    module: str = "rhot"
    arguments: tuple[str, ...] = ()
    started_s: float = field(default_factory=time.monotonic)
    crashes: int = 0

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

    def command(self, module: str, arguments: Sequence[str]) -> list[str]:
        """Return the command line of a child."""
        return [sys.executable, "-m", module, *arguments]

    async def start(self, name: str, arguments: Sequence[str], *, module: str = "rhot") -> Child:
        """Start `rhot ARGUMENTS…`, or another module, with this interpreter."""
        log = None if self._log_folder is None else self._log_folder / f"{name.replace(' ', '-')}.log"
        with contextlib.ExitStack() as stack:
            output: IO[bytes] | None = None if log is None else stack.enter_context(log.open("ab"))
            process = await asyncio.create_subprocess_exec(
                *self.command(module, arguments),
                stdin=asyncio.subprocess.PIPE,
                stdout=output,
                stderr=output,
                env={**os.environ, EXIT_WITH_PARENT: "1"},
                # Its own group: Ctrl-C reaches the parent alone, which then ends the children in order.
                **_OWN_GROUP,
            )
        child = Child(name, process, log, module, tuple(arguments))
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

    async def keep_running(self) -> Child:
        """Restart children that end by themselves; return the first that this does not help.

        That is one whose settings are wrong, that fails at its first start, or that crashes again and again.
        """
        keeping = [asyncio.create_task(self._keep(child)) for child in self.children]
        try:
            done, _ = await asyncio.wait(keeping, return_when=asyncio.FIRST_COMPLETED)
            return done.pop().result()
        finally:
            for task in keeping:
                task.cancel()

    async def _keep(self, child: Child) -> Child:
        while True:
            code = await child.process.wait()
            lived_s = time.monotonic() - child.started_s
            crashes = 0 if lived_s >= _PROVEN_S else child.crashes + 1
            able = lived_s >= _PROVEN_S or code == EXIT_AGAIN or (code < 0 and crashes < _MOST_CRASHES)
            # The exit code of wrong settings, which restarting does not mend.
            if code == 2 or not able:
                return child
            wait_s = min(_AGAIN_MOST_S, _AGAIN_FIRST_S * 2**crashes)
            logger.warning("%s; it restarts in %.1f s; the others keep running", self.failure(child), wait_s)
            await asyncio.sleep(wait_s)
            self.children.remove(child)
            child = await self.start(child.name, child.arguments, module=child.module)
            child.crashes = crashes

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
                if sys.platform == "win32" and child.process.stdin is not None:
                    # Where signals only kill; see EXIT_WITH_PARENT.
                    child.process.stdin.close()
                else:
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
