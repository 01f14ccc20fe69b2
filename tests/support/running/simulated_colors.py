"""The colours of simulated rigs, learnt once for all tests that need the same ones."""

from __future__ import annotations

import fcntl
import functools
import hashlib
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

import rhot
import rhot_calibration
import rhot_capture
import rhot_sim
from rhot.rig import load_rig
from rhot.rig.folder import COLORS_FILE


def copy_or_learn(learn: Callable[[Path], None], kept: Path, path: Path) -> None:
    """Put `colors.json` into a simulated rig's folder: learnt, or as it was learnt for another rig that is alike.

    Learning takes four seconds of computing. Whoever comes first does it, in whichever process; others wait for it.

    Args:
        learn: learns the colours of a rig in its folder.
        kept: a folder for what was learnt, of all processes of this test run and of later ones.
        path: the rig's folder.
    """
    # A single picture shows neither where the router listens, nor what the rig is called, nor the cameras' rate.
    shown = load_rig(path).config.model_dump_json(
        exclude={"bus": True, "name": True, "cameras": {"__all__": {"rate_hz"}}}
    )
    file = kept / f"{hashlib.sha256((shown + _sources()).encode()).hexdigest()}.json"
    with (kept / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not file.exists():
            learn(path)
            shutil.copy(path / COLORS_FILE, file)
    shutil.copy(file, path / COLORS_FILE)


@functools.cache
def _sources() -> str:
    """Return a digest of all that what is learnt depends on besides the rig: other sources may learn other colours."""
    digest = hashlib.sha256(f"{cv2.__version__} {np.__version__}".encode())
    for package in (rhot, rhot_sim, rhot_capture, rhot_calibration):
        for file in sorted(Path(package.__path__[0]).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()
