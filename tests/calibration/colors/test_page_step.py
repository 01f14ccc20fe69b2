"""The page's colour step, click by click, on drawn pictures."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bus_watch import settled, until

from rhot.bus import Answer, Bus, Request
from rhot.calibration_step import StepContext
from rhot.errors import BusError, CalibrationError
from rhot.rig import BusConfig
from rhot.rig.colors import load_colors
from rhot_calibration.colors.page_step import ColorStep

SIZE = (400, 300)
MARKERS = ("thumb", "index", "middle", "ring", "little", "base")


@pytest.fixture
def drawn(scene: Any, shape: Any) -> Any:
    """A picture with every marker."""
    shapes = [
        shape(name, 45 + 60 * index, 120 + 40 * (index % 2), kind="rectangle" if name == "base" else "ellipse")
        for index, name in enumerate(MARKERS)
    ]
    return scene(shapes, size=SIZE, noise=2.0)


@contextlib.asynccontextmanager
async def answering(router: BusConfig, image: Any) -> AsyncIterator[None]:
    """A camera that shows one picture."""
    async with await Bus.open(router) as bus:
        coded = bytes(cv2.imencode(".png", image)[1])

        def answer(request: Request) -> Answer:
            return Answer(coded, "image/png")

        bus.queryable("rhot/preview/left", answer)
        await settled(bus)
        yield


async def test_who_looks_at_another_step_while_colours_are_learnt_finds_them_learnt_afterwards(
    router: BusConfig, drawn: Any, write_rig: Callable[..., Path]
) -> None:
    step = ColorStep(StepContext(write_rig({"left": "width = 400\nheight = 300"}), router))
    async with answering(router, drawn.image):
        await step.press("take", {})
    for name in MARKERS:
        u, v, _ = drawn.truth[name]
        await step.point("left", u, v, {"marker": name})
    leaving = asyncio.create_task(step.follow())
    await until(lambda: step.view().state == "learning the colours")
    leaving.cancel()
    await asyncio.gather(leaving, return_exceptions=True)
    assert "try" not in step.view().enabled
    back = asyncio.create_task(step.follow())
    await until(lambda: "try" in step.view().enabled)
    back.cancel()
    await asyncio.gather(back, return_exceptions=True)


async def test_clicks_become_colours_that_can_be_tried_saved_and_undone(
    router: BusConfig, drawn: Any, write_rig: Callable[..., Path]
) -> None:
    rig = write_rig({"left": "width = 400\nheight = 300"})
    step = ColorStep(StepContext(rig, router))
    assert step.view().state == "no colours yet"
    following = asyncio.create_task(step.follow())
    async with answering(router, drawn.image):
        with pytest.raises(CalibrationError, match="take pictures first"):
            await step.point("left", 10.0, 10.0, {"marker": "thumb"})
        await step.press("take", {})
    assert list(step.view().held) == ["left"]
    for name in MARKERS:
        values = step.view().values
        assert values == {"marker": name}, "the next marker is chosen at once, also while colours are learnt"
        u, v, _ = drawn.truth[name]
        await step.point("left", u, v, values)
    await until(lambda: "try" in step.view().enabled)
    view = step.view()
    assert [row[0] for row in view.tables[0].rows] == list(MARKERS)
    assert all(row[1] == "1 of 1" for row in view.tables[0].rows)
    assert all(remark.tone != "wrong" for remark in view.remarks)
    mask = cv2.imdecode(np.frombuffer(list(view.pictures.values())[1], np.uint8), cv2.IMREAD_COLOR)
    u, v, _ = drawn.truth["little"]
    assert mask is not None
    assert mask[round(v), round(u)].max() > 3 * mask[20, 200].max(), "the colours take in the marker and not the cloth"

    assert not (rig / "colors.json").exists()
    await step.press("try", {})
    assert set(load_colors(rig / "colors.json").markers) == set(MARKERS)
    assert step.view().held == {}, "the live pictures show how the colours do"
    await step.press("undo", {})
    assert not (rig / "colors.json").exists()
    assert list(step.view().held) == ["left"]
    await step.press("try", {})
    await step.press("save", {})
    assert step.view().done
    following.cancel()


async def test_wrong_clicks_are_answered_and_taken_back(
    router: BusConfig, scene: Any, shape: Any, paints: Any, write_rig: Callable[..., Path]
) -> None:
    twins = [shape("thumb", 100, 150), shape("index", 250, 150, paint=paints["thumb"])]
    drawn = scene(twins, size=SIZE, noise=2.0)
    step = ColorStep(StepContext(write_rig({"left": "width = 400\nheight = 300"}), router))
    following = asyncio.create_task(step.follow())
    async with answering(router, drawn.image):
        await step.press("take", {})
    await step.point("left", 100.0, 150.0, {"marker": "thumb"})
    await step.point("left", 250.0, 150.0, {"marker": "index"})
    await until(lambda: "try" in step.view().enabled)
    said = " ".join(remark.text for remark in step.view().remarks if remark.tone == "warning")
    assert "thumb" in said
    assert "index" in said
    assert "mixed up" in said
    await step.point("left", 20.0, 20.0, {"marker": "index"})
    await until(lambda: any(remark.tone == "wrong" for remark in step.view().remarks))
    assert "index" in step.view().remarks[0].text
    assert "try" not in step.view().enabled
    for left in (["thumb", "index"], ["thumb"]):
        await step.press("unclick", {})  # first the place that was clicked before, then none
        await until(lambda: "try" in step.view().enabled)
        assert [row[0] for row in step.view().tables[0].rows] == left
    following.cancel()


async def test_a_camera_that_is_not_there_is_named(router: BusConfig, write_rig: Callable[..., Path]) -> None:
    step = ColorStep(StepContext(write_rig({"left": ""}), router))
    with pytest.raises(BusError, match="camera left: no capture service answers"):
        await step.press("take", {})
    assert step.view().state == "no colours yet"
