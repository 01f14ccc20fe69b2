"""Publishing the frames that a rig folder knows, `rhot/space/<name>`; the service that owns the rig clock does it."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import Final

from rhot.bus import Publisher
from rhot.errors import RhotError
from rhot.messages import Space
from rhot.quality import figure
from rhot.rig import RegistrationFile, StageFile, read_json_model
from rhot.rig.calibration import RigidTransform, matrix4
from rhot.rig.folder import OBJECT_SOURCES, STAGE_FILE, registration_name
from rhot.rig.kept_file import ABSENT, file_stamp
from rhot.service.node import Node

logger = logging.getLogger(__name__)

STAGE: Final = "stage"
REPEAT_S: Final = 1.0
"""Who joins late and only listens knows where the floor is after this time."""
_LOOK_S: Final = 0.25
"""How often the folder is looked at: whoever tries a new floor in the page sees it at once."""


def publish_spaces(node: Node, rig_path: Path) -> None:
    """Publish the rig folder's spaces for as long as the service lives: once a second, and when they change."""
    node.beside(lambda: _publish(node, rig_path))


def space_files(rig_path: Path) -> dict[str, Path]:
    """Return the files that may hold a space, by the space's name."""
    names = {STAGE: STAGE_FILE} | {str(source): registration_name(source) for source in OBJECT_SOURCES}
    return {name: rig_path / file for name, file in names.items()}


def read_space(name: str, file: Path, t_ns: int) -> Space | None:
    """Return the space that a file holds; None without a file.

    Args:
        name: of the space.
        file: see `space_files`.
        t_ns: for the message, rig clock.

    Raises:
        CalibrationError: the file is not valid.
    """
    if not file.exists():
        return None
    if name == STAGE:
        stage = read_json_model(file, StageFile)
        return _space(stage.T_rig_stage, stage.source, stage.residual_m, t_ns)
    registration = read_json_model(file, RegistrationFile)
    rms_mm = figure(registration.quality, "residual_rms_mm")
    residual_m = None if rms_mm is None else 1e-3 * rms_mm
    return _space(registration.T_rig_tracker, f"{name} registration", residual_m, t_ns)


async def _publish(node: Node, rig_path: Path) -> None:
    files = space_files(rig_path)
    publishers: dict[str, Publisher[Space]] = {}
    spaces: dict[str, Space] = {}
    stamps: dict[str, tuple[int, int]] = {}
    since_s = 0.0
    while True:
        changed = {name for name, file in files.items() if file_stamp(file) != stamps.get(name, ABSENT)}
        for name in changed:
            stamps[name] = file_stamp(files[name])
            try:
                space = await asyncio.to_thread(read_space, name, files[name], 0)
            except RhotError as error:
                node.status.error(str(error))
                logger.error("%s stays as it was: %s", name, error)
                continue
            if space is not None:
                spaces[name] = space
            elif spaces.pop(name, None) is not None:
                publishers[name].forget()
        repeat = since_s >= REPEAT_S
        since_s = 0.0 if repeat else since_s
        for name, space in spaces.items():
            if repeat or name in changed:
                if name not in publishers:
                    publishers[name] = node.bus.publisher(f"rhot/space/{name}", Space)
                publishers[name].put(space.model_copy(update={"t_ns": node.clock.now_ns()}))
        await asyncio.sleep(_LOOK_S)
        since_s += _LOOK_S


def _space(transform: RigidTransform, source: str, residual_m: float | None, t_ns: int) -> Space:
    return Space(t_ns=t_ns, T_rig_space=matrix4(transform.matrix), source=source, residual_m=residual_m)
