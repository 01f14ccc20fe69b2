"""The form of an explanation: tables, and outlines over a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Verdict = Literal["", "taken", "refused"]


@dataclass(frozen=True, slots=True)
class ExplanationRow:
    """One row.

    Attributes:
        cells: text of each column; figures carry no unit, the column's name does.
        verdict: whether what the row is about was taken or refused; empty where that is not the question.
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
        note: how to read it, one or two sentences.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[ExplanationRow, ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Outline:
    """Something drawn over a picture.

    Attributes:
        points: (N, 2) pixels, closed.
        label: beside it.
        verdict: whether it was taken.
    """

    points: NDArray[np.float64]
    label: str
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class PictureExplanation:
    """What detection made of one picture.

    Attributes:
        jpeg: the picture.
        candidates: what was looked at for each marker; the first column is the marker, the last the verdict.
        outlines: of the candidates.
    """

    jpeg: bytes
    candidates: Explanation
    outlines: tuple[Outline, ...]


@runtime_checkable
class Explaining(Protocol):
    """A core that shows what it knows; asking changes nothing."""

    def explain(self) -> Sequence[Explanation]:
        """Return what the core knows after the message it was fed last."""
        ...
