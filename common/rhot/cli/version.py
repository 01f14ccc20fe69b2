"""Which RHOT this is."""

from __future__ import annotations

import subprocess
from pathlib import Path

from rhot import __version__


def commit() -> str | None:
    """Return the commit of this code, with `-dirty` where files differ from it; None where nobody knows.

    A wheel brings it in a file (`hatch_build.py`); elsewhere the repository around the package is asked.
    """
    folder = Path(__file__).parents[1]
    packed = folder / "commit"
    try:
        if packed.exists():
            return packed.read_text(encoding="utf-8").strip() or None
        described = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--exclude=*"],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
            timeout=10,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return described.stdout.strip() or None


def full_version() -> str:
    """Return the version with its commit, for people."""
    known = commit()
    return f"{__version__} ({known})" if known else __version__
