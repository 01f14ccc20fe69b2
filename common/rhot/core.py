"""The seam between a service's core and whatever drives it.

A core turns messages into messages and knows neither bus nor clock, so that the live service, `rhot process` and the
tests run the very same code.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol, TypeVar

from pydantic import BaseModel

from rhot.messages import Message

M_contra = TypeVar("M_contra", bound=Message, contravariant=True)
C_contra = TypeVar("C_contra", bound=BaseModel, contravariant=True)

Output = tuple[str, Message]
"""A key (`rhot/points`, …) and the message to publish on it."""


class Core(Protocol[M_contra, C_contra]):
    """The core of a service: its configuration can change while it runs, and it counts what it met."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Events since it was made, by name."""
        ...

    @property
    def figures(self) -> Mapping[str, float]:
        """Figures for the status, such as residuals, by name."""
        ...

    @property
    def problem(self) -> str:
        """What is wrong with the rig as a whole, one sentence; empty when nothing is."""
        ...

    def configure(self, config: C_contra) -> None:
        """Take a new configuration; a ConfigError refuses it."""
        ...

    def feed(self, message: M_contra) -> list[Output]:
        """Take one message in order of arrival and return what follows from it; empty when nothing does."""
        ...
