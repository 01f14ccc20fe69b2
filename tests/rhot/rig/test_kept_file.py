"""Trying, saving and undoing a calibration file."""

from __future__ import annotations

from pathlib import Path

import pytest

from rhot.errors import CalibrationError, ConfigError
from rhot.rig import HandFile
from rhot.rig.kept_file import KeptFile


@pytest.fixture
def kept(tmp_path: Path) -> KeptFile[HandFile]:
    return KeptFile(tmp_path / "hand.json", HandFile)


def length(kept: KeptFile[HandFile]) -> float | None:
    return None if kept.content is None else kept.content.length_m


def test_a_trial_is_undone_to_no_file(kept: KeptFile[HandFile]) -> None:
    kept.try_out(HandFile(length_m=0.18))
    kept.try_out(HandFile(length_m=0.19))
    assert (kept.on_trial, length(kept)) == (True, 0.19)
    kept.undo()
    assert (kept.on_trial, kept.can_undo, length(kept)) == (False, False, None)
    assert list(kept.path.parent.iterdir()) == []


def test_a_trial_is_undone_to_the_very_file(kept: KeptFile[HandFile]) -> None:
    former = '{"length_m": 0.170}\n'
    kept.path.write_text(former)
    kept.try_out(HandFile(length_m=0.18))
    kept.try_out(HandFile(length_m=0.19))
    # Another program, or this one after a crash, finds the trial.
    again = KeptFile(kept.path, HandFile)
    assert again.on_trial
    again.undo()
    assert kept.path.read_text() == former
    assert length(kept) == 0.17


def test_a_saved_file_is_undone_and_brought_back(kept: KeptFile[HandFile]) -> None:
    for metres in (0.17, 0.18):
        kept.try_out(HandFile(length_m=metres))
        kept.save()
    seen = [length(kept)]
    for _ in range(2):
        kept.undo()
        seen.append(length(kept))
    assert seen == [0.18, 0.17, 0.18]


def test_what_cannot_be_done_says_so(kept: KeptFile[HandFile]) -> None:
    with pytest.raises(ConfigError, match=r"hand\.json: nothing new to save"):
        kept.save()
    with pytest.raises(ConfigError, match=r"hand\.json: there is no former one"):
        kept.undo()
    kept.path.write_text("{")
    with pytest.raises(CalibrationError, match="not JSON"):
        _ = kept.content


def test_a_folder_that_is_gone_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be written"):
        KeptFile(tmp_path / "gone" / "hand.json", HandFile).try_out(HandFile())
