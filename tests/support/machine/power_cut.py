"""A disk that loses its power between any two system calls of a program, and forgets what was not brought to it.

Calls of `os` below a folder are counted; from the n-th on they fail with `PowerCut` and do nothing, so that no clean-up
of the program runs, either. What a disk may then hold differs: `Loss.CONTENT` empties the files that were not synced
(names reached the disk before contents, as ext4 and others do), `Loss.NAMES` takes back renames and removals in folders
that were not synced, `Loss.NOTHING` keeps all. See fsync(2) and rename(2), and "Ensuring data reaches
disk" (LWN, 2011).
"""

from __future__ import annotations

import contextlib
import enum
import io
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock


class PowerCut(BaseException):
    """No program catches this: it has ended."""


class Loss(enum.Enum):
    """What the disk forgets."""

    NOTHING = enum.auto()
    CONTENT = enum.auto()
    NAMES = enum.auto()


@dataclass
class _Change:
    folder: Path
    take_back: Callable[[], None]


@dataclass
class Disk:
    """What was done below a folder.

    Attributes:
        folder: watched.
        cut_at: number of the first call that fails; None = never.
        calls: made so far.
    """

    folder: Path
    cut_at: int | None = None
    calls: int = 0
    _unsynced: set[int] = field(default_factory=set)
    _changes: list[_Change] = field(default_factory=list)

    def _count(self) -> None:
        if self.cut_at is not None and self.calls >= self.cut_at:
            raise PowerCut
        self.calls += 1

    def _mine(self, path: Any) -> bool:
        return not isinstance(path, int) and Path(os.fsdecode(path)).absolute().is_relative_to(self.folder)

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:  # noqa: PLR0915  # one stand-in after the other
        """Count the calls of a block; it ends quietly when the power does."""
        real: dict[str, Any] = {
            name: getattr(os, name)
            for name in ("open", "write", "fsync", "replace", "rename", "unlink", "remove", "chmod", "mkdir")
        }
        really_open = io.open

        def opened(path: Any, flags: int, *rest: Any, **named: Any) -> int:
            if not self._mine(path):
                return int(real["open"](path, flags, *rest, **named))
            self._count()
            handle = int(real["open"](path, flags, *rest, **named))
            if flags & (os.O_WRONLY | os.O_RDWR):
                self._unsynced.add(os.fstat(handle).st_ino)
            return handle

        def fsync(handle: int) -> None:
            self._count()
            real["fsync"](handle)
            status = os.fstat(handle)
            self._unsynced.discard(status.st_ino)
            self._changes = [each for each in self._changes if each.folder.stat().st_ino != status.st_ino]

        def write(handle: int, data: Any) -> int:
            self._count()
            return int(real["write"](handle, data))

        def replaced(source: Any, target: Any, **named: Any) -> None:
            self._count()
            source, target = Path(source), Path(target)
            moved, lost = source.read_bytes(), target.read_bytes() if target.exists() else None
            real["replace"](source, target, **named)
            inode = target.stat().st_ino

            def take_back() -> None:
                _put(source, moved if inode not in self._unsynced else b"")
                _put(target, lost)

            self._changes.append(_Change(target.parent, take_back))

        def unlink(path: Any, **named: Any) -> None:
            if not self._mine(path):
                real["unlink"](path, **named)
                return
            self._count()
            file = Path(path)
            content = file.read_bytes() if file.exists() else None
            real["unlink"](path, **named)
            self._changes.append(_Change(file.parent, lambda: _put(file, content)))

        def counted(name: str) -> Callable[..., Any]:
            def call(*arguments: Any, **named: Any) -> Any:
                if self._mine(arguments[0]):
                    self._count()
                return real[name](*arguments, **named)

            return call

        def open_file(file: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
            stream = really_open(file, mode, *rest, **named)
            if set(mode) & set("wax+") and self._mine(file):
                self._count()
                # Its writing bypasses `os`: it counts as not synced until somebody does so.
                self._unsynced.add(os.fstat(stream.fileno()).st_ino)
            return stream

        patches = {
            "open": opened,
            "fsync": fsync,
            "write": write,
            "replace": replaced,
            "rename": replaced,
            "unlink": unlink,
            "remove": unlink,
            "chmod": counted("chmod"),
            "mkdir": counted("mkdir"),
        }
        with contextlib.ExitStack() as stack:
            for name, stand_in in patches.items():
                stack.enter_context(mock.patch.object(os, name, stand_in))
            stack.enter_context(mock.patch("io.open", open_file))
            stack.enter_context(mock.patch("builtins.open", open_file))
            stack.enter_context(contextlib.suppress(PowerCut))
            yield

    def lose(self, loss: Loss) -> None:
        """Forget what the power cut costs."""
        if loss is Loss.NAMES:
            for change in reversed(self._changes):
                change.take_back()
        elif loss is Loss.CONTENT:
            for file in self.folder.rglob("*"):
                if file.is_file() and file.stat().st_ino in self._unsynced:
                    file.write_bytes(b"")


def _put(file: Path, content: bytes | None) -> None:
    if content is None:
        file.unlink(missing_ok=True)
    else:
        file.write_bytes(content)


def cut_everywhere(make: Callable[[Path], Callable[[], None]], root: Path) -> Iterator[tuple[Path, str, bool]]:
    """Run a program once for each of its calls and each loss, cut off there, and yield what is left.

    Args:
        make: prepares a fresh folder and returns the program.
        root: for the folders.

    Yields:
        The folder, a name for messages, and whether the program had ended before the cut.
    """
    for loss in Loss:
        cut_at, ended = 0, False
        while not ended:
            folder = root / f"{loss.name}-{cut_at}"
            folder.mkdir()
            program = make(folder)
            disk = Disk(folder, cut_at)
            with disk.watched():
                program()
                ended = True
            disk.lose(loss)
            yield folder, f"{loss.name} lost, cut before call {cut_at}", ended
            cut_at += 1
