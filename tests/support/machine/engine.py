"""A container engine for the tests: the one that runs here, or one of their own, with base images made where none can
be fetched."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

_PACKAGES = "python3,python3-venv,python3-pip,passwd,ca-certificates,netcat-openbsd"


_NO_RULES = b"""*filter
:INPUT ACCEPT
:FORWARD ACCEPT
:OUTPUT ACCEPT
COMMIT
*nat
:PREROUTING ACCEPT
:INPUT ACCEPT
:OUTPUT ACCEPT
:POSTROUTING ACCEPT
COMMIT
"""


class EngineRefusedError(Exception):
    """No container engine can run here; says why."""


class Engine:
    """An engine, by its socket."""

    def __init__(self, host: str = "") -> None:
        self.environment = {**os.environ, "DOCKER_BUILDKIT": "0", "COMPOSE_DOCKER_CLI_BUILD": "0"}
        if host:
            self.environment["DOCKER_HOST"] = host

    def run(self, *command: str, check: bool = True, timeout_s: float = 900.0) -> subprocess.CompletedProcess[str]:
        """Run a command that speaks to the engine."""
        done = subprocess.run(
            command, env=self.environment, capture_output=True, text=True, timeout=timeout_s, check=False
        )
        if check and done.returncode:
            raise AssertionError(
                f"{' '.join(command)}: {done.returncode}\n{done.stdout[-4000:]}\n{done.stderr[-4000:]}"
            )
        return done

    def answers(self) -> bool:
        """Return whether the engine is there."""
        return self.run("docker", "info", check=False).returncode == 0

    def has(self, image: str) -> bool:
        """Return whether an image is there, fetching it where that is possible."""
        known = self.run("docker", "image", "inspect", image, check=False).returncode == 0
        return known or self.run("docker", "pull", "--quiet", image, check=False).returncode == 0


@contextlib.contextmanager
def container_engine(folder: Path) -> Iterator[Engine]:
    """Yield an engine; one that had to be started keeps its images in a folder, and ends with the block.

    Raises:
        EngineRefusedError: there is none, and none can be started.
    """
    if shutil.which("docker") is None:
        raise EngineRefusedError("no container engine is installed: apt install docker.io docker-compose")
    running = Engine()
    if running.answers():
        yield running
        return
    if shutil.which("dockerd") is None or os.geteuid() != 0:
        raise EngineRefusedError("no container engine runs here, and only root with dockerd installed can start one")
    folder.mkdir(parents=True, exist_ok=True)
    # Short, because the kernel allows a socket's path about 100 characters.
    made = tempfile.TemporaryDirectory(prefix="rhot-docker-", ignore_cleanup_errors=True)
    rules = subprocess.run(["iptables-save"], capture_output=True, check=False).stdout
    with made as short, (folder / "log").open("w") as log:
        host = f"unix://{short}/socket"
        daemon = subprocess.Popen(
            [
                *(
                    "dockerd",
                    "--bridge",
                    "none",
                    "--host",
                    host,
                    "--data-root",
                    str(folder / "data"),
                    "--exec-root",
                    f"{short}/exec",
                ),
                *("--pidfile", f"{short}/pid"),
            ],
            stdout=log,
            stderr=log,
        )
        try:
            started = Engine(host)
            deadline = time.monotonic() + 60.0
            while not started.answers():
                if daemon.poll() is not None or time.monotonic() > deadline:
                    raise EngineRefusedError(f"dockerd does not start: {(folder / 'log').read_text()[-500:]}")
                time.sleep(0.5)
            yield started
        finally:
            daemon.terminate()
            daemon.wait(30)
            # What it leaves in the kernel: its rules, and the network namespace of the host.
            subprocess.run(["iptables-restore"], input=rules or _NO_RULES, capture_output=True, check=False)
            for kept in Path(short).glob("exec/netns/*"):
                subprocess.run(["umount", str(kept)], capture_output=True, check=False)


def make_python_image(engine: Engine, name: str) -> None:
    """Make Debian's Python under the name of the official image, as it cannot be fetched here."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "root"
        subprocess.run(
            [
                *("mmdebstrap", "--quiet", "--variant=apt", f"--include={_PACKAGES}"),
                *('--aptopt=Acquire::Languages "none"', "--dpkgopt=path-exclude=/usr/share/doc/*"),
                *("trixie", str(root)),
            ],
            check=True,
        )
        (root / "usr/bin/python").symlink_to("python3")
        # Builds fetch as this machine does.
        shutil.copy("/etc/ssl/certs/ca-certificates.crt", root / "etc/ssl/certs/ca-certificates.crt")
        packed = subprocess.Popen(["tar", "--create", "--directory", str(root), "."], stdout=subprocess.PIPE)
        subprocess.run(["docker", "import", "-", name], stdin=packed.stdout, env=engine.environment, check=True)
        assert packed.wait() == 0
