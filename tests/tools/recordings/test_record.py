"""Where `rhot record` writes."""

from __future__ import annotations

from pathlib import Path

import pytest

from rhot.errors import ConfigError
from rhot.recording.mcap.gaps import Tally
from rhot_tools.recordings.record import _target, remarks


def test_a_file_is_named_and_a_folder_is_made(tmp_path: Path) -> None:
    assert _target(tmp_path / "grasp.mcap") == tmp_path / "grasp.mcap"
    made = _target(tmp_path / "new" / "folder")
    assert made.parent.is_dir()
    assert made.suffix == ".mcap"


@pytest.mark.parametrize(
    ("name", "says"),
    [("take.mp4", "ends in .mcap"), ("nowhere/take.mcap", "the folder .*nowhere does not exist; make it")],
)
def test_what_cannot_be_written_is_refused_before_anything_is_recorded(tmp_path: Path, name: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        _target(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_a_rig_that_was_never_started_and_a_service_that_runs_twice_are_told() -> None:
    tally = Tally()
    for seq in range(5):
        tally.note("rhot/status/fusion/main", seq, 1)
    assert ["is the rig started" in each for each in remarks(tally, 0)] == [True]
    for seq in range(5):
        tally.note("rhot/points", seq, 1)
    assert remarks(tally, 0) == []
    for seq in range(5, 10):
        tally.note("rhot/points", 1000 + seq, 1)
        tally.note("rhot/points", seq, 1)
    assert ["rhot/points: two publishers at once" in each for each in remarks(tally, 0)] == [False, True]
