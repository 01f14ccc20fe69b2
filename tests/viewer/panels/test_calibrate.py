"""The tab that leads through the calibration: a fault of one step is told, and costs nobody the page."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rhot.calibration_step import StepContext
from rhot.errors import BusError
from rhot.rig import BusConfig, load_rig
from rhot_viewer.browser.page import Page
from rhot_viewer.browser.rig_scene import RigScene
from rhot_viewer.panels.calibrate import CalibratePanel
from rhot_viewer.rig.picture_feed import PictureFeed


async def looked_at() -> None:
    """Somebody looks."""


def panel_with(step: object, rig_folder: Path) -> tuple[CalibratePanel, Any]:
    scene = SimpleNamespace(on_picture_click=lambda _: None)
    panel = CalibratePanel(
        cast(Page, SimpleNamespace(looked_at=looked_at)),
        cast(RigScene, scene),
        cast(PictureFeed, None),
        StepContext(rig_folder, BusConfig()),
        load_rig(rig_folder).config,
    )
    parts = SimpleNamespace(step=step, problem="")
    panel._steps = {"colours": cast(Any, parts)}
    panel._current = "colours"
    return panel, parts


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (BusError("no router answers"), lambda text: text == "no router answers"),
        (IndexError("7 of 6"), lambda text: "IndexError: 7 of 6; this is a fault of the program" in text),
    ],
)
async def test_a_step_that_fails_while_it_looks_says_so(
    error: Exception, said: Callable[[str], bool], rig_folder: Path
) -> None:
    async def follow() -> None:
        raise error

    panel, parts = panel_with(SimpleNamespace(follow=follow), rig_folder)
    following = asyncio.create_task(panel._follow())
    async with asyncio.timeout(20.0):
        while not parts.problem:
            await asyncio.sleep(0.01)
    assert said(parts.problem)
    assert not following.done()
    following.cancel()
    await asyncio.gather(following, return_exceptions=True)
