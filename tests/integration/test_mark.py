"""Marked moments: from a trigger to the recording, on rig time."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from click.testing import CliRunner
from running.rig_processes import Processes

import rhot
from rhot.bus import Bus
from rhot.cli import main
from rhot.messages import Event, decode, encode, encoding_of
from rhot.operation.control import EventPublisher, quickest_exchange
from rhot.recording.mcap.writer import McapWriter
from rhot_sim.rig.folder import write_simulated_rig
from rhot_sim.running.processes import free_endpoint

pytestmark = pytest.mark.integration


@pytest.fixture
async def rig(tmp_path: Path):  # type: ignore[no-untyped-def]
    """Router and fusion, which has the rig clock."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    rig = write_simulated_rig(tmp_path / "rig", endpoint=endpoint)
    processes = Processes(rig.path, tmp_path)
    try:
        for name in ("router", "fusion"):
            await processes.start(name)
        yield rig
    finally:
        await processes.supervisor.stop()


@pytest.mark.real_time
async def test_a_trigger_is_recorded_within_a_millisecond_of_when_it_came(rig, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    """Twenty triggers of a device, whose own time is known, through the bus into a file and back out of it."""
    client = rig.config.bus.model_copy(update={"mode": "client", "listen": ()})
    async with await Bus.open(client, timeout_s=20.0) as bus:
        await quickest_exchange(bus, 20.0)
        heard = bus.events("rhot/event")
        published, truth = EventPublisher(bus), []
        for number in range(20):
            truth.append(time.time_ns())
            await asyncio.sleep(0.005 * (number % 3))  # the program is late
            await published.put(f"trigger {number}", "device", at_ns=truth[-1])
        events = []
        async for sample in heard:
            events.append(decode(sample.payload, Event))
            if len(events) == len(truth):
                break
    file = tmp_path / "take.mcap"
    with McapWriter(file, now_ns=0) as mcap:
        for event in events:
            mcap.write("rhot/event", encoding_of(Event), encode(event), event.t_ns, event.seq, event.t_ns)
    found = rhot.load(file).events
    assert [event.label for event in found] == [f"trigger {number}" for number in range(20)]
    # Rig time is the clock of fusion's machine, which is this one.
    off_s = [1e-9 * abs(event.t_ns - t_ns) for event, t_ns in zip(found, truth, strict=True)]
    assert all(event.uncertainty_s is not None for event in found)
    stated_s = [event.uncertainty_s or 0.0 for event in found]
    assert all(off <= stated + 1e-6 for off, stated in zip(off_s, stated_s, strict=True))
    assert max(off_s) < 1e-3
    assert max(stated_s) < 0.05


async def test_lines_mark_when_they_arrive_and_a_label_when_the_command_began(rig) -> None:  # type: ignore[no-untyped-def]
    client = rig.config.bus.model_copy(update={"mode": "client", "listen": ()})
    command = [sys.executable, "-m", "rhot", "mark", "--rig", str(rig.path)]
    async with await Bus.open(client, timeout_s=20.0) as bus:
        await quickest_exchange(bus, 20.0)
        heard = bus.events("rhot/event")

        def types() -> None:
            with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as typed:
                assert typed.stdin is not None
                assert typed.stdout is not None
                for line in ("rest", "grasp", ""):
                    typed.stdin.write(line + "\n")
                    typed.stdin.flush()
                    typed.stdout.readline()
                typed.stdin.close()
            begun.append(time.time_ns())
            subprocess.run([*command, "end"], check=True, capture_output=True)

        begun: list[int] = []
        await asyncio.to_thread(types)
        events: list[Event] = []
        async for sample in heard:
            events.append(decode(sample.payload, Event))
            if len(events) == 4:
                break
    assert [event.label for event in events] == ["rest", "grasp", "grasp", "end"]
    assert -0.02 < 1e-9 * (events[3].t_ns - begun[0]) < 0.15, "not after all its modules were loaded"
    assert events[0].source == "mark"


def test_a_mark_without_words_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["mark", " ", "--rig", str(tmp_path)])
    assert (result.exit_code, result.output.count("\n")) == (2, 1)
    assert 'LABEL is empty: say what happened, such as "trial 3"' in result.output


_STIMULI = """
import json, sys, time
import pylsl
outlet = pylsl.StreamOutlet(pylsl.StreamInfo("Stimuli", "Markers", 1, 0.0, "string", "rhot-test"))
ours = pylsl.StreamOutlet(pylsl.StreamInfo("rhot_event", "Markers", 1, 0.0, "string", "rhot-bridge"))
assert outlet.wait_for_consumers(30.0), "nobody listens"
sent = {}
for number in range(10):
    before_ns = time.time_ns()
    stamp_s, after_ns = pylsl.local_clock(), time.time_ns()
    time.sleep(0.02)  # it sends later than it stamps
    outlet.push_sample([f"flash {number}"], stamp_s)
    ours.push_sample(["an echo"], stamp_s)
    sent[f"flash {number}"] = (before_ns + after_ns) // 2
time.sleep(2.0)
print(json.dumps(sent))
"""


@pytest.mark.real_time
async def test_triggers_of_an_lsl_stream_are_marked_when_they_were_stamped(rig, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    pytest.importorskip("pylsl", reason="needs the extra `lsl`")
    # Ask this machine alone, port by port: multicast is for real networks.
    (tmp_path / "lsl.cfg").write_text("[multicast]\nResolveScope = machine\n[lab]\nKnownPeers = {127.0.0.1}\n")
    environment = {**os.environ, "LSLAPICFG": str(tmp_path / "lsl.cfg")}
    client = rig.config.bus.model_copy(update={"mode": "client", "listen": ()})
    command = [sys.executable, "-m", "rhot", "mark", "--lsl", "all", "--rig", str(rig.path)]
    async with await Bus.open(client, timeout_s=20.0) as bus:
        await quickest_exchange(bus, 20.0)
        heard, events = bus.events("rhot/event"), []
        following = await asyncio.create_subprocess_exec(*command, stdout=subprocess.DEVNULL, env=environment)
        try:
            async with asyncio.timeout(60.0):
                stimuli = await asyncio.create_subprocess_exec(
                    sys.executable, "-c", _STIMULI, stdout=subprocess.PIPE, env=environment
                )
                out, _ = await stimuli.communicate()
                sent = json.loads(out)
                async for sample in heard:
                    events.append(decode(sample.payload, Event))
                    if len(events) == len(sent):
                        break
        finally:
            following.send_signal(signal.SIGINT)
            async with asyncio.timeout(5.0):
                assert await following.wait() == 130
    assert [event.label for event in events] == list(sent)
    assert {event.source for event in events} == {"lsl"}
    off_s = [1e-9 * abs(event.t_ns - sent[event.label]) for event in events]
    assert sorted(off_s)[-2] < 1e-3, "one reading of the clocks may be interrupted"
