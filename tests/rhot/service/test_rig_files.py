"""The rig's settings over the bus."""

from __future__ import annotations

from pathlib import Path

import msgpack
from bus_watch import answers

from rhot.bus import Answer, Bus
from rhot.rig import BusConfig
from rhot.service.configuration import RIG_KEY, fetch_rig_files, serve_rig_files


async def test_a_recorder_without_the_rig_gets_its_settings(rig_folder: Path, router: BusConfig) -> None:
    (rig_folder / "keys").mkdir()
    (rig_folder / "keys" / "private.pem").write_text("secret")
    async with await Bus.open(router) as rig, await Bus.open(router) as recorder:
        serve_rig_files(rig, rig_folder)
        await answers(recorder, RIG_KEY)
        found = await fetch_rig_files(recorder)
        assert found["rig.toml"] == (rig_folder / "rig.toml").read_bytes()
        assert not any("pem" in name for name in found)


async def test_an_answer_with_paths_is_not_believed(router: BusConfig) -> None:
    async with await Bus.open(router) as liar, await Bus.open(router) as recorder:
        packed = msgpack.packb({"rig.toml": b"", "../../x": b""})
        liar.queryable(RIG_KEY, lambda _: Answer(packed, "application/msgpack"))
        await answers(recorder, RIG_KEY)
        assert await fetch_rig_files(recorder) == {}


async def test_nobody_answers(router: BusConfig) -> None:
    async with await Bus.open(router) as recorder:
        assert await fetch_rig_files(recorder) == {}
