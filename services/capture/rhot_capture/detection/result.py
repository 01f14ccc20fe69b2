"""Detected markers of a frame, and the decisions behind them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from rhot.arrays import FloatArray
from rhot.geometry.hull import Region
from rhot_capture.detection.blob import Blob
from rhot_capture.detection.candidates import Candidate, Refusal


class Detection(NamedTuple):
    """One marker in one frame; a tuple because it is created in a quarter of the time of a dataclass.

    Attributes:
        u, v: sub-pixel centre of the visible painted area, pixels, pixel centres on integers.
        area: visible painted area, square pixels.
        score: probability that this is the marker and its centre is within a pixel of the truth; see
            `rhot_capture.detection.score`.
        corners: (4, 2) of a patch, pixels, clockwise in the image; None if they were not found.
        blob: its blob.
        skin_side: see `rhot.messages.Marker`; None if the colour of skin is not known.
    """

    u: float
    v: float
    area: float
    score: float
    corners: FloatArray | None
    blob: Blob
    skin_side: tuple[float, float] | None = None

    @property
    def outline(self) -> FloatArray:
        """(n, 2) points of the blob's outline, pixels."""
        return self.blob.rim


class Decisions(NamedTuple):
    """Decisions about the blobs of one frame.

    Attributes:
        looks: label and region of every searched part of the frame.
        judged: marker name, and candidate or refusal, of every blob of a marker's colour in them.
        chosen: the accepted candidate of each marker, with complete evidence.
    """

    looks: Sequence[tuple[int, Region]]
    judged: Sequence[tuple[str, Candidate | Refusal]]
    chosen: Mapping[str, Candidate]
