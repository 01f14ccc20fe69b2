"""What the filters were last told by each camera, kept for explanations."""

from __future__ import annotations

from dataclasses import dataclass

from rhot_fusion.views.sightings import BoolArray, FloatArray, IndexArray


@dataclass(frozen=True, slots=True)
class Gates:
    """Observations of N tracked markers in one frame against what was expected.

    Attributes:
        index: (N,) markers.
        times_s: (N,) seconds since the stream's start.
        y: (N, 2) innovation, the motion models together, normalised units.
        variance: (N, 2) what is expected of its square.
        held: (N,) the very place of the frame before.
        accepted: (N,) whether the observation moved the marker.
    """

    index: IndexArray
    times_s: FloatArray
    y: FloatArray
    variance: FloatArray
    held: list[bool]
    accepted: BoolArray
