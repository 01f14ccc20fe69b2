"""The simulated rig that is measured: the user's own, or a temporary one."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rich.progress import Progress

from rhot.errors import ConfigError
from rhot.rig import Rig, load_rig
from rhot.rig.folder import RIG_FILE
from rhot.text import as_argument
from rhot_sim.rig.folder import write_simulated_rig

RATE_HZ: Final = 60.0


@contextlib.contextmanager
def simulated_rig(path: Path | None, progress: Progress, seed: int = 1) -> Iterator[Rig]:
    """Give a simulated rig: the one in a folder, or a temporary one.

    Raises:
        ConfigError: the folder holds no rig, or a real one.
    """
    if path is not None:
        if not (path / RIG_FILE).exists():
            raise ConfigError(
                f"--rig {path}: holds no {RIG_FILE}; `rhot init {as_argument(path)} --sim` makes a simulated rig"
            )
        rig = load_rig(path)
        real = [name for name, camera in rig.config.cameras.items() if camera.source != "simulated"]
        if real or len(rig.config.cameras) < 2:
            raise ConfigError(
                f"--rig {path}: two simulated cameras or more are needed, {', '.join(real) or 'too few'} will not do; "
                "`rhot init RIG --sim` makes a simulated rig"
            )
        yield rig
        return
    task = progress.add_task("preparing the simulated rig", total=None)
    with tempfile.TemporaryDirectory(prefix="rhot-bench-") as folder:
        rig = write_simulated_rig(Path(folder) / "rig", rate_hz=RATE_HZ, seed=seed)
        progress.remove_task(task)
        yield rig
