from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from bus_watch import PATIENCE_S, settled
from touched.take import take, touch_rig

from rhot.bus import Bus
from rhot.calibration_step import StepContext
from rhot.errors import BusError, CalibrationError
from rhot.messages import HandPose, ObjectPose
from rhot.rig import BusConfig
from rhot_calibration.objects.page_step import ObjectStep

VALUES = {"object": "cube", "marker": "index"}


async def test_touches_on_the_running_rig_can_be_tried_and_saved(router: BusConfig, tmp_path: Path) -> None:
    rig = touch_rig(tmp_path / "rig")
    step = ObjectStep(StepContext(rig.path, router))
    async with await Bus.open(router) as bus, await Bus.open(router) as reader:
        hands = bus.publisher("rhot/hand/right", HandPose, reliable=True)
        objects = bus.publisher("rhot/object/cube", ObjectPose, reliable=True)
        started = asyncio.create_task(step.press("touch", VALUES))
        async with asyncio.timeout(PATIENCE_S):
            while not (await hands.wait_for_reader(0.1) and await objects.wait_for_reader(0.1)):
                pass
            # The step hears two keys: neither may run ahead of the other, nor the session of its readers.
            heard = aiter(reader.events("rhot/*/*"))
            await settled(reader)
            for _, message in take(rig.path, rig, 56.0):
                if isinstance(message, HandPose):
                    hands.put(message)
                elif isinstance(message, ObjectPose):
                    objects.put(message)
                await anext(heard)
                if started.done():
                    break
            if "solve" in step.view().enabled:
                await step.press("solve", VALUES)
            await started
    view = step.view()
    assert "try" in view.enabled
    assert len(view.tables[0].rows) > 15
    assert any("mm RMS over" in remark.text for remark in view.remarks)
    await step.press("try", VALUES)
    assert "T_tracker_object" in (rig.path / "registration.simulated.json").read_text()
    assert "cube" in (rig.path / "registration.simulated.json").read_text()


async def test_ended_without_a_touch_it_says_what_to_do(router: BusConfig, tmp_path: Path) -> None:
    step = ObjectStep(StepContext(touch_rig(tmp_path / "rig").path, router))
    started = asyncio.create_task(step.press("touch", VALUES))
    async with asyncio.timeout(PATIENCE_S):
        while not any("nothing on rhot/hand/right yet" in remark.text for remark in step.view().remarks):
            await asyncio.sleep(0.02)
        await step.press("take", VALUES)
        assert any("not taken: the finger is not tracked" in remark.text for remark in step.view().remarks)
        await step.press("solve", VALUES)
        with pytest.raises(CalibrationError, match="touch top or bottom"):
            await started


async def test_silence_says_which_service_is_missing(
    router: BusConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rhot_calibration.objects.page_step._PATIENCE_S", 0.3)
    step = ObjectStep(StepContext(touch_rig(tmp_path / "rig").path, router))
    with pytest.raises(BusError, match=r"rhot/hand/right .* `rhot ik` running"):
        await step.press("touch", VALUES)
