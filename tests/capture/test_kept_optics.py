"""Exposure, gain and white balance that outlive a restart."""

from __future__ import annotations

from pathlib import Path

import pytest

from rhot.errors import ConfigError
from rhot.rig.colors import ColorsFile
from rhot.rig.folder import load_config
from rhot_capture.service import KeptOptics
from rhot_capture.settings import CameraSettings


def settings_of(rig: Path) -> CameraSettings:
    """What a service that starts now runs with."""
    return CameraSettings.from_config(load_config(rig).cameras["left"], ColorsFile(markers={}))


def test_what_was_set_is_there_after_a_restart_and_can_be_undone(rig_folder: Path) -> None:
    kept = KeptOptics(rig_folder, "left")
    file = rig_folder / "rig.toml"
    before = file.read_text()
    running = settings_of(rig_folder).changed({"exposure_s": 0.002, "gain": 5.3, "white_balance": [1.2, 2.1]}, 60.0)
    assert kept.state(running).differs
    assert not kept.state(running).can_undo
    kept.save(running)
    assert settings_of(rig_folder).optics == running.optics
    assert not kept.state(running).differs

    file.write_text(file.read_text() + "# written meanwhile\n")
    former = KeptOptics(rig_folder, "left").undo()
    assert former.exposure_s == 0.004
    assert file.read_text() == before + "# written meanwhile\n"
    assert kept.state(running).differs
    kept.undo()
    assert settings_of(rig_folder).optics == running.optics


def test_a_slider_leaves_no_long_numbers(rig_folder: Path) -> None:
    running = settings_of(rig_folder).changed({"exposure_s": 3.3000000000000003 / 1e3, "gain": 0.1 + 4.2}, 60.0)
    kept = KeptOptics(rig_folder, "left")
    kept.save(running)
    text = (rig_folder / "rig.toml").read_text()
    assert "exposure_s = 0.0033\n" in text
    assert "gain = 4.3\n" in text
    assert not kept.state(running).differs


def test_a_picture_is_kept_and_written_only_where_it_was_set(rig_folder: Path) -> None:
    file = rig_folder / "rig.toml"
    file.write_text("\n".join(line for line in file.read_text().splitlines() if not line.startswith("saturation")))
    kept = KeptOptics(rig_folder, "left")
    kept.save(settings_of(rig_folder).changed({"gain": 5.0}, 60.0))
    assert "saturation" not in file.read_text()
    kept.save(settings_of(rig_folder).changed({"saturation": 1.5, "brightness": -0.1}, 60.0))
    assert settings_of(rig_folder).picture == {"saturation": 1.5, "contrast": 1.0, "brightness": -0.1}
    assert kept.undo().saturation == 1.0
    assert settings_of(rig_folder).picture == {"saturation": 1.0, "contrast": 1.0, "brightness": 0.0}


def test_what_cannot_be_kept_says_so(rig_folder: Path) -> None:
    running = settings_of(rig_folder)
    with pytest.raises(ConfigError, match="nothing was saved"):
        KeptOptics(rig_folder, "left").undo()
    with pytest.raises(ConfigError, match="names no camera middle"):
        KeptOptics(rig_folder, "middle").save(running)
