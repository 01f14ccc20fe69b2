"""Publishing the frames that a rig folder knows, `rhot/space/<name>`; the service that owns the rig clock does it."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from rhot.bus import Publisher
from rhot.errors import RhotError
from rhot.messages import Space
from rhot.rig import StageFile, read_json_model
from rhot.rig.calibration import RigidTransform, matrix4
from rhot.rig.folder import STAGE_FILE
from rhot.rig.kept_file import file_stamp
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


def spaces_of(rig_path: Path, t_ns: int) -> dict[str, Space]:
    """Return the spaces that a rig folder knows, by name.

    Args:
        rig_path: the folder.
        t_ns: for the messages, rig clock.

    Raises:
        CalibrationError: a file is not valid.
    """
    file = rig_path / STAGE_FILE
    if not file.exists():
        return {}
    stage = read_json_model(file, StageFile)
    return {STAGE: _space(stage.T_rig_stage, stage.source, stage.residual_m, t_ns)}


async def _publish(node: Node, rig_path: Path) -> None:
    publishers: dict[str, Publisher[Space]] = {}
    spaces: Mapping[str, Space] = {}
    stamp, since_s = None, 0.0
    while True:
        now = file_stamp(rig_path / STAGE_FILE)
        changed = now != stamp
        if changed:
            stamp = now
            try:
                spaces = await asyncio.to_thread(spaces_of, rig_path, 0)
            except RhotError as error:
                node.status.error(str(error))
                logger.error("the spaces stay as they were: %s", error)
        if changed or since_s >= REPEAT_S:
            since_s = 0.0
            for name, space in spaces.items():
                if name not in publishers:
                    publishers[name] = node.bus.publisher(f"rhot/space/{name}", Space)
                publishers[name].put(space.model_copy(update={"t_ns": node.clock.now_ns()}))
            for name in publishers.keys() - spaces.keys():
                publishers[name].forget()
        await asyncio.sleep(_LOOK_S)
        since_s += _LOOK_S


def _space(transform: RigidTransform, source: str, residual_m: float | None, t_ns: int) -> Space:
    return Space(t_ns=t_ns, T_rig_space=matrix4(transform.matrix), source=source, residual_m=residual_m)
