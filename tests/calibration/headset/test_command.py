"""`rhot calibrate headset` over a recording of drawn pictures, and its step in the page."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from headset_feet.looked_at import looked_at, views_of
from headset_feet.walked import record_walk

from rhot.calibration_step import StepContext, load_steps
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.rig import BusConfig, HeadsetFile, Rig, load_rig, read_json_model
from rhot.rig.calibration import RigidTransform
from rhot.rig.folder import HEADSET_FILE, write_json_model
from rhot_calibration.headset import command, page_step
from rhot_calibration.headset.command import headset
from rhot_calibration.headset.fit import mounting_error
from rhot_calibration.headset.page_step import HeadsetStep
from rhot_calibration.headset.streams import ViewCollector
from rhot_sim.walker.folder import write_walker_rig
from rhot_sim.walker.world import WalkerWorld

SECONDS = 16.0
RATE_HZ = 5.0


@pytest.fixture
def rig(tmp_path: Path) -> Rig:
    return write_walker_rig(
        tmp_path / "rig", endpoint="tcp/127.0.0.1:7", seed=1, motion="headset", rate_hz=RATE_HZ, imu_rate_hz=20.0
    )


def test_the_page_of_a_rig_without_cameras_has_this_step_alone(rig: Rig) -> None:
    assert not rig.cameras
    steps = load_steps(StepContext(rig.path, BusConfig()))
    assert list(steps) == ["Headset"]
    assert steps["Headset"].view().enabled == {"start"}


def test_a_recording_tells_where_the_camera_sits(rig: Rig, tmp_path: Path) -> None:
    record_walk(rig, tmp_path / "looked", SECONDS, depth=False)
    nowhere = HeadsetFile(date="2026-01-01", T_head_camera=RigidTransform.identity())
    write_json_model(rig.path / HEADSET_FILE, nowhere)
    arguments = [str(tmp_path / "looked"), "--rig", str(rig.path)]
    result = CliRunner().invoke(headset, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    found, true = load_rig(rig.path).T_head_camera, WalkerWorld.from_rig(rig).T_head_camera
    assert found is not None and rig.T_head_camera is not None
    angle_rad, distance_m = mounting_error(found, true)
    typed_rad, typed_m = mounting_error(rig.T_head_camera, true)
    assert np.degrees(angle_rad) < 0.5 < np.degrees(typed_rad)
    assert distance_m < 0.01 < typed_m
    for said in ("residual", "pitch", "at a foot", "the camera's pose so far was", "written: "):
        assert said in result.output
    assert read_json_model(rig.path / "headset.previous.json", HeadsetFile).date == "2026-01-01"


def test_a_dry_run_writes_nothing(rig: Rig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def views_recorded(path: Path, collector: ViewCollector) -> None:
        collector.camera = looked_at(1)[1]
        collector.views += views_of(1)

    monkeypatch.setattr(command, "views_recorded", views_recorded)
    arguments = [str(tmp_path), "--rig", str(rig.path), "--dry-run"]
    result = CliRunner().invoke(headset, arguments, catch_exceptions=False)
    assert "nothing was written" in result.output and load_rig(rig.path).headset is None


def test_a_rig_that_falls_silent_does_not_take_the_views_with_it(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = [0, 10, 120]

    async def collect_views(bus: BusConfig, collector: ViewCollector, **_: object) -> None:
        collector.camera = looked_at(1)[1]
        if count := counts.pop(0):
            collector.views += views_of(1, count)
        raise BusError("the feet's camera sends no pictures")

    monkeypatch.setattr(command, "collect_views", collect_views)
    arguments = ["--live", "--rig", str(rig.path)]
    with pytest.raises(BusError, match="sends no pictures"):
        CliRunner().invoke(headset, arguments, catch_exceptions=False)
    with pytest.raises(CalibrationError, match="40 are the least"):
        CliRunner().invoke(headset, arguments, catch_exceptions=False)
    result = CliRunner().invoke(headset, arguments, catch_exceptions=False)
    assert "ended with 114 views: the feet's camera sends no pictures" in result.stderr
    assert load_rig(rig.path).headset is not None


def test_what_cannot_be_is_said(rig: Rig, tmp_path: Path) -> None:
    for arguments, message in (
        ([], "give a folder of `rhot record --frames`, or --live"),
        ([str(tmp_path)], "holds no camera"),
        ([str(tmp_path), "--marker", "77"], "has the markers 0 to 31"),
    ):
        with pytest.raises(ConfigError, match=message):
            CliRunner().invoke(headset, [*arguments, "--rig", str(rig.path)], catch_exceptions=False)


async def test_the_page_looks_fits_tries_and_undoes(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    counts = [10, 120]

    async def collect(
        config: BusConfig,
        collector: ViewCollector,
        *,
        patience_s: float,
        taken: Callable[[], None],
        hint: Callable[[str], None],
    ) -> None:
        collector.camera = looked_at(1)[1]
        collector.views += views_of(1, counts.pop(0))
        hint(collector.hint)
        await asyncio.Event().wait()

    monkeypatch.setattr(page_step, "collect_views", collect)
    step = HeadsetStep(StepContext(rig.path, BusConfig()))
    assert step.view().state == "as typed into rig.toml" and step.view().enabled == {"start"}
    values = {field.name: field.value for field in step.fields}
    assert values == {"marker": "0", "size_mm": "60"}

    async def look() -> None:
        looking = asyncio.create_task(step.press("start", values))
        async with asyncio.timeout(60.0):
            while "views taken" not in "".join(remark.text for remark in step.view().remarks) or not step.view().share:
                await asyncio.sleep(0.001)
        assert "solve" in step.view().enabled
        await step.press("solve", values)
        await looking

    with pytest.raises(CalibrationError, match="views of marker 0; 40 are the least"):
        await look()
    await look()
    assert step.view().enabled == {"start", "try"}
    await step.press("try", values)
    assert load_rig(rig.path).headset is not None and step.view().state == "a new pose on trial"
    await step.press("save", values)
    assert step.view().done
    assert [row[0] for row in step.view().tables[0].rows][:2] == ["residual", "position"]
    with pytest.raises(ConfigError, match="write its number"):
        await step.press("start", {**values, "marker": "x"})


def test_a_rig_of_hands_has_nothing_to_do(rig_folder: Path) -> None:
    step = HeadsetStep(StepContext(rig_folder, BusConfig()))
    assert step.view().done and not step.fields and not step.view().enabled
