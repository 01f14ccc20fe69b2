"""Further frames: rigid or invalid on the wire, and published as the rig folder knows them, also while it changes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from pydantic import BaseModel

from rhot.bus import Bus
from rhot.clock import SystemClock
from rhot.errors import WireError
from rhot.messages import Control, Space, decode, encode
from rhot.rig import BusConfig, FusionConfig, RegistrationFile, RigidTransform, StageFile, write_json_model
from rhot.service import Node
from rhot.service.runner import serve
from rhot.service.spaces import publish_spaces

_TURNED = ((0.0, -1.0, 0.0, 0.1), (1.0, 0.0, 0.0, -0.2), (0.0, 0.0, 1.0, 0.8), (0.0, 0.0, 0.0, 1.0))
_SPACE = Space(t_ns=1, T_rig_space=_TURNED, source="desk board")


def test_it_comes_back_as_it_was() -> None:
    assert decode(encode(_SPACE), Space) == _SPACE


@pytest.mark.parametrize(
    "rows",
    [
        pytest.param(((-1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), *_TURNED[2:]), id="mirrored"),
        pytest.param(((2.0, 0.0, 0.0, 0.0), *_TURNED[1:]), id="scaled"),
        pytest.param((*_TURNED[:3], (0.0, 0.0, 0.1, 1.0)), id="projective"),
        pytest.param(((0.0, -1.0, 0.0, 1e6), *_TURNED[1:]), id="on the moon"),
    ],
)
def test_what_is_no_rigid_transform_is_refused(rows: object) -> None:
    payload = encode(_SPACE.model_copy(update={"T_rig_space": rows}))
    with pytest.raises(WireError, match="T_rig_space"):
        decode(payload, Space)


class _Owner:
    """The least of a service that publishes spaces; no session is ever started."""

    name, instance, owns_clock = "fusion", "main", True
    config: BaseModel = FusionConfig()

    def __init__(self, rig_path: Path) -> None:
        self._rig_path = rig_path

    def reconfigure(self, config: BaseModel) -> None:
        raise NotImplementedError

    def attach(self, node: Node) -> None:
        publish_spaces(node, self._rig_path)

    async def run(self, node: Node, start: Control) -> None:
        raise NotImplementedError


@pytest.fixture
async def owner(rig_folder: Path, router: BusConfig) -> AsyncIterator[Path]:
    task = asyncio.create_task(serve(_Owner(rig_folder), router, SystemClock()))
    yield rig_folder
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


def _floor(height_m: float) -> StageFile:
    return StageFile(
        T_rig_stage=RigidTransform(position=(0.0, 0.0, height_m), orientation=(0.5, -0.5, 0.5, 0.5)),
        source="desk board",
        residual_m=0.002,
    )


async def test_the_folders_floor_is_published_without_a_session(owner: Path, router: BusConfig) -> None:
    async with asyncio.timeout(20.0), await Bus.open(router, timeout_s=10.0) as bus:
        heard = bus.events("rhot/space/*")
        write_json_model(owner / "stage.json", _floor(1.59))
        first = await _next(heard)
        assert (first.source, first.residual_m) == ("desk board", 0.002)
        # R of (0.5, -0.5, 0.5, 0.5) takes x to z, y to -x and z to -y.
        assert first.T_rig_space[2] == pytest.approx((1.0, 0.0, 0.0, 1.59))
        assert (await _next(heard)).seq == first.seq + 1, "who joins late hears it, too"
        write_json_model(owner / "stage.json", _floor(1.69))
        while (await _next(heard)).T_rig_space[2][3] != 1.69:
            pass
        (answer,) = await bus.get("rhot/space/stage?format=json", timeout_s=2.0)
        assert json.loads(answer.payload)["T_rig_space"][2][3] == 1.69
        (owner / "stage.json").write_text("{}")
        assert (await _next(heard)).T_rig_space[2][3] == 1.69, "what cannot be read changes nothing"
        registration = RegistrationFile(T_rig_tracker=RigidTransform.identity(), quality={"residual_rms_mm": 1.5})
        write_json_model(owner / "registration.steamvr.json", registration)
        while True:
            space = await _next(heard)
            if space.source == "steamvr registration":
                break
        assert space.residual_m == pytest.approx(0.0015)
        (owner / "stage.json").unlink()
        while await bus.get("rhot/space/stage", timeout_s=2.0):
            await asyncio.sleep(0.05)


async def _next(heard: object) -> Space:
    async for sample in heard:  # type: ignore[attr-defined]
        return decode(sample.payload, Space)
    raise AssertionError("the subscription ended")
