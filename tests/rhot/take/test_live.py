"""`rhot.connect`: hands of a running rig, by a loop of either kind, and what is said where there is none."""

from __future__ import annotations

import asyncio
import itertools
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hand_messages import hand_pose, point_set
from running.live_rig import START_NS, publish, publishing

import rhot
from rhot.bus import Bus
from rhot.errors import BusError, ConfigError
from rhot.messages import HandPose, PointSet
from rhot.rig import BusConfig


def test_ten_lines_without_an_event_loop(endpoint: str) -> None:
    with publishing(endpoint), rhot.connect(endpoint) as rig:
        seen = list(itertools.islice(rig.hands("right"), 3))
        points = next(iter(rig.points()))
    assert [hand.side for hand in seen] == ["right"] * 3
    assert seen[0].t_ns < seen[1].t_ns < seen[2].t_ns
    hand = seen[0]
    truth = hand_pose(1e-9 * (hand.t_ns - START_NS), hand.t_ns)
    np.testing.assert_allclose(hand.joint("index_tip"), truth.joints["index_tip"].position)
    np.testing.assert_allclose(hand.positions[5], truth.joints[hand.joint_names[5]].position)
    assert hand.angles[hand.angle_names.index("little_pip_flexion")] == truth.angles["little"].pip_flexion
    assert hand.landmarks21().shape == (21, 3)
    assert np.isnan(hand.sigma).all(), "this rig states none"
    assert points.points.keys() == {"index", "thumb"}


async def test_the_same_with_an_event_loop(router: BusConfig) -> None:
    stop = asyncio.Event()
    task = asyncio.create_task(publish(router, stop))
    async with rhot.connect(router.connect[0]) as rig:
        seen = []
        async for hand in rig.hands("right"):
            seen.append(hand.t_ns)
            if len(seen) == 3:
                break
    stop.set()
    await task
    assert seen == sorted(set(seen))


async def test_a_slow_reader_gets_the_newest(router: BusConfig) -> None:
    """Fifty hands arrive while nobody reads; that they have is known from points that were sent after them."""
    last_ns = START_NS + 50_000_000

    def read_slowly(ready: threading.Event, sent: threading.Event) -> int:
        with rhot.connect(router.connect[0]) as rig:
            hands, points = iter(rig.hands("right")), iter(rig.points())
            next(hands)
            next(points)
            ready.set()
            assert sent.wait(30.0)
            while next(points).t_ns != last_ns:
                pass
            return next(hands).t_ns

    ready, sent = threading.Event(), threading.Event()
    reading = asyncio.create_task(asyncio.to_thread(read_slowly, ready, sent))
    async with await Bus.open(router) as bus:
        hands, points = bus.publisher("rhot/hand/right", HandPose), bus.publisher("rhot/points", PointSet)
        while not ready.is_set() and not reading.done():
            hands.put(hand_pose(0.0, START_NS))
            points.put(point_set(START_NS))
            await asyncio.sleep(0.02)
        for step in range(1, 51):
            hands.put(hand_pose(0.0, START_NS + step * 1_000_000))
        points.put(point_set(last_ns))
        sent.set()
        assert await reading == last_ns


def test_the_reader_in_the_readme_prints_poses(endpoint: str) -> None:
    text = (Path(__file__).parents[3] / "README.md").read_text(encoding="utf-8")
    source = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[0]
    assert "tcp/127.0.0.1:7447" in source
    program = source.replace("tcp/127.0.0.1:7447", endpoint)
    with publishing(endpoint):
        reader = subprocess.Popen([sys.executable, "-u", "-c", program], stdout=subprocess.PIPE, text=True)
        try:
            assert reader.stdout is not None
            assert re.fullmatch(r"\[[-0-9. e]+\] measured\n", reader.stdout.readline())
        finally:
            reader.kill()
            reader.wait()


def test_no_rig_is_one_clear_error(endpoint: str) -> None:
    with pytest.raises(BusError, match="no Zenoh router answers"), rhot.connect(endpoint, timeout_s=0.3):
        pass


def test_what_is_not_connected_or_no_key_says_so() -> None:
    rig = rhot.connect()
    with pytest.raises(BusError, match=r"use `with rhot\.connect"):
        _ = rig.bus
    with pytest.raises(ConfigError, match="rhot/nothing: no key with messages"):
        rig.messages("rhot/nothing")


def test_what_can_never_come_is_not_waited_for() -> None:
    rig = rhot.connect("tcp/127.0.0.1:1")
    with pytest.raises(ValueError, match="'middle': choose left or right"):
        rig.hands("middle")
    with pytest.raises(ValueError, match=r"'\*': one name, as in rig\.toml"):
        rig.objects("*")
    with pytest.raises(BusError, match=r"use `with rhot\.connect"):
        next(iter(rig.hands("right")))


def test_ctrl_c_ends_a_loop_that_waits(router: BusConfig, endpoint: str) -> None:
    program = """
import signal, sys, rhot
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    with rhot.connect(sys.argv[1]) as rig:
        stream = iter(rig.hands("left"))
        print("waiting", flush=True)
        next(stream)
except KeyboardInterrupt:
    print("ended")
"""
    child = subprocess.Popen([sys.executable, "-c", program, endpoint], stdout=subprocess.PIPE, text=True)
    try:
        assert child.stdout is not None
        assert child.stdout.readline() == "waiting\n"
        time.sleep(0.3)
        child.send_signal(signal.SIGINT)
        assert child.communicate(timeout=30.0)[0] == "ended\n"
    finally:
        child.kill()
