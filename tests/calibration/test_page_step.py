"""The base of the page's steps: trying, saving and undoing a file, and work that can be stopped."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from rhot.calibration_step import StepContext, StepView
from rhot.errors import CalibrationError, ConfigError
from rhot.rig import BusConfig, HandFile
from rhot_calibration.page_step import PageStep


class Step(PageStep[HandFile]):
    def __init__(self, folder: Path) -> None:
        super().__init__(StepContext(folder, BusConfig()), folder / "hand.json", HandFile)
        self.begun = asyncio.Event()

    def find(self, length_m: float) -> None:
        self._found = HandFile(length_m=length_m)

    def view(self) -> StepView:
        standing = self._standing(("none", False), "on trial", lambda stored: (f"{stored.length_m} m", True))
        return self._view(standing, actions={"stop"} if self._can_stop else set())

    async def work(self, seconds: float) -> str | None:
        async def do() -> str:
            self.begun.set()
            await asyncio.sleep(seconds)
            return "done"

        with self._busy("working"):
            return await self._stoppable(do())

    async def fail(self) -> None:
        async def do() -> None:
            raise CalibrationError("refused")

        with self._busy("working"):
            await self._stoppable(do())

    def stop(self) -> None:
        self._stop()


async def test_what_is_found_is_tried_saved_and_undone(tmp_path: Path) -> None:
    step = Step(tmp_path)
    assert (step.view().state, step.view().done, step.view().enabled) == ("none", False, frozenset())
    await step.press("try", {})
    assert step.view().state == "none", "nothing was found yet"
    step.find(0.18)
    assert step.view().enabled == {"try"}
    await step.press("try", {})
    assert (step.view().state, step.view().done) == ("on trial", False)
    assert step.view().enabled == {"try", "save", "undo"}
    await step.press("save", {})
    assert (step.view().state, step.view().done) == ("0.18 m", True)
    step.find(0.19)
    await step.press("try", {})
    await step.press("undo", {})
    assert step.view().state == "0.18 m"
    with pytest.raises(ConfigError, match="nothing new to save"):
        await step.press("save", {})


async def test_a_file_that_is_not_valid_is_said_and_not_done(tmp_path: Path) -> None:
    (tmp_path / "hand.json").write_text("{")
    view = Step(tmp_path).view()
    assert "hand.json" in view.state
    assert not view.done


async def test_work_is_shown_and_stopped(tmp_path: Path) -> None:
    step = Step(tmp_path)
    step.find(0.18)
    working = asyncio.create_task(step.work(60.0))
    await step.begun.wait()
    view = step.view()
    assert (view.state, view.done, view.enabled) == ("working", False, frozenset({"stop"}))
    step.stop()
    assert await working is None
    assert (step.view().state, step.view().enabled) == ("none", frozenset({"try"}))
    assert await step.work(0.0) == "done"


async def test_a_refusal_reaches_the_page_and_leaves_the_step_ready(tmp_path: Path) -> None:
    step = Step(tmp_path)
    with pytest.raises(CalibrationError, match="refused"):
        await step.fail()
    assert (step.view().state, step.view().enabled) == ("none", frozenset())


async def test_work_ends_with_whoever_waits_for_it(tmp_path: Path) -> None:
    step = Step(tmp_path)
    working = asyncio.create_task(step.work(60.0))
    await step.begun.wait()
    working.cancel()
    with pytest.raises(asyncio.CancelledError):
        await working
    assert step.view().state == "none"
