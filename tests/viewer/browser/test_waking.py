from __future__ import annotations

import asyncio

import pytest
from viser.infra._async_message_buffer import AsyncMessageBuffer
from viser.infra._messages import Message

from rhot_viewer.browser.page import wake_senders_safely


class Interrupted(asyncio.Event):
    """Fails as an event does whose waiters change while it is set from another thread, once."""

    failed = False

    def set(self) -> None:
        if not self.failed:
            self.failed = True
            self._value = True
            raise RuntimeError("deque mutated during iteration")
        super().set()


class Note(Message):
    def redundancy_key(self) -> str:
        return "note"

    def entity_state_key(self) -> None:
        return None


async def test_a_sender_wakes_though_waking_it_from_another_thread_failed() -> None:
    wake_senders_safely()
    wake_senders_safely()
    event = Interrupted()
    buffer = AsyncMessageBuffer(asyncio.get_running_loop(), persistent_messages=True, message_event=event)
    waiting = asyncio.create_task(event.wait())
    await asyncio.sleep(0)
    await asyncio.to_thread(buffer.push, Note())
    assert await asyncio.wait_for(waiting, 30.0)
    assert event.failed
    assert len(buffer.message_from_id) == 1


async def test_other_errors_are_told() -> None:
    wake_senders_safely()
    buffer = AsyncMessageBuffer(asyncio.get_running_loop(), persistent_messages=True)
    buffer.message_event.set = lambda: (_ for _ in ()).throw(RuntimeError("something else"))  # type: ignore[method-assign]
    with pytest.raises(RuntimeError, match="something else"):
        buffer.push(Note())
