"""VRChat's trackers, received by python-osc's own server over loopback."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from bridged import poses as bridge_poses
from bridged.readers import read_vrchat
from pythonosc.dispatcher import Dispatcher
from pythonosc.osc_server import ThreadingOSCUDPServer

from rhot.geometry.rotations import quaternion_from_rotation, rotation_x, rotation_y, rotation_z
from rhot_bridge.axes import Converter
from rhot_bridge.links import UdpLink
from rhot_bridge.scene import Body, Scene
from rhot_bridge.targets.vrchat import VrChatTarget

LIMIT_S = 30.0


class Received:
    """What a server has been told."""

    def __init__(self) -> None:
        self.values: dict[str, tuple[Any, ...]] = {}
        self.wanted = 0
        self.complete = threading.Event()

    def take(self, address: str, *values: Any) -> None:
        self.values[address] = values
        if len(self.values) >= self.wanted:
            self.complete.set()


@contextmanager
def server() -> Iterator[tuple[int, Received]]:
    received = Received()
    dispatcher = Dispatcher()
    dispatcher.set_default_handler(received.take)
    with ThreadingOSCUDPServer(("127.0.0.1", 0), dispatcher) as running:
        thread = threading.Thread(target=running.serve_forever, args=(0.02,))
        thread.start()
        try:
            yield running.server_address[1], received
        finally:
            running.shutdown()
            thread.join()


def person() -> Scene:
    """A person who looks to the right, whose left toes point up and whose right foot leans on its outer edge."""
    hips = Body(
        1, "measured", 1.0, np.array([[0.0, 0.95, 0.1]]), quaternion_from_rotation(rotation_y(-0.5))[None], ("hips",)
    )
    return Scene(
        "stage",
        1,
        head=bridge_poses.thing((0.0, 1.6, 0.0), rotation_y(np.radians(-90.0))),
        feet={
            "left": bridge_poses.thing((-0.15, 0.1, -0.2), rotation_x(np.radians(30.0))),
            "right": bridge_poses.thing((0.15, 0.1, -0.2), rotation_z(np.radians(-20.0))),
        },
        body=hips,
    )


async def test_trackers_come_in_unitys_axes_with_unitys_angles() -> None:
    scene = Converter("unity", np.eye(4)).scene(person())
    with server() as (port, received):
        received.wanted = 8
        link = UdpLink("127.0.0.1", port)
        await link.open()
        link.send(VrChatTarget().frame(scene, 0))
        assert received.complete.wait(LIMIT_S)
        await link.close()
    at = "/tracking/trackers"
    values = received.values
    assert all(isinstance(value, float) for each in values.values() for value in each)
    assert values[f"{at}/1/position"] == pytest.approx((0.0, 0.95, -0.1))
    assert values[f"{at}/2/position"] == pytest.approx((-0.15, 0.1, 0.2))
    assert values[f"{at}/3/position"] == pytest.approx((0.15, 0.1, 0.2))
    assert values[f"{at}/head/position"] == pytest.approx((0.0, 1.6, 0.0))
    # Unity's angles are positive clockwise, seen along the axis: a look to the right turns +90° about y, toes that
    # point up turn −30° about x, and a foot that leans to its right −20° about z.
    assert values[f"{at}/head/rotation"] == pytest.approx((0.0, 90.0, 0.0), abs=1e-3)
    assert values[f"{at}/2/rotation"] == pytest.approx((-30.0, 0.0, 0.0), abs=1e-3)
    assert values[f"{at}/3/rotation"] == pytest.approx((0.0, 0.0, -20.0), abs=1e-3)


@pytest.mark.parametrize("seed", range(5))
def test_rotations_are_applied_z_then_x_then_y(seed: int) -> None:
    x, y, z = np.random.default_rng(seed).uniform(-1.4, 1.4, 3)
    R = rotation_y(y) @ rotation_z(z) @ rotation_x(x)
    scene = Scene("stage", 1, head=bridge_poses.thing((0.0, 1.6, 0.0), R))
    seen = read_vrchat(VrChatTarget().frame(Converter("unity", np.eye(4)).scene(scene), 0))
    assert np.allclose(seen.rotations["head"], R, atol=1e-5)


def test_the_heads_rotation_goes_out_only_when_the_head_appears() -> None:
    target, scene = VrChatTarget(), Converter("unity", np.eye(4)).scene(person())
    turns = ["head" in read_vrchat(target.frame(scene, round(at_s * 1e9))).rotations for at_s in (0.0, 0.9, 1.1, 9.0)]
    assert turns == [True, True, False, False]
    assert target.frame(Scene("unity"), 10_000_000_000) == []
    assert "head" in read_vrchat(target.frame(scene, 11_000_000_000)).rotations
