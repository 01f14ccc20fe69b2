"""LSL: what LabRecorder's own library records and pyxdf reads, on the rig's times to a millisecond."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from bridged import poses as bridge_poses
from bus_watch import PATIENCE_S

from rhot.anatomy.skeleton import JOINTS
from rhot.bus import Bus
from rhot.clock import LocalRigClock, SystemClock, difference_ns
from rhot.messages import Control, Event, HandPose, ObjectPose, Space
from rhot.rig import BridgeConfig, BusConfig
from rhot.service.clock_sync import serve_clock
from rhot_bridge.clock_map import STEP_NS, TIME_CONSTANT_NS, ClockMap
from rhot_bridge.scene import Body, Thing, tracked
from rhot_bridge.targets.lsl import channels_of, joints_of, sample_of

_LOOPBACK = "[multicast]\nResolveScope = machine\n[lab]\nKnownPeers = {127.0.0.1}\n[log]\nlevel = -2\n"
"""Ask this machine alone, port by port: multicast is for real networks."""
_RATE_HZ = 50.0
_DELAY_NS = 80_000_000
"""The rig publishes what was true so long ago: the stamps must not be those of sending."""

_RECORD = """
import json, sys, time
import labrecorder, pylsl
wanted, seconds, out = set(json.loads(sys.argv[1])), float(sys.argv[2]), sys.argv[3]
deadline = time.monotonic() + 60.0
while True:
    found = {info.name(): info for info in pylsl.resolve_streams(2.0)}
    if wanted <= found.keys():
        break
    assert time.monotonic() < deadline, f"only {sorted(found)}"
recording = labrecorder.Recording(out, [found[name] for name in sorted(wanted)])
time.sleep(seconds)
recording.stop()
"""


class TestClockMap:
    """The smoothed offset between the rig clock and LSL's."""

    def test_the_first_reading_is_believed_and_a_set_clock_too(self) -> None:
        clocks = ClockMap()
        assert not clocks.ready
        with pytest.raises(ValueError, match="not been read"):
            clocks.to_local_ns(1)
        clocks.read(1_000_000_000, 500, 700)
        assert clocks.to_local_ns(1_000_000_000) == 600
        clocks.read(1_000_000_000 + STEP_NS + 1000, 600, 600)
        assert clocks.to_local_ns(1_000_000_000 + STEP_NS + 1000) == 600

    def test_an_interruption_within_a_reading_moves_no_stamp(self) -> None:
        clocks = ClockMap()
        clocks.read(5_000_000_000, 100, 200)
        # 18 ms pass after the rig clock was read, a second later.
        clocks.read(6_000_000_000, 1_000_000_100, 1_018_000_100)
        assert clocks.to_local_ns(5_000_000_000) == 150

    def test_the_rig_clocks_learning_moves_stamps_smoothly(self) -> None:
        """A jump of 1 ms in the estimate moves no stamp by more than its share, and is followed in the end."""
        clocks, last, largest = ClockMap(), None, 0.0
        for number in range(6000):
            local_ns = number * 10_000_000
            rig_ns = local_ns + 5_000_000_000 + (1_000_000 if number >= 1000 else 0)
            clocks.read(rig_ns, local_ns, local_ns)
            offset = clocks.to_local_ns(0)
            largest = max(largest, abs(offset - (offset if last is None else last)))
            last = offset
        assert largest < 1_000_000 * 1.01 * 10_000_000 / TIME_CONSTANT_NS
        assert last is not None
        assert abs(last + 5_001_000_000) < 10_000

    def test_what_the_rig_clock_was_off_by_at_first_is_gone_within_seconds(self) -> None:
        """A rig clock 1.2 ms off when it joined, which has learnt better 0.3 s later."""
        clocks = ClockMap()
        for number in range(300):
            local_ns = number * 10_000_000
            clocks.read(local_ns + (0 if number < 30 else 1_200_000), local_ns, local_ns)
        assert abs(clocks.to_local_ns(0) + 1_200_000) < 150_000


