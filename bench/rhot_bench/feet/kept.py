"""Finished runs as files, so that an interrupted `rhot evaluate feet` goes on where it was.

One file holds one run of one person. It counts only for the same run, rig, length and version of the code; anything
else is played again.
"""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import numpy as np

from rhot.atomic_file import write_atomic
from rhot.errors import ConfigError
from rhot.rig import Rig
from rhot_bench.feet.runs import SIDES, Played, Run, Track

_TRACKERS = ("ours", "thesis")
_ARRAYS = ("t_s", "late_s", "blackouts", "picture_s", "pose_s", "knee_error_m")
_VALUES = ("blackout_sides", "knees_backwards", "counts")


def make_folder(folder: Path) -> None:
    """Make a folder for finished runs where there is none.

    Raises:
        ConfigError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot keep finished runs here: {error}; name another folder") from error


def key_of(run: Run, rig: Rig, seed: int, seconds: float, commit: str | None) -> str:
    """Return what a finished run depends on, as text."""
    # The rest of a rig names folders, which differ each time when it is a temporary one.
    used = rig.config.model_dump(mode="json", include={"feet", "body"})
    return json.dumps([asdict(run), used, seed, seconds, commit], sort_keys=True)


def save_played(file: Path, key: str, played: Played) -> None:
    """Write a finished run.

    Raises:
        ConfigError: it cannot be written.
    """
    values = {name: getattr(played, name) for name in _VALUES}
    arrays: dict[str, Any] = {"key": np.array(key), "values": np.array(json.dumps(values))}
    arrays |= {name: getattr(played, name) for name in _ARRAYS}
    for tracker in _TRACKERS:
        for side, track in getattr(played, tracker).items():
            arrays |= {f"{tracker} {side} {part.name}": getattr(track, part.name) for part in fields(Track)}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomic(file, buffer.getvalue())


def load_played(file: Path, key: str, run: Run, seed: int) -> Played | None:
    """Return a finished run; None when there is none, or one of something else."""
    try:
        with np.load(file, allow_pickle=False) as stored:
            if str(stored["key"]) != key:
                return None
            return _played(dict(stored), run, seed)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _played(stored: dict[str, Any], run: Run, seed: int) -> Played:
    values: dict[str, Any] = {name: stored[name] for name in _ARRAYS} | json.loads(str(stored["values"]))
    for tracker in _TRACKERS:
        values[tracker] = {
            side: Track(**{part.name: stored[f"{tracker} {side} {part.name}"] for part in fields(Track)})
            for side in SIDES
        }
    return Played(run=run, seed=seed, **values)
