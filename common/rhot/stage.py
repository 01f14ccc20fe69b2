"""The seam between a service's core and whatever drives it.

A stage turns messages into messages and knows neither bus nor clock, so that the live service, `rhot process` and the
tests run the very same code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

from rhot.messages import Message

MessageIn_contra = TypeVar("MessageIn_contra", bound=Message, contravariant=True)

Output = tuple[str, Message]
"""A key (`rhot/points`, …) and the message to publish on it."""


class Stage(Protocol[MessageIn_contra]):
    """The core of a service."""

    def feed(self, message: MessageIn_contra) -> Sequence[Output]:
        """Take one message in order of arrival and return what follows from it; empty when nothing does."""
        ...