def test_a_sample_is_position_and_quaternion_w_first() -> None:
    thing = Thing(1, "predicted", 1.0, np.array([[1.0, 2.0, 3.0]]), np.array([[0.1, 0.2, 0.3, 0.9]]))
    np.testing.assert_allclose(sample_of(thing), [1, 2, 3, 0.9, 0.1, 0.2, 0.3, 0.0], rtol=1e-6)
    channels = channels_of("object_cup", ["object_cup"])
    assert [channel.type for channel in channels] == [
        *("PositionX", "PositionY", "PositionZ", "OrientationA", "OrientationB", "OrientationC", "OrientationD"),
        "Confidence",
    ]
    hand = tracked(bridge_poses.hand_message("flat", "left", 1))
    assert len(sample_of(hand)) == len(channels_of("hand_left", JOINTS)) == 26 * 7 + 1


def test_a_bodys_stream_keeps_its_channels_when_an_arm_is_lost() -> None:
    rows = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (2, 1))
    body = Body(1, "measured", 1.0, rows, identity, ("hips", "right_wrist"))
    labels = [channel.label for channel in channels_of("body", joints_of("body", body))]
    sample = dict(zip(labels, sample_of(body).tolist(), strict=True))
    assert (sample["hips_PositionX"], sample["right_wrist_PositionZ"], sample["Confidence"]) == (1.0, 6.0, 1.0)
    assert np.isnan(sample["left_wrist_PositionX"])
    legless = Body(1, "measured", 1.0, rows[:1], identity[:1], ("hips",))
    assert joints_of("body", legless) == joints_of("body", body)


async def test_streams_that_are_silent_make_room_for_others(monkeypatch: pytest.MonkeyPatch) -> None:
    lsl = pytest.importorskip("rhot_bridge.targets.lsl", reason="pip install 'rhot[lsl]'")
    monkeypatch.setattr(lsl, "MOST_STREAMS", 2)
    monkeypatch.setattr("rhot_bridge.output.SILENT_NS", 200_000_000)
    monkeypatch.setattr(lsl, "_outlet", lambda *_: SimpleNamespace(push_sample=lambda *_: None))
    output = lsl.make_output(BridgeConfig(target="lsl"))
    output.use_clock(LocalRigClock(SystemClock()))
    async with asyncio.timeout(PATIENCE_S):
        for number, name in enumerate(("a", "b", "c", "d", "a")):
            thing = Thing(number, "measured", 1.0, np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]))
            while not output.send_sample(f"rhot/object/{name}", thing):
                await asyncio.sleep(0.01)
    assert list(output._outlets) == ["object_d", "object_a"]
    await output.close()


async def test_a_stream_that_cannot_be_opened_is_logged_and_opened_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    lsl = pytest.importorskip("rhot_bridge.targets.lsl", reason="pip install 'rhot[lsl]'")
    outlets: list[Any] = [RuntimeError("could not create stream outlet.")]

    def outlet(*_: object) -> Any:
        if outlets:
            raise outlets.pop()
        return SimpleNamespace(push_sample=lambda *_: None)

    monkeypatch.setattr(lsl, "_outlet", outlet)
    monkeypatch.setattr(lsl, "_RETRY_S", 0.01)
    output = lsl.make_output(BridgeConfig(target="lsl"))
    output.use_clock(LocalRigClock(SystemClock()))
    thing = Thing(1, "measured", 1.0, np.zeros((1, 3)), np.array([[0.0, 0.0, 0.0, 1.0]]))
    async with asyncio.timeout(PATIENCE_S):
        while not output.send_sample("rhot/object/cup", thing):
            await asyncio.sleep(0.01)
    await output.close()
    assert "LSL stream object_cup cannot be opened: could not create stream outlet." in caplog.text


@pytest.mark.integration
async def test_labrecorder_records_it_on_the_rigs_times(router: BusConfig, tmp_path: Path) -> None:
    pytest.importorskip("pylsl", reason="pip install 'rhot[lsl]'")
    for module in ("labrecorder", "pyxdf"):
        pytest.importorskip(module, reason=f"pip install {module}; there is no wheel for every machine")
    (tmp_path / "lsl.cfg").write_text(_LOOPBACK)
    environment = {**os.environ, "LSLAPICFG": str(tmp_path / "lsl.cfg"), "OPENBLAS_NUM_THREADS": "1"}
    names = ["rhot_event", "rhot_hand_left", "rhot_hand_right", "rhot_object_cube"]
    out = tmp_path / "take.xdf"
    sent: dict[int, int] = {}
    async with await Bus.open(router) as bus:
        serve_clock(bus)
        playing = asyncio.create_task(_play(bus, sent))
        command = [
            sys.executable,
            "-m",
            "rhot",
            "bridge",
            "lsl",
            "--rig",
            str(tmp_path),
            "--connect",
            router.connect[0],
        ]
        with (tmp_path / "bridge.log").open("w") as log:
            bridge = await asyncio.create_subprocess_exec(*command, stdout=log, stderr=log, env=environment)
        try:
            record = await asyncio.create_subprocess_exec(
                *(sys.executable, "-c", textwrap.dedent(_RECORD), json.dumps(names), "2.5", str(out)),
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=environment,
            )
            async with asyncio.timeout(PATIENCE_S + 30.0):
                said, _ = await record.communicate()
            assert record.returncode == 0, said.decode() + (tmp_path / "bridge.log").read_text()
        finally:
            playing.cancel()
            bridge.terminate()
            await bridge.wait()
    _check(out, sent)


