"""Finger solvers beside the hand's filter, each sample by itself: `[ik] solver = "analytic"` or `"fabrik"`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import Field

from rhot.arrays import FloatArray
from rhot.rig.file_model import FileModel
from rhot_bench.thesis.fabrik import FabrikFingers
from rhot_bench.thesis.options import checked
from rhot_ik.hand.closed_form import AnalyticFingers, FingerGeometry


class _NoOptions(FileModel):
    """The closed form has none."""


class _FabrikOptions(FileModel):
    """Options of the chain solver.

    Attributes:
        tolerance_m: it stops when the marker is this near.
        max_iterations: per finger and sample.
    """

    tolerance_m: Annotated[float, Field(gt=0.0, le=0.1)] = 1e-4
    max_iterations: Annotated[int, Field(ge=1, le=1000)] = 24


class ClosedForm:
    """The closed form of `rhot_ik.hand.closed_form` on every sample."""

    def __init__(self, geometry: FingerGeometry, options: Mapping[str, Any]) -> None:
        checked(_NoOptions, options, "ik")
        self._fingers = AnalyticFingers(geometry)

    def solve(self, targets: FloatArray, start: FloatArray) -> FloatArray:
        """Return angles (5, 4), radians, of marker centres (5, 3), metres, wrist frame; the start is not needed."""
        angles: FloatArray = self._fingers.solve(targets).angles
        return angles


class Fabrik:
    """FABRIK (Aristidou and Lasenby, Graphical Models 73(5), 2011) from the last angles."""

    def __init__(self, geometry: FingerGeometry, options: Mapping[str, Any]) -> None:
        self._options = checked(_FabrikOptions, options, "ik")
        self._fingers = FabrikFingers(geometry)

    def solve(self, targets: FloatArray, start: FloatArray) -> FloatArray:
        """Return angles (5, 4), radians, of marker centres (5, 3), metres, wrist frame, beginning at angles (5, 4)."""
        angles, _ = self._fingers.solve(targets, start, self._options.tolerance_m, self._options.max_iterations)
        return angles
