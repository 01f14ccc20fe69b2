"""A disk that is full or read-only: a small file system of the test's own where root may mount one, else limits."""

from __future__ import annotations

import contextlib
import os
import resource
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Failure = Literal["full", "read-only"]

_SIZE_KB = 1024


@dataclass(frozen=True, slots=True)
class Disk:
    """A folder whose disk can be made to fail.

    Attributes:
        path: the folder.
        mounted: whether it is a file system of its own.
    """

    path: Path
    mounted: bool

    @contextlib.contextmanager
    def failing(self, failure: Failure) -> Iterator[None]:
        """Let every write fail during the block."""
        if failure == "read-only":
            with self._read_only():
                yield
        elif self.mounted:
            filler = self.path / ".filler"
            with filler.open("wb", buffering=0) as stream, contextlib.suppress(OSError):
                while True:
                    stream.write(bytes(1 << 12))
            yield
            filler.unlink()
        else:
            soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
            try:
                yield
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    @contextlib.contextmanager
    def _read_only(self) -> Iterator[None]:
        if self.mounted:
            subprocess.run(["mount", "-o", "remount,ro", str(self.path)], check=True)
            yield
            subprocess.run(["mount", "-o", "remount,rw", str(self.path)], check=True)
        else:
            self.path.chmod(0o555)
            try:
                yield
            finally:
                self.path.chmod(0o755)

    def files(self) -> dict[str, bytes]:
        """Return every file on it, hidden ones too, by its path."""
        return {
            str(file.relative_to(self.path)): file.read_bytes()
            for file in self.path.rglob("*")
            if file.is_file() and file.name != ".filler"
        }


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[Disk]:
    """Yield a disk of a megabyte at a folder that is made, and take it away again."""
    folder.mkdir()
    options = ["-t", "tmpfs", "-o", f"size={_SIZE_KB}k", "tmpfs", str(folder)]
    mounted = (
        os.geteuid() == 0 and subprocess.run(["mount", *options], capture_output=True, check=False).returncode == 0
    )
    try:
        yield Disk(folder, mounted)
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(folder)], check=True)
