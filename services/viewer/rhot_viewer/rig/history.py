"""The last two minutes of every service as rows of figures, for charts."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from rhot.arrays import FloatArray
from rhot.messages import ServiceStatus

SECONDS: Final = 120
_LOST: Final = ("dropped_late", "missed", "invalid", "overwritten", "failed")
"""Counts of lost samples: late, lost by the source, invalid, overwritten unread, failed in processing."""
MOST_ROWS: Final = 64
"""Rows of one chart; any sender may choose names. The row of a stopped service is removed after `SECONDS`."""
OWN_FIGURES: Final = "viewer"
"""Service that the charts omit, because it does not track."""


@dataclass(frozen=True, slots=True)
class Chart:
    """One chart.

    Attributes:
        x_s: (n,) seconds before now, negative.
        rows: (n,) values by name; 0 without a status.
    """

    x_s: FloatArray
    rows: Mapping[str, FloatArray]


def rate_hz(status: ServiceStatus) -> float:
    """Return the messages per second that a service publishes; NaN if unknown."""
    return status.rates.get("output", status.rates.get("frames", float("nan")))


def latency_ms(status: ServiceStatus, percentile: str = "p99") -> float:
    """Return a percentile of the age of a service's output when it is published, milliseconds; NaN if unknown."""
    return 1e3 * status.latency_s.get("output_age", {}).get(percentile, float("nan"))


def lost(status: ServiceStatus) -> int:
    """Return the number of samples lost in a service since it started."""
    return sum(status.counts.get(name, 0) for name in _LOST)


class History:
    """Figures of the last `SECONDS` seconds, one per second."""

    def __init__(self) -> None:
        self._rows: dict[str, dict[str, deque[float]]] = {kind: {} for kind in ("rate", "latency", "lost", "error")}
        self._lost_before: dict[str, int] = {}
        self._count = 0

    def add(self, statuses: Mapping[str, ServiceStatus], errors_mm: Mapping[str, float]) -> None:
        """Add the figures of one second.

        Args:
            statuses: recent statuses by `service/instance`.
            errors_mm: errors by name, millimetres.
        """
        self._count = min(self._count + 1, SECONDS)
        shown = {name: s for name, s in statuses.items() if s.service != OWN_FIGURES}
        self._append("rate", {name: rate_hz(s) for name, s in shown.items()})
        self._append("latency", {name: latency_ms(s) for name, s in shown.items()})
        # A count decreases when a service restarts.
        self._append("lost", {n: max(0, lost(s) - self._lost_before.get(n, lost(s))) for n, s in shown.items()})
        totals = self._lost_before | {name: lost(s) for name, s in shown.items()}
        self._lost_before = {name: total for name, total in totals.items() if name in self._rows["lost"]}
        self._append("error", errors_mm)

    def _append(self, kind: str, values: Mapping[str, float]) -> None:
        rows = self._rows[kind]
        for name in values:
            if name not in rows and len(rows) < MOST_ROWS:
                rows[name] = deque([0.0] * (self._count - 1), maxlen=SECONDS)
        for name, row in rows.items():
            row.append(float(np.nan_to_num(values.get(name, 0.0))))
        for name in [name for name, row in rows.items() if len(row) == SECONDS and name not in values and not any(row)]:
            del rows[name]

    def chart(self, kind: str) -> Chart:
        """Return a chart: `rate` (1/s), `latency` (p99, ms), `lost` (1/s) or `error` (mm)."""
        rows = {name: np.array(row) for name, row in sorted(self._rows[kind].items())}
        return Chart(np.arange(1 - self._count, 1, dtype=np.float64), rows)
