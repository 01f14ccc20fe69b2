"""The form of an explanation: tables, and outlines over a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

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
