"""The seam between a service's core and whatever drives it.

A core turns messages into messages and knows neither bus nor clock, so that the live service, `rhot process` and the
tests run the very same code.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, TypeVar, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from rhot.messages import Message

# The form of an explanation: tables, and outlines over a picture.

Verdict = Literal["", "accepted", "rejected"]


@dataclass(frozen=True, slots=True)
class ExplanationRow:
    """One row.

    Attributes:
        cells: text of each column; the unit of a number is in the column's name.
        verdict: `accepted` rows are green, `rejected` ones red; empty if neither applies.
    """

    cells: tuple[str, ...]
    verdict: Verdict = ""


@dataclass(frozen=True, slots=True)
class Explanation:
    """One table.

    Attributes:
        title: heading.
        columns: names, with units.
        rows: the rows.
        note: explanation of the columns, one to three sentences.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[ExplanationRow, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Outline:
    """Outline drawn over a picture.

    Attributes:
        points: (N, 2) pixels, of a closed polygon.
        label: text beside it.
        verdict: determines the color.
    """

    points: NDArray[np.float64]
    label: str
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class PictureExplanation:
    """Detection in one picture.

    Attributes:
        jpeg: the picture.
        candidates: blobs considered for each marker; the first column is the marker, the last the verdict.
        outlines: of the candidates.
    """

    jpeg: bytes
    candidates: Explanation
    outlines: tuple[Outline, ...]


@runtime_checkable
class Explaining(Protocol):
    """A stage that can explain its state, without changing it."""

    def explain(self) -> Sequence[Explanation]:
        """Return tables of the state after the last message."""
        ...


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
