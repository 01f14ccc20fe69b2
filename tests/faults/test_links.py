"""Slow and lossy links of both cameras: what the hand loses by them, and that it loses no more."""

from __future__ import annotations

import asyncio
import math
import sys
import time
from dataclasses import dataclass

import numpy as np
import pytest
from played_rig import CAMERAS, HAND, Arrival, PlayedRig
from wall_clock import figures_in_time, in_time

pytestmark = [pytest.mark.integration, pytest.mark.real_time]

DELAY_S, JITTER_S = 0.020, 0.005
STALL_SHARE, STALL_S = 0.01, 0.2
COVERAGE = 0.97
GROWTH_S = 0.003
_STRETCH_S = 0.05
"""A moment counts as covered where the hand speaks of one that is no further away: three frames at 60 Hz."""


@dataclass(frozen=True, slots=True)
class Seen:
    """The hand over a stretch of time.

    Attributes:
        coverage: share of the time in which a pose is no further than `_STRETCH_S` away.
        measured: the same for measured ones.
        p50_s: median age of the poses.
        oldest_run: most poses in a row that are older than the stall.
    """

    coverage: float
    measured: float
    p50_s: float
    oldest_run: int


def covered(poses: list[Arrival], begun_s: float, ended_s: float) -> float:
    times = np.array([begun_s, *(one.t_s for one in poses), ended_s])
    gaps = np.diff(np.sort(times))
    return 1.0 - float(np.sum(np.maximum(gaps - _STRETCH_S, 0.0))) / (ended_s - begun_s)


async def look(rig: PlayedRig, seconds: float) -> Seen:
    begun_s = time.time()
    await asyncio.sleep(seconds)
    poses = [one for one in rig.watch.since(HAND, begun_s) if one.t_s >= begun_s]
    ended_s = max(one.t_s for one in poses)
    run = longest = 0
    for one in poses:
        run = run + 1 if one.age_s > STALL_S else 0
        longest = max(longest, run)
    good = [one for one in poses if one.good]
    ages = [one.age_s for one in poses]
    return Seen(covered(poses, begun_s, ended_s), covered(good, begun_s, ended_s), float(np.median(ages)), longest)


async def check_clocks(rig: PlayedRig) -> None:
    for camera in CAMERAS:
        status = await rig.status(f"capture/{camera}")
        assert status.clock_uncertainty_s is not None
        error_s = status.figures["clock_error_s"]
        assert abs(error_s) <= status.clock_uncertainty_s, f"{camera}: off by {error_s:.6f} s"


async def test_after_a_stall_the_newest_comes_and_nothing_old(rig: PlayedRig) -> None:
    """Both cameras' links hold everything for some 300 ms, and then give it at once."""
    begun_s = time.time()
    for camera in CAMERAS:
        rig.links[f"capture {camera}"].cut()
    await asyncio.sleep(0.3)
    for camera in CAMERAS:
        rig.links[f"capture {camera}"].mend()
    await rig.watch.until_back(time.time())
    poses = rig.watch.since(HAND, begun_s)
    times = [one.t_s for one in poses]
    assert times == sorted(times)
    # Each camera holds 20 frames or more by then. One of each may be read before the others are there.
    old = sum(one.age_s > 0.1 for one in poses if one.t_s > begun_s)
    assert old < 20
    in_time(old, 5, "poses that are late", "poses")


@pytest.mark.faults
async def test_delay_and_stalls_on_both_cameras_links(rig: PlayedRig, capsys: pytest.CaptureFixture[str]) -> None:
    seconds = 60.0
    plain = await look(rig, seconds / 2)
    for camera in CAMERAS:
        link = rig.links[f"capture {camera}"]
        link.delay_s, link.jitter_s = DELAY_S, JITTER_S
    await asyncio.sleep(1.0)
    delayed = await look(rig, seconds / 2)
    await check_clocks(rig)
    for camera in CAMERAS:
        rig.links[f"capture {camera}"].stall_share = STALL_SHARE
    stalled = await look(rig, seconds)
    await check_clocks(rig)
    with capsys.disabled():
        sys.stdout.write(f"\nplain {plain}\ndelayed {delayed}\nwith stalls {stalled}\n")
    assert sum(rig.links[f"capture {camera}"].stalls for camera in CAMERAS) > 10
    grown_s = stalled.p50_s - plain.p50_s - DELAY_S
    times = {
        f"coverage {stalled.coverage:.3f}": math.inf if stalled.coverage < COVERAGE else 0.0,
        f"p50 of the age grew by {1e3 * grown_s:.1f} ms more than the delay": grown_s / GROWTH_S,
        f"{stalled.oldest_run} old poses in a row": math.inf if stalled.oldest_run > 2 else 0.0,
    }
    figures_in_time({words: times for words, times in times.items() if not times <= 1.0})
