"""The colours of simulated rigs, learnt once for all tests that need the same ones."""

from __future__ import annotations

import fcntl
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

from rhot.rig import load_rig
from rhot.rig.folder import COLORS_FILE


def copy_or_learn(learn: Callable[[Path], None], kept: Path, path: Path) -> None:
    """Put `colors.json` into a simulated rig's folder: learnt, or as it was learnt for another rig that is alike.

    Learning takes four seconds of computing. Whoever comes first does it, in whichever process; others wait for it.

    Args:
        learn: learns the colours of a rig in its folder.
        kept: a folder for what was learnt, of all processes of this test run.
        path: the rig's folder.
    """
    # A single picture shows neither where the router listens, nor what the rig is called, nor the cameras' rate.
    shown = load_rig(path).config.model_dump_json(
        exclude={"bus": True, "name": True, "cameras": {"__all__": {"rate_hz"}}}
    )
    file = kept / f"{hashlib.sha256(shown.encode()).hexdigest()}.json"
    with (kept / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not file.exists():
            learn(path)
            shutil.copy(path / COLORS_FILE, file)
    shutil.copy(file, path / COLORS_FILE)
