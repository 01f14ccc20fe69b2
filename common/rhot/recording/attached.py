"""What `rhot record` puts into its files, and where those lie: the rig folder inside, messages beside pictures."""

from __future__ import annotations

import contextlib
import glob
import os
import re
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Final

from rhot.errors import ConfigError, RhotError
from rhot.recording.mcap.writer import RIG_PREFIX
from rhot.recording.messages import RecordedMessages
from rhot.rig.folder import RIG_FILE, Rig, load_rig

_RIG_NAME: Final = re.compile(r"[A-Za-z0-9_.-]+")


@contextlib.contextmanager
def attached_rig(attachments: Mapping[str, bytes], recording: Path) -> Iterator[Rig]:
    """Load the rig that a recording has attached, into a folder that is there during the block.

    Args:
        attachments: of the recording.
        recording: for messages.

    Raises:
        ConfigError, CalibrationError: nothing is attached, or a file of it is not valid; names the file inside.
    """
    with tempfile.TemporaryDirectory(prefix="rhot-rig-") as folder:
        path = unpack_rig(attachments, Path(folder), recording)
        try:
            rig = load_rig(path)
        except RhotError as error:
            raise type(error)(str(error).replace(str(path), f"{recording}: its rig")) from error
        yield rig


def unpack_rig(attachments: Mapping[str, bytes], folder: Path, recording: Path) -> Path:
    """Write the rig folder that a recording has attached and return its path.

    Args:
        attachments: of the recording.
        folder: to write it into.
        recording: for messages.

    Raises:
        ConfigError: nothing is attached, or it cannot be written.
    """
    found = {name.removeprefix(RIG_PREFIX): data for name, data in attachments.items() if name.startswith(RIG_PREFIX)}
    if not found:
        raise ConfigError(f"{recording}: no rig folder is attached; name the rig with --rig")
    if RIG_FILE not in found:
        raise ConfigError(f"{recording}: the rig in it has lost its {RIG_FILE}; name the rig with --rig")
    path = folder / "rig"
    try:
        path.mkdir()
        for name, data in found.items():
            # A recording may come from anybody: nothing is written outside the folder.
            if _RIG_NAME.fullmatch(name) and name.strip("."):
                (path / name).write_bytes(data)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror or error}") from error
    return path


def file_beside(folder: Path, suffix: str) -> Path:
    """Return the file of the same name beside a folder, which may be called `.`; links are not followed."""
    whole = Path(os.path.abspath(folder))  # noqa: PTH100 - `Path.resolve` follows links
    return whole.parent / f"{whole.name}{suffix}"


def messages_beside(folder: Path) -> list[Path]:
    """Return the MCAP files, in order, that `rhot record --frames` wrote beside a folder of pictures."""
    whole = file_beside(folder, ".mcap")
    parts = sorted(whole.parent.glob(f"{glob.escape(whole.stem)}-[0-9][0-9][0-9].mcap"))
    return [whole] if whole.is_file() else [part for part in parts if part.is_file()]


def rig_of(sources: Iterable[RecordedMessages]) -> Rig | None:
    """Return the rig that the first of some files carries, with its settings; None where none carries any."""
    for source in sources:
        if source.attachments:
            with attached_rig(source.attachments, source.path) as rig:
                return rig
    return None
