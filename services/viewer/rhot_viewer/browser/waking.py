"""A fault of viser, mended: its senders are woken from whatever thread changes the page.

`asyncio.Event.set` goes through those who wait, and belongs to the event loop's thread ("Not thread-safe" in Python's
documentation). viser 1.1 calls it in ours, too, so that it fails with "deque mutated during iteration" when a sender
begins or ends to wait at that moment. By then the message is in its queue; only the senders are still to be woken.
"""

from __future__ import annotations

import functools

from viser.infra._async_message_buffer import AsyncMessageBuffer
from viser.infra._messages import Message


def wake_senders_safely() -> None:
    """Make each page of this process wake viser's senders on their own thread when that failed on ours."""
    real = AsyncMessageBuffer.push
    if hasattr(real, "__wrapped__"):
        return

    @functools.wraps(real)
    def push(self: AsyncMessageBuffer, message: Message) -> None:
        try:
            real(self, message)
        except RuntimeError as error:
            if "mutated during iteration" not in str(error):
                raise
            # Cleared first: an event that counts as set wakes nobody.
            self.event_loop.call_soon_threadsafe(_wake, self)

    AsyncMessageBuffer.push = push  # type: ignore[method-assign]


def _wake(buffer: AsyncMessageBuffer) -> None:
    buffer.message_event.clear()
    buffer.message_event.set()
