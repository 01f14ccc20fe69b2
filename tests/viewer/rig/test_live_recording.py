"""Recording from the page."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from bus_watch import until

from rhot.bus import Bus
from rhot.errors import ConfigError
from rhot.messages import PointSet
from rhot.recording.mcap.reader import open_mcap
from rhot.rig import BusConfig
from rhot_viewer.rig.live_recording import LiveRecording, explain, folder_below

SENT = 40


async def test_every_message_of_a_session_is_in_the_file(router: BusConfig, rig_folder: Path, tmp_path: Path) -> None:
    recording = LiveRecording(router, rig_folder, tmp_path / "recordings")
    running = asyncio.create_task(recording.run())
    async with await Bus.open(router) as bus:
        points = bus.publisher("rhot/points", PointSet)
        recording.start("desk")
        recording.start("desk")
        assert await points.wait_for_reader(60.0)
        for number in range(SENT):
            points.put(PointSet(t_ns=number, frame="rig", points={}))
        async with asyncio.timeout(60.0):
            while recording.tally.messages < SENT:
                await asyncio.sleep(0.02)
        recording.stop()
        async with asyncio.timeout(60.0):
            while recording.running:
                await asyncio.sleep(0.02)
    running.cancel()
    assert (recording.problem, recording.tally.lost) == ("", 0)
    assert recording.rate_hz > 0.0
    assert recording.file is not None
    assert recording.file.parent == tmp_path / "recordings" / "desk"
    assert recording.megabytes == pytest.approx(recording.file.stat().st_size / 1e6)
    assert len(list(open_mcap(recording.file).samples())) == SENT
    with pytest.raises(ConfigError, match="marker"):
        await explain(recording.file, "1", rig_folder)


async def test_a_file_that_is_deleted_meanwhile_does_not_end_the_page(
    router: BusConfig, rig_folder: Path, tmp_path: Path
) -> None:
    recording = LiveRecording(router, rig_folder, tmp_path / "recordings")
    running = asyncio.create_task(recording.run())
    recording.start()
    await until(lambda: recording.running)
    assert recording.file is not None
    recording.file.unlink()
    recording.stop()
    await until(lambda: not recording.running)
    assert "incomplete" in recording.problem
    assert not running.done()
    running.cancel()


async def test_what_hinders_is_said(tmp_path: Path, rig_folder: Path, router: BusConfig) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    recording = LiveRecording(router, rig_folder, blocked)
    running = asyncio.create_task(recording.run())
    recording.start("desk")
    async with asyncio.timeout(60.0):
        while not recording.problem:
            await asyncio.sleep(0.02)
    running.cancel()
    assert "cannot be made" in recording.problem
    assert not recording.running


@pytest.mark.parametrize("name", ["/etc", "..", "../x", "a/../../x", ".ssh", "link", "link/x", "a\nb", "x" * 200])
def test_recordings_stay_below_their_folder(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path)
    with pytest.raises(ConfigError, match=r"below|leads out"):
        folder_below(folder, name)


def test_a_folder_below_is_named_by_people(tmp_path: Path) -> None:
    assert folder_below(tmp_path, "") == tmp_path
    assert folder_below(tmp_path, " desk/left hand ") == tmp_path / "desk" / "left hand"


async def test_a_folder_elsewhere_is_refused_in_words(tmp_path: Path) -> None:
    recording = LiveRecording(BusConfig(), tmp_path, tmp_path / "recordings")
    recording.start("../../etc")
    assert "recordings are kept below" in recording.problem
    assert not (tmp_path / "recordings").exists()


async def test_what_is_no_time_is_not_handed_to_a_command(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not a number of seconds"):
        await explain(tmp_path / "a.mcap", "--out=/etc/passwd", tmp_path)
