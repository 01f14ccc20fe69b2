"""A calibration file that can be tried before it is saved, and undone.

The former file is put aside in the rig folder itself, so that a trial survives the program that began it; a power cut
between any two steps leaves the file as it was before or after.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Final, Generic, TypeVar

from rhot.atomic_file import remove, rename, why, write_atomic
from rhot.errors import ConfigError
from rhot.rig.calibration import CalibrationFile
from rhot.rig.folder import read_json_model, write_json_model

F = TypeVar("F", bound=CalibrationFile)

_Stamp = tuple[int, int]
ABSENT: Final = (0, 0)
"""Stamp of a file that is not there."""


class KeptFile(Generic[F]):
    """One calibration file of a rig folder.

    While a trial lasts, `.NAME.untried.json` is the file as it was before, empty when there was none; a saved file's
    predecessor is `NAME.previous.json`.
    """

    def __init__(self, path: Path, model: type[F]) -> None:
        """Keep a file.

        Args:
            path: of the file, such as `rig/colors.json`.
            model: of its content.
        """
        self.path = path
        self._model = model
        self._untried = path.with_name(f".{path.stem}.untried.json")
        self._previous = path.with_name(f"{path.stem}.previous.json")
        self._swapped = path.with_name(f".{path.stem}.swapped.json")
        self._stamp = ABSENT
        self._content: F | None = None

    @property
    def on_trial(self) -> bool:
        """Whether the file is tried and not saved."""
        return self._untried.exists()

    @property
    def can_undo(self) -> bool:
        """Whether there is a former state to go back to."""
        return self.on_trial or self._previous.exists() or self._swapped.exists()

    @property
    def content(self) -> F | None:
        """What the file holds, None without a file; read again when it has changed.

        Raises:
            CalibrationError: it is not valid.
        """
        stamp = file_stamp(self.path)
        if stamp != self._stamp:
            self._content = None if stamp == ABSENT else read_json_model(self.path, self._model)
            self._stamp = stamp
        return self._content

    def try_out(self, content: F) -> None:
        """Write new content; services that look at the file take it over, and `undo` brings the former one back.

        Raises:
            ConfigError: the folder cannot be written.
        """
        self._finish_swap()
        begins = not self.on_trial
        try:
            if begins:
                write_atomic(self._untried, self.path.read_bytes() if self.path.exists() else b"")
            write_json_model(self.path, content)
        except ConfigError:
            if begins:
                with contextlib.suppress(OSError):
                    self._untried.unlink(missing_ok=True)
            raise
        except OSError as error:
            raise self._unwritable(error) from error

    def save(self) -> None:
        """End the trial: what was tried stays, what was there before becomes the previous file.

        Raises:
            ConfigError: nothing is on trial, or the folder cannot be written.
        """
        if not self.on_trial:
            raise ConfigError(f"{self.path}: nothing new to save; try something first")
        try:
            if self._untried.stat().st_size:
                rename(self._untried, self._previous)
            else:
                remove(self._untried)
        except OSError as error:
            raise self._unwritable(error) from error

    def undo(self) -> None:
        """Bring the former file back: the one before the trial, else the one before the last saving.

        Undoing a saving twice brings the saved file back.

        Raises:
            ConfigError: there is nothing to go back to, or the folder cannot be written.
        """
        if not self.can_undo:
            raise ConfigError(f"{self.path}: there is no former one to go back to")
        self._finish_swap()
        try:
            if self.on_trial:
                if self._untried.stat().st_size:
                    rename(self._untried, self.path)
                else:
                    remove(self.path)
                    remove(self._untried)
                return
            if self.path.exists():
                write_atomic(self._swapped, self.path.read_bytes())
            rename(self._previous, self.path)
            if self._swapped.exists():
                rename(self._swapped, self._previous)
        except OSError as error:
            raise self._unwritable(error) from error

    def _finish_swap(self) -> None:
        """Bring an undoing to its end that a crash has interrupted: what was saved becomes the former file again."""
        if not self._swapped.exists():
            return
        try:
            if self._previous.exists():
                # The former file had not been brought back yet: nothing has changed.
                remove(self._swapped)
            else:
                rename(self._swapped, self._previous)
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> ConfigError:
        return ConfigError(f"{self.path}: cannot be kept: {why(error)}")


def file_stamp(path: Path) -> _Stamp:
    """Return what changes with a file's content."""
    try:
        found = path.stat()
    except OSError:
        return ABSENT
    # A file that is put back keeps its own time, which differs from that of the one it replaces.
    return found.st_mtime_ns, found.st_ino
