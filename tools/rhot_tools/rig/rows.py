"""Figures with intervals as rows of a report."""

from __future__ import annotations

import math

from rhot_tools.measures.rows import Row
from rhot_tools.rig.statistics import LEAST_INDEPENDENT, Figure

TOO_FEW = f"fewer than {LEAST_INDEPENDENT:.0f} independent samples tell no interval; measure for longer"


def figure_row(name: str, figure: Figure, unit: str, *, peer: str = "", note: str = "", digits: int = 3) -> Row:
    """Return a row whose note tells the interval and what it rests on."""
    if math.isnan(figure.low):
        told = f"{TOO_FEW} ({figure.samples} samples)"
    else:
        told = (
            f"95 %: {figure.low:.{digits}g} to {figure.high:.{digits}g} {unit}; {figure.samples} samples, "
            f"{figure.independent:.0f} independent"
        )
    return Row(name, figure.value, unit, peer=peer, note=f"{told}. {note}" if note else told)


def truth_row(name: str, figure: Figure, truth: float, unit: str) -> Row:
    """Return how a figure stands to what is true: 1 where the truth lies within its interval, 0 where it does not.

    NaN where no interval could be told.
    """
    told = math.isfinite(figure.low) and math.isfinite(truth)
    note = f"measured {figure.value:.4g} ({figure.low:.4g} to {figure.high:.4g}) {unit}, true {truth:.4g} {unit}"
    return Row(name, float(figure.holds(truth)) if told else float("nan"), least=1.0, note=note)
