"""The viewer as a process that can be started again on its port."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

from page.browser import wait_until


class ViewerProcess:
    """One page of the viewer.

    Args:
        arguments: of `rhot viewer`, without the port.
        port: where it listens.
        log: file that takes its output.
    """

    def __init__(self, arguments: list[str], port: int, log: Path) -> None:
        self.url = f"http://127.0.0.1:{port}"
        self._log = log
        self._command = ["viewer", *arguments, "--port", str(port)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it and wait until it is on the bus."""
        with self._log.open("wb") as output:
            process = subprocess.Popen([sys.executable, "-m", "rhot", *self._command], stdout=output, stderr=output)
        self._process = process
        wait_until(lambda: "connected and waits" in self._log.read_text() or process.poll() is not None, "the viewer")

    def stop(self) -> None:
        """Ctrl-C; how soon it ends is measured where a machine is idle, here only that it does."""
        assert self._process is not None
        self._process.send_signal(signal.SIGINT)
        assert self._process.wait(timeout=30.0) == 130, self._log.read_text()
        said = self._log.read_text()
        assert "Traceback" not in said, said

    def kill(self) -> None:
        """End it, whatever it does."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
