"""The rig clock is set or drifts while the rig runs."""

from __future__ import annotations

import asyncio
import time

import pytest
from moved_clock import move_clock
from played_rig import CAMERAS, PATIENCE_S, PlayedRig
from wall_clock import in_time

from rhot.operation.control import broadcast

pytestmark = [pytest.mark.integration, pytest.mark.real_time, pytest.mark.faults]

HOUR_S = 3600.0
BACK_S = 3.0


@pytest.mark.parametrize("step_s", [-HOUR_S, HOUR_S, -0.3, 0.3])
async def test_the_hand_is_back_after_the_rig_clock_was_set(rig: PlayedRig, step_s: float) -> None:
    before = rig.pids()
    set_s = time.time()
    move_clock(rig.rig_clock, step_s)
    rig.watch.rig_ahead_s = step_s
    back_s = await rig.watch.until_back(set_s + 0.05) - set_s
    assert rig.pids() == before, rig.logs()
    # Start and stop are still heard, and a hand comes after them.
    await broadcast(rig.bus, "stop", "", 0.0, PATIENCE_S)
    await broadcast(rig.bus, "start", "after", 0.3, PATIENCE_S)
    async with asyncio.timeout(PATIENCE_S):
        while not await rig.all_run("after"):
            await asyncio.sleep(0.05)
    await rig.watch.until_back(time.time())
    in_time(back_s, BACK_S, "the hand after the step")


async def test_a_rig_clock_that_drifts_is_followed(rig: PlayedRig) -> None:
    """100 ppm: more than a quartz drifts, as a clock that NTP slews does."""
    begun_s = time.time()
    move_clock(rig.rig_clock, 0.0, 100.0)
    await asyncio.sleep(15.0)
    rig.watch.rig_ahead_s = 100e-6 * (time.time() - begun_s)
    for camera in CAMERAS:
        status = await rig.status(f"capture/{camera}")
        assert status.clock_uncertainty_s is not None
        # The figure compares with this machine's own clock, which the rig clock has left by now.
        error_s = status.figures["clock_error_s"] - 100e-6 * (status.t_ns / 1e9 - begun_s)
        assert abs(error_s) <= status.clock_uncertainty_s + 50e-6
    await rig.watch.until_back(time.time())