async def _play(bus: Bus, sent: dict[int, int]) -> None:
    """Publish both hands and an object, each 80 ms after it was true; `sent` gets that moment, monotonic clock."""
    bus.publisher("rhot/space/stage", Space).put(bridge_poses.stage_message(1))
    hands = {side: bus.publisher(f"rhot/hand/{side}", HandPose) for side in ("left", "right")}
    cube = bus.publisher("rhot/object/cube", ObjectPose)
    events = bus.publisher("rhot/event", Event)
    control = bus.publisher("rhot/control", Control, reliable=True)
    assert await control.wait_for_reader(PATIENCE_S)
    now_ns = time.time_ns()
    control.put(Control(t_ns=now_ns, action="start", session="one", start_t_ns=now_ns))
    pose = {side: bridge_poses.hand_message("fist", side, 1) for side in hands}  # type: ignore[arg-type]
    object_ = bridge_poses.object_message(1)
    while True:
        true_ns = time.time_ns() - _DELAY_NS
        for side, publisher in hands.items():
            publisher.put(pose[side].model_copy(update={"t_ns": true_ns}))
        cube.put(object_.model_copy(update={"t_ns": true_ns}))
        events.put(Event(t_ns=true_ns, label="tick", source="test"))
        sent[true_ns] = true_ns + difference_ns(time.monotonic_ns, time.time_ns)
        await asyncio.sleep(1.0 / _RATE_HZ)


def _check(out: Path, sent: dict[int, int]) -> None:
    import pyxdf

    streams, _ = pyxdf.load_xdf(str(out), synchronize_clocks=False, dejitter_timestamps=False)
    found: dict[str, Any] = {stream["info"]["name"][0]: stream for stream in streams}
    assert sorted(found) == ["rhot_event", "rhot_hand_left", "rhot_hand_right", "rhot_object_cube"]
    truth_s = np.array(sorted(sent.values())) / 1e9
    events = found.pop("rhot_event")
    assert events["info"]["type"][0] == "Markers"
    assert {label for (label,) in events["time_series"]} == {"tick"}
    assert np.abs(np.asarray(events["time_stamps"])[:, None] - truth_s).min(axis=1).max() < 1e-3
    for name, stream in found.items():
        info = stream["info"]
        assert info["type"][0] == "MoCap"
        assert float(info["nominal_srate"][0]) == 0.0
        assert info["desc"][0]["setup"][0]["frame"][0] == "stage"
        stamps = np.asarray(stream["time_stamps"])
        # A fifth of what was sent in the time: a machine full of tests leaves the newest alone of what has piled up.
        assert len(stamps) > 0.5 * _RATE_HZ, name
        assert (np.diff(stamps) > 0.0).all(), "no sample twice"
        nearest = np.abs(stamps[:, None] - truth_s[None]).min(axis=1)
        assert nearest.max() < 1e-3, f"{name}: {1e3 * nearest.max():.3f} ms from the rig's times"
        labels = [channel["label"][0] for channel in info["desc"][0]["channels"][0]["channel"]]
        values = dict(zip(labels, np.asarray(stream["time_series"])[-1], strict=True))
        assert values["Confidence"] == 1.0
        if name == "rhot_object_cube":
            position = [values[f"object_cube_Position{axis}"] for axis in "XYZ"]
            np.testing.assert_allclose(position, (0.0, 0.75, -0.6), atol=1e-5)
        else:
            hand = bridge_poses.hand("fist", "left" if name.endswith("left") else "right")
            for row, joint in enumerate(JOINTS):
                position = [values[f"{joint}_Position{axis}"] for axis in "XYZ"]
                np.testing.assert_allclose(position, hand.positions[row], atol=1e-5)
