"""What a network does that answers nothing at all: no refusal, no reset, only silence."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest
from wall_clock import in_time

from rhot.bus import Bus
from rhot.errors import BusError
from rhot.rig import BusConfig

pytestmark = pytest.mark.real_time


@pytest.fixture
def deaf_port() -> Iterator[int]:
    """A port that answers no SYN: its backlog is full, and Linux drops what comes then (listen(2))."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)
        port = int(listener.getsockname()[1])
        crowd = [socket.socket() for _ in range(3)]
        for one in crowd:
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", port))
        yield port
        for one in crowd:
            one.close()


async def test_a_connection_that_nobody_answers_is_given_up_and_started_over(deaf_port: int) -> None:
    """The kernel repeats a SYN after 1, 3, 7, 15 s: an attempt begun before the network came back may hear it late."""
    begun = time.monotonic()
    with pytest.raises(BusError, match="no Zenoh router answers"):
        await Bus.open(BusConfig(connect=(f"tcp/127.0.0.1:{deaf_port}",)), timeout_s=0.0)
    in_time(time.monotonic() - begun, 2.5, "one attempt")
