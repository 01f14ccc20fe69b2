"""A power cut between any two system calls of a save leaves the old file or the new one."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from machine.power_cut import cut_everywhere

from rhot.errors import ConfigError
from rhot.rig import HandFile
from rhot.rig.folder import load_config, read_json_model, write_json_model
from rhot.rig.kept_file import KeptFile
from rhot.rig.toml_edit import change_rig_file

FORMER, SAVED, TRIED = (HandFile(length_m=metres) for metres in (0.17, 0.18, 0.19))


def found(folder: Path) -> HandFile | None:
    file = folder / "hand.json"
    return read_json_model(file, HandFile) if file.exists() else None


def test_a_rig_file_that_is_changed(rig_folder: Path, tmp_path: Path) -> None:
    text = (rig_folder / "rig.toml").read_bytes()

    def make(folder: Path) -> Callable[[], None]:
        (folder / "rig.toml").write_bytes(text)
        return lambda: change_rig_file(folder, {("cameras", "left"): {"gain": 8.0}})

    before = load_config(rig_folder).cameras["left"].gain
    cuts = 0
    (cut_folders := tmp_path / "cuts").mkdir()
    for folder, where, ended in cut_everywhere(make, cut_folders):
        cuts += 1
        gain = load_config(folder).cameras["left"].gain
        assert gain in ((8.0,) if ended else (before, 8.0)), where
        change_rig_file(folder, {("cameras", "left"): {"gain": 9.0}})
        assert load_config(folder).cameras["left"].gain == 9.0, where
    assert cuts > 20


@pytest.mark.parametrize("had_one", [True, False])
def test_a_calibration_that_is_tried_saved_and_undone(tmp_path: Path, had_one: bool) -> None:
    def prepared(folder: Path) -> KeptFile[HandFile]:
        kept = KeptFile(folder / "hand.json", HandFile)
        if had_one:
            write_json_model(kept.path, FORMER)
        return kept

    def trying(folder: Path) -> Callable[[], None]:
        kept = prepared(folder)
        return lambda: kept.try_out(SAVED)

    def saving(folder: Path) -> Callable[[], None]:
        kept = prepared(folder)
        kept.try_out(SAVED)
        return kept.save

    def undoing(folder: Path) -> Callable[[], None]:
        kept = prepared(folder)
        kept.try_out(SAVED)
        return kept.undo

    former = FORMER if had_one else None
    for number, (make, outcomes, at_the_end) in enumerate(
        ((trying, (former, SAVED), SAVED), (saving, (SAVED,), SAVED), (undoing, (SAVED, former), former))
    ):
        (tmp_path / str(number)).mkdir()
        for folder, where, ended in cut_everywhere(make, tmp_path / str(number)):
            left = found(folder)
            assert left == at_the_end if ended else left in outcomes, where
            again = KeptFile(folder / "hand.json", HandFile)
            if again.can_undo:
                again.undo()
                assert again.content in (former, SAVED), where


def test_an_undone_saving_can_be_brought_back_after_any_cut(tmp_path: Path) -> None:
    def make(folder: Path) -> Callable[[], None]:
        kept = KeptFile(folder / "hand.json", HandFile)
        for content in (FORMER, SAVED):
            kept.try_out(content)
            kept.save()
        return kept.undo

    for folder, where, ended in cut_everywhere(make, tmp_path):
        left = found(folder)
        assert left == FORMER if ended else left in (FORMER, SAVED), where
        again = KeptFile(folder / "hand.json", HandFile)
        assert again.can_undo, where
        again.undo()
        assert found(folder) == (SAVED if left == FORMER else FORMER), f"{where}: what was undone is lost"


def test_two_programs_that_change_a_rig_lose_nothing(rig_folder: Path) -> None:
    lost: list[str] = []
    both = threading.Barrier(2)

    def change(camera: str) -> None:
        both.wait()
        for step in range(15):
            change_rig_file(rig_folder, {("cameras", camera): {"gain": 1.0 + step}})
            gain = tomllib.loads((rig_folder / "rig.toml").read_text())["cameras"][camera]["gain"]
            if gain != 1.0 + step:
                lost.append(f"{camera}: {gain} in place of {1.0 + step}")

    threads = [threading.Thread(target=change, args=(camera,)) for camera in ("left", "right")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert lost == []


def test_a_lock_that_is_never_given_back_is_named(rig_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rhot import atomic_file

    monkeypatch.setattr(atomic_file, "_LOCK_LIMIT_S", 0.05)
    with (
        atomic_file.locked(rig_folder),
        pytest.raises(ConfigError, match="another program has been changing it"),
    ):
        change_rig_file(rig_folder, {("cameras", "left"): {"gain": 2.0}})
