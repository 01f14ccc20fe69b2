"""The page's step for the hand."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from bus_watch import PATIENCE_S, until

from rhot.bus import Bus
from rhot.calibration_step import StepContext
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.messages import PointSet
from rhot.rig import BusConfig, load_rig
from rhot_calibration.hand import page_step, samples
from rhot_calibration.hand.page_step import HandStep
from rhot_calibration.hand.samples import LIVE_S, prompt_at

NOTHING = {"length_mm": "", "width_mm": ""}


async def test_typed_lengths_are_tried_saved_and_undone(rig_folder: Path, router: BusConfig) -> None:
    step = HandStep(StepContext(rig_folder, router))
    for length, width in (("175", ""), ("200,5", "90")):
        await step.press("typed", {"length_mm": length, "width_mm": width})
        await step.press("try", NOTHING)
        await step.press("save", NOTHING)
    assert load_rig(rig_folder).hand.length_m == pytest.approx(0.2005)
    assert step.view().done
    await step.press("undo", NOTHING)
    assert load_rig(rig_folder).hand.length_m == pytest.approx(0.175)


async def test_wrong_lengths_are_refused(rig_folder: Path, router: BusConfig) -> None:
    step = HandStep(StepContext(rig_folder, router))
    for values, words in (
        (NOTHING, "type the length"),
        ({"length_mm": "long", "width_mm": ""}, "length 'long': not a number"),
        ({"length_mm": "1890", "width_mm": ""}, "human hands"),
    ):
        with pytest.raises((ConfigError, CalibrationError), match=words):
            await step.press("typed", values)
    assert "try" not in step.view().enabled


async def test_a_measurement_says_what_to_do_and_can_be_stopped(
    rig_folder: Path, router: BusConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = HandStep(StepContext(rig_folder, router))
    measuring = asyncio.create_task(step.press("measure", NOTHING))
    await until(lambda: "point sets" in step.view().state)
    assert "get ready" in step.view().state
    assert step.view().enabled == {"stop"}
    await step.press("stop", NOTHING)
    await measuring
    assert step.view().enabled == {"measure", "typed"}
    monkeypatch.setattr(page_step, "LIVE_S", 0.2)
    with pytest.raises(BusError, match="is the rig running and started"):
        await step.press("measure", NOTHING)


async def test_what_is_heard_is_measured(rig_folder: Path, router: BusConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Points that come become a refusal in words: a hand cannot be measured by one point set."""
    passed_s = 0.0
    monkeypatch.setattr(samples, "time", SimpleNamespace(monotonic=lambda: passed_s))
    step = HandStep(StepContext(rig_folder, router))
    async with await Bus.open(router) as bus:
        points = bus.publisher("rhot/points", PointSet)
        measuring = asyncio.create_task(step.press("measure", NOTHING))
        assert await points.wait_for_reader(PATIENCE_S)
        points.put(PointSet(t_ns=1, frame="rig", points={}))
        await until(lambda: "(1 point sets)" in step.view().state)
        passed_s = LIVE_S
        with pytest.raises(CalibrationError):
            await measuring
    assert step.view().enabled == {"measure", "typed"}


def test_prompts_follow_each_other() -> None:
    said: list[Callable[[], None] | str] = [prompt_at(t_s)[1] for t_s in (0.0, 5.0, 12.0, LIVE_S - 0.1)]
    assert len(set(said)) == 4
    assert prompt_at(5.0)[0] == pytest.approx(2.0)
