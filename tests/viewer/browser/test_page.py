"""The page's port, and what of a scene is sent."""

from __future__ import annotations

import asyncio
import socket
import urllib.request
from collections.abc import AsyncIterator

import numpy as np
import pytest
from stub_rig import StubRig
from viser import BatchedMeshHandle

from rhot.errors import DeviceError
from rhot.messages import HandPose
from rhot_viewer.browser.page import Page
from rhot_viewer.browser.rig_scene import InstanceLayer
from rhot_viewer.scene.drawn import hand_shape
from rhot_viewer.scene.instances import balls, unit_ball


@pytest.fixture
async def page() -> AsyncIterator[Page]:
    """A page on any port."""
    opened = Page("127.0.0.1", 0)
    try:
        yield opened
    finally:
        opened.close()


async def test_a_taken_port_is_an_error_that_names_it(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as holder:
        port = holder.getsockname()[1]
        with pytest.raises(DeviceError, match=f"port {port}.*--port"):
            Page("127.0.0.1", port)
    with pytest.raises(DeviceError, match=r"192\.0\.2\.1"):
        Page("192.0.2.1", port)
    assert capsys.readouterr().out == ""


async def test_the_page_needs_nothing_from_elsewhere(page: Page) -> None:
    def fetched() -> str:
        with urllib.request.urlopen(page.url.replace("localhost", "127.0.0.1"), timeout=60.0) as answer:
            return str(answer.read().decode())

    html = await asyncio.to_thread(fetched)
    assert len(html) > 100_000
    assert not any(f'{tag}="http' in html for tag in ("src", "href"))
    assert page.browsers == 0


def handle_of(page: Page, name: str) -> BatchedMeshHandle:
    handle = page.server.scene.get_handle_by_name(name)
    assert isinstance(handle, BatchedMeshHandle)
    return handle


async def test_copies_come_and_go_without_a_new_node(page: Page) -> None:
    layer = InstanceLayer(page.server.scene, "/balls", unit_ball())
    layer.show(None)
    assert page.server.scene.get_handle_by_name("/balls") is None
    three = balls(np.arange(9.0).reshape(3, 3), np.full(3, 0.01), np.full((3, 3), 255))
    layer.show(three)
    handle = handle_of(page, "/balls")
    layer.show(balls(np.ones((1, 3)), np.full(1, 0.02), [(0, 0, 0)]))
    assert handle_of(page, "/balls") is handle
    assert handle.batched_scales is not None
    assert np.count_nonzero(handle.batched_scales.any(axis=1)) == 1, "the others have no size"
    layer.show(None)
    seen = [handle.visible]
    layer.show(three)
    assert [*seen, handle.visible] == [False, True]
    assert handle.batched_positions == pytest.approx(np.arange(9.0).reshape(3, 3))
    layer.show(balls(np.zeros((5, 3)), np.full(5, 0.01), np.zeros((5, 3))))
    assert len(handle_of(page, "/balls").batched_positions) == 5


async def test_a_moving_hand_costs_three_messages_a_frame(page: Page, stub: StubRig) -> None:
    """Where its balls are, where its rods are, how they are turned; sizes and colours stay."""
    layers = [InstanceLayer(page.server.scene, f"/{part}", unit_ball()) for part in ("joints", "bones")]

    def show(t_s: float) -> None:
        pose = stub.messages(t_s, 10**18, 0)["rhot/hand/right"]
        assert isinstance(pose, HandPose)
        shape = hand_shape(pose)
        assert shape is not None
        layers[0].show(shape.joints)
        layers[1].show(shape.bones)

    show(0.5)
    buffer = page.server._websock_server.get_message_buffer()
    before = buffer.message_counter
    for tick in range(1, 11):
        show(0.5 + tick / 60)
    assert buffer.message_counter - before <= 3 * 10 + 5, "a size may cross the step to which it is rounded"
