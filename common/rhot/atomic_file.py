"""Files that are replaced in one step and survive a power cut: they hold the old content or the new, never half.

New content goes into a file beside the old one, is brought to the disk (fsync), takes the name (rename), and the folder
is brought to the disk too: without that last step the name may still mean the old file after a power cut. After a crash
a hidden `.NAME.….tmp` may be left over; nothing reads it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import stat
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rhot.errors import ConfigError

if sys.platform == "win32":
    import msvcrt

    _HELD: Final = PermissionError
else:
    import fcntl

    _HELD: Final = BlockingIOError

_LOCK_LIMIT_S: Final = 5.0
"""A change of rig.toml takes milliseconds, on a worn SD card perhaps a second; who holds the lock longer hangs."""
_LOCK_RETRY_S: Final = 0.01
_MODE: Final = 0o666
"""Of a new file, less what the process's umask forbids."""
_FULL: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_FORBIDDEN: Final = (errno.EROFS, errno.EACCES, errno.EPERM)


def write_atomic(file: Path, data: bytes) -> None:
    """Replace a file in one step.

    Raises:
        ConfigError: it cannot be written; the old one stays.
    """
    with replacing(file) as part:
        handle = os.open(part, os.O_WRONLY)
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(handle, rest) :]
        finally:
            os.close(handle)


@contextlib.contextmanager
def replacing(file: Path) -> Iterator[Path]:
    """Yield the path of an empty file to write; it takes the place of `file` when the block ends without an error.

    What is no ordinary file, such as `/dev/null` or a pipe, is written directly.

    Raises:
        ConfigError: it cannot be written; the old one stays.
    """
    try:
        if file.exists() and not file.is_file():
            yield file
            return
        handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.", suffix=".tmp")
        part = Path(name)
        try:
            os.close(handle)
            yield part
            part.chmod(_mode_of(file))
            sync_file(part)
            part.replace(file)
        except BaseException:
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
            raise
        sync_folder(file.parent)
    except OSError as error:
        other = error.filename if isinstance(error.filename, str) and not error.filename.endswith(".tmp") else None
        raise ConfigError(f"{other or file}: cannot be written: {why(error)}") from error


def _mode_of(file: Path) -> int:
    """Return the mode that a file shall have: as it has it, or as an ordinary new file would get it."""
    try:
        return stat.S_IMODE(file.stat().st_mode)
    except OSError:
        pass
    try:
        # Asking the process itself would change it for a moment, for all threads.
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        umask = int(status.partition("Umask:")[2].split()[0], 8)
    except (OSError, ValueError, IndexError):
        umask = os.umask(0o077)
        os.umask(umask)
    return _MODE & ~umask


def why(error: OSError) -> str:
    """Return what went wrong and what to do about it."""
    said = error.strerror or str(error)
    if error.errno in _FULL:
        return f"{said}; make room on that disk and try again"
    if error.errno in _FORBIDDEN:
        return f"{said}; choose a folder that you may write to, or try as the user whose folder it is"
    return said


def why_unread(error: Exception) -> str:
    """Return why a file could not be read, without its name, and what to do about it."""
    if isinstance(error, UnicodeDecodeError):
        return f"byte {error.start} is not UTF-8; save it as text in UTF-8"
    if not isinstance(error, OSError):
        return str(error)
    said = error.strerror or str(error)
    return f"{said}; try as the user whose file it is" if error.errno in _FORBIDDEN else said


def rename(source: Path, target: Path) -> None:
    """Give a file another name of its folder for good.

    Raises:
        OSError: as `Path.replace`.
    """
    source.replace(target)
    sync_folder(target.parent)


def remove(file: Path) -> None:
    """Remove a file for good; one that is not there is no error.

    Raises:
        OSError: as `Path.unlink`.
    """
    file.unlink(missing_ok=True)
    sync_folder(file.parent)


def sync_file(file: Path) -> None:
    """Bring a file's content to the disk.

    Raises:
        OSError: the disk reports that it could not be written.
    """
    # Windows flushes only what may be written.
    handle = os.open(file, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk, on systems that know of such a thing.

    Raises:
        OSError: the disk reports that it could not be written.
    """
    if sys.platform != "win32":
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(handle)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems of other systems and of networks
                raise
        finally:
            os.close(handle)


def sync_file_system(folder: Path) -> None:
    """Bring everything that was written on a folder's file system to the disk: one call for thousands of files.

    Raises:
        OSError: the disk reports that it could not be written.
    """
    if sys.platform == "linux":
        syncfs = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
        if syncfs is None:
            os.sync()
            return
        handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            if syncfs(handle) != 0:
                number = ctypes.get_errno()
                raise OSError(number, os.strerror(number))
        finally:
            os.close(handle)
    elif sys.platform != "win32":
        os.sync()


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep other processes that ask for the same from changing files of a folder during the block.

    The lock is on the folder itself, ends with the process, and needs no file; on Windows it is on a file in it.

    Raises:
        ConfigError: another process holds it for longer than any change takes, or the folder cannot be opened.
    """
    try:
        if sys.platform == "win32":
            handle = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT)
        else:
            handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be opened: {error.strerror or error}") from error
    try:
        _lock(handle, folder)
        yield
    finally:
        os.close(handle)


def _lock(handle: int, folder: Path) -> None:
    deadline = time.monotonic() + _LOCK_LIMIT_S
    while True:
        try:
            if sys.platform == "win32":
                # Of the first byte.
                msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except _HELD as error:
            if time.monotonic() > deadline:
                raise ConfigError(
                    f"{folder}: another program has been changing it for {_LOCK_LIMIT_S:.0f} s; end it "
                    f"(`fuser {folder}` names it) and try again"
                ) from error
            time.sleep(_LOCK_RETRY_S)
        except OSError:
            return  # a file system without locks: as it was before there were any
        else:
            return
