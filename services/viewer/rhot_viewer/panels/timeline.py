"""The last two minutes: rate, latency, losses and error, a line per service."""

from __future__ import annotations

from typing import Final

import numpy as np
import viser
from viser import uplot

from rhot_viewer.rig.history import SECONDS, Chart, History

_CHARTS: Final = {
    "rate": "messages per second",
    "latency": "latency p99, ms",
    "lost": "lost per second (late, missed, invalid, overwritten)",
    "error": "error, mm",
}
_COLORS: Final = ("#4dabf7", "#ffa94d", "#69db7c", "#f783ac", "#b197fc", "#ffe066", "#63e6be", "#ff8787", "#ced4da")
_AXIS: Final = uplot.Axis(stroke="#adb5bd", grid={"stroke": "#373a40"}, ticks={"stroke": "#373a40"})
_NOTHING: Final = "nothing yet"


class TimelinePanel:
    """Four charts."""

    title = "Timeline"

    def __init__(self, history: History) -> None:
        self._history = history
        self._plots: dict[str, viser.GuiUplotHandle] = {}
        self._drawn: dict[str, tuple[str, ...]] = {}
        self._colors: dict[str, str] = {}

    def build(self, gui: viser.GuiApi) -> None:
        """Add the charts, empty."""
        for kind, title in _CHARTS.items():
            data, names = self._data(self._history.chart(kind))
            self._drawn[kind] = names
            height_px = 190
            self._plots[kind] = gui.add_uplot(
                data,
                self._series(names),
                title=title,
                height=height_px,
                axes=(_AXIS, _AXIS),
                scales={"x": uplot.Scale(time=False, range=(-float(SECONDS), 0.0))},
                legend=uplot.Legend(show=True, live=False),
            )

    def update(self) -> None:
        """Draw what has been added."""
        for kind, plot in self._plots.items():
            data, names = self._data(self._history.chart(kind))
            if names != self._drawn[kind]:
                self._drawn[kind] = names
                plot.series = self._series(names)
            plot.data = data

    def _data(
        self, chart: Chart
    ) -> tuple[tuple[np.ndarray[tuple[int, ...], np.dtype[np.float64]], ...], tuple[str, ...]]:
        rows = chart.rows or {_NOTHING: np.zeros(len(chart.x_s))}
        return (chart.x_s, *rows.values()), tuple(rows)

    def _series(self, names: tuple[str, ...]) -> tuple[uplot.Series, ...]:
        for name in names:
            self._colors.setdefault(name, _COLORS[len(self._colors) % len(_COLORS)])
        lines = [
            uplot.Series(label=name, stroke=self._colors[name], width=1.5, points={"show": False}) for name in names
        ]
        return (uplot.Series(label="s"), *lines)
