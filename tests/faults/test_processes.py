"""Processes that are killed or stand still, and networks that are cut: the hand comes back, and nobody else notices.

The long rounds: `make faults`.
"""

from __future__ import annotations

import asyncio
import json
import random
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from played_rig import HAND, PATIENCE_S, PROCESSES, SERVICES, PlayedRig
from wall_clock import figures_in_time

pytestmark = [pytest.mark.integration, pytest.mark.real_time]

BACK_S = 3.0
"""After the cause's end."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """One fault.

    Attributes:
        what: happened.
        back_s: from the cause's end until both cameras and the measured hand were there again.
        again_s: of a kill, the same from the moment in which the supervisor started the process again.
    """

    what: str
    back_s: float
    again_s: float = 0.0


async def kill(rig: PlayedRig, name: str) -> Verdict:
    before = rig.pids()
    begun_s = time.time()
    rig.signal(name, signal.SIGKILL)
    async with asyncio.timeout(PATIENCE_S):
        while rig.pids().get(name, before[name]) == before[name]:
            await asyncio.sleep(0.01)
    again_s = time.time()
    # Nothing of the killed process is under way any more when its successor begins.
    back_s = await rig.watch.until_back(again_s)
    await check(rig, name, before, begun_s, restarted={name})
    return Verdict(f"kill {name}", back_s - begun_s, back_s - again_s)


async def stand_still(rig: PlayedRig, name: str, seconds: float) -> Verdict:
    before = rig.pids()
    begun_s = time.time()
    rig.signal(name, signal.SIGSTOP)
    await asyncio.sleep(seconds)
    ended_s = time.time()
    rig.signal(name, signal.SIGCONT)
    back_s = await rig.watch.until_back(ended_s) - ended_s
    await check(rig, name, before, begun_s, restarted=set())
    return Verdict(f"stop {name} {seconds:.1f} s", back_s)


async def cut(rig: PlayedRig, name: str, seconds: float) -> Verdict:
    before = rig.pids()
    begun_s = time.time()
    rig.links[name].cut()
    await asyncio.sleep(seconds)
    ended_s = time.time()
    rig.links[name].mend()
    back_s = await rig.watch.until_back(ended_s) - ended_s
    await check(rig, name, before, begun_s, restarted=set())
    return Verdict(f"cut {name} {seconds:.1f} s", back_s)


async def check(rig: PlayedRig, name: str, before: dict[str, int], begun_s: float, restarted: set[str]) -> None:
    """Nobody else was started again, the session goes on, nothing of before comes late, other streams never paused."""
    changed = {one for one, pid in rig.pids().items() if pid != before[one]}
    assert changed == restarted, rig.logs()
    async with asyncio.timeout(PATIENCE_S):
        while not await rig.all_run("faults"):
            await asyncio.sleep(0.05)
    hands = rig.watch.since(HAND, begun_s)
    times = [one.t_s for one in hands]
    assert times == sorted(times), f"{name}: hands of before came after newer ones"


def report(verdicts: list[Verdict], file: Path) -> None:
    """Write all verdicts, and judge the slowest."""
    file.write_text(json.dumps([[one.what, round(one.back_s, 3), round(one.again_s, 3)] for one in verdicts]))
    late = [one for one in verdicts if one.back_s > BACK_S]
    figures_in_time({f"{one.what}: back after {one.back_s:.2f} s": one.back_s / BACK_S for one in late})


async def test_a_fault_of_each_kind(rig: PlayedRig, tmp_path: Path) -> None:
    verdicts = [await kill(rig, "ik"), await stand_still(rig, "fusion", 1.0), await cut(rig, "capture left", 1.0)]
    report(verdicts, tmp_path / "faults.json")


@pytest.mark.faults
@pytest.mark.parametrize("name", PROCESSES)
async def test_kills(rig: PlayedRig, rounds: int, name: str, tmp_path: Path) -> None:
    verdicts = []
    for _ in range(rounds):
        verdicts.append(await kill(rig, name))
        # A service counts as proven after so long; one that crashes at once, again and again, is given up.
        await asyncio.sleep(5.0)
    report(verdicts, tmp_path / "kills.json")


@pytest.mark.faults
@pytest.mark.parametrize("name", PROCESSES)
async def test_stops(rig: PlayedRig, rounds: int, name: str, tmp_path: Path) -> None:
    chance = random.Random(name)
    verdicts = [await stand_still(rig, name, chance.uniform(0.2, 5.0)) for _ in range(rounds)]
    report(verdicts, tmp_path / "stops.json")


@pytest.mark.faults
async def test_partitions(rig: PlayedRig, rounds: int, tmp_path: Path) -> None:
    chance = random.Random(1)
    verdicts = [await cut(rig, chance.choice(SERVICES), chance.uniform(1.0, 10.0)) for _ in range(rounds)]
    report(verdicts, tmp_path / "partitions.json")
