"""What the page does to the rig folder and its sessions."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from rhot.bus import Bus
from rhot.calibration_step import StepContext
from rhot.errors import BusError, ConfigError
from rhot.rig import BusConfig, HandFile, Rig, write_json_model
from rhot.rig.folder import load_config
from rhot.service.clock_sync import serve_clock
from rhot_viewer.panels import calibrate as sessions
from rhot_viewer.panels.calibrate import Sessions, SimulatedWorld, is_simulated


def test_only_files_that_sessions_read_begin_one(rig: Rig) -> None:
    watched = Sessions(StepContext(rig.path, rig.config.bus))
    assert not watched.files_have_changed()
    write_json_model(rig.path / "hand.json", HandFile(length_m=0.18))
    assert watched.files_have_changed()
    assert not watched.files_have_changed()
    (rig.path / "colors.json").write_text("{}")  # cameras take it over by themselves
    assert not watched.files_have_changed()
    (rig.path / "hand.json").unlink()
    assert watched.files_have_changed()


async def test_a_rig_that_is_not_there_is_named(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "CONNECT_S", 0.1)
    with pytest.raises(BusError, match="no Zenoh router answers"):
        await Sessions(StepContext(rig.path, BusConfig(connect=("tcp/127.0.0.1:1",)))).restart()


def test_what_stands_before_simulated_cameras_is_written_down(rig: Rig, rig_folder: Path) -> None:
    assert is_simulated(rig.config)
    assert not is_simulated(load_config(rig_folder))
    world = SimulatedWorld(rig.path, rig.config)
    world.choose("board")
    assert load_config(rig.path).sim.motion == "board"
    (rig.path / "rig.toml").unlink()
    with pytest.raises(ConfigError, match=r"rig\.toml"):
        world.choose("still")


async def test_two_sessions_within_a_second_are_two(rig: Rig, router: BusConfig) -> None:
    """The same name would be the same session, which services go on with."""
    async with await Bus.open(router) as bus:
        serve_clock(bus)
        bus.events("rhot/control")  # a start is waited for until somebody hears it
        page = Sessions(StepContext(rig.path, router))
        names = await asyncio.gather(page.restart(), page.restart())
    assert len(set(names)) == 2
