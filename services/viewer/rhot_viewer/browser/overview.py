"""What the page says in words: tables of services and of what went wrong, as HTML that needs nothing from outside."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

from rhot.messages import FootPose, HandPose, ServiceStatus
from rhot_viewer.browser.sentence import sentence_html
from rhot_viewer.rig.inbox import latency_ms, lost, rate_hz

_KEPT: Final = 12
_MOST_SAID: Final = 256
"""Services' words that are remembered; their names are an outsider's choice."""
_SILENT: Final = "no status"
"""Of a service that is alive and has not told of itself lately: it has just come, or the machine is busy."""
_STATE_COLOR: Final = {
    "running": "#2b8a3e",
    "waiting": "#b08900",
    "starting": "#b08900",
    "stopping": "#b08900",
    _SILENT: "#b08900",
}
_GONE_COLOR: Final = "#c92a2a"
_CELL: Final = "padding:0.15em 0.5em 0.15em 0;text-align:{align};white-space:nowrap"


@dataclass(frozen=True, slots=True)
class Problem:
    """Something that went wrong.

    Attributes:
        at: time of day, for people.
        service: who said it.
        text: in its own words.
    """

    at: str
    service: str
    text: str


class Problems:
    """The newest errors and problems, each once until its words change."""

    def __init__(self) -> None:
        self._newest: deque[Problem] = deque(maxlen=_KEPT)
        self._said: dict[tuple[str, str], str] = {}

    def add(self, at: str, statuses: Mapping[str, ServiceStatus]) -> None:
        """Take what services say at a time of day."""
        for name, status in statuses.items():
            for kind, text in (("problem", status.problem), ("error", status.last_error)):
                # Taken out first, so that the first is the one that has been silent longest.
                before = self._said.pop((name, kind), "")
                if text and before != text:
                    self._newest.appendleft(Problem(at, name, text))
                self._said[name, kind] = text
        for forgotten in list(self._said)[: max(0, len(self._said) - _MOST_SAID)]:
            del self._said[forgotten]

    @property
    def newest(self) -> Sequence[Problem]:
        """The newest first."""
        return tuple(self._newest)


def hands_html(hands: Mapping[str, HandPose], waiting_for: str) -> str:
    """Return a line per hand: how it is tracked; without a hand, what is missing."""
    if not hands:
        return f"<div style='{_BOX}'><b>No hand</b><br>{sentence_html(waiting_for)}</div>"
    lines = []
    for side, pose in hands.items():
        residual = sorted(pose.residual.values())
        miss_m = residual[len(residual) // 2] if residual else 0.0
        predicted = [finger for finger, state in pose.fingers.items() if state == "predicted"]
        # Residual beyond which ik does not call a hand measured (`rhot_ik.hand.fit_check`).
        if pose.state == "predicted" and miss_m > 0.015:
            how = "does not fit its markers; *Newest problems* says why"
        elif pose.state == "predicted":
            how = "predicted: no marker of it is seen right now"
        elif predicted:
            how = f"measured; {', '.join(predicted)} predicted"
        else:
            how = "measured, all fingers"
        fit = f", markers fit to {1e3 * miss_m:.1f} mm" if residual else ""
        lines.append(f"<b>{escape(side.capitalize())} hand</b><br>{escape(how)}{fit}")
    return f"<div style='{_BOX}'>{'<br>'.join(lines)}</div>"


_SEEN_BY: Final = {
    "marker": "by its marker",
    "depth": "by its shape in the depth picture",
    "inertial": "by its sensor alone",
    "lost": "not seen",
}


def feet_html(feet: Mapping[str, FootPose], waiting_for: str) -> str:
    """Return a line per foot: what tracks it, and how well its position is known; without one, what is missing."""
    if not feet:
        return f"<div style='{_BOX}'><b>No foot</b><br>{sentence_html(waiting_for)}</div>"
    lines = [
        f"<b>{escape(side.capitalize())} foot</b><br>{pose.state}, {_SEEN_BY[pose.stage]}, known to "
        f"{1e3 * pose.sigma:.0f} mm"
        for side, pose in sorted(feet.items())
    ]
    return f"<div style='{_BOX}'>{'<br>'.join(lines)}</div>"


def services_html(alive: set[str], statuses: Mapping[str, ServiceStatus]) -> str:
    """Return the table of services: state, messages a second, age of what they put out, losses."""
    head = _row(("service", "state", "/s", "p50 ms", "p99 ms", "lost"), bold=True)
    rows = [head]
    for name in sorted(alive | set(statuses)):
        status = statuses.get(name)
        state = "gone" if name not in alive else status.state if status else _SILENT
        color = _STATE_COLOR.get(state, _GONE_COLOR)
        label = f"<span style='color:{color}'>●</span> {escape(state)}"
        if status is None:
            rows.append(_row((escape(name), label, "–", "–", "–", "–")))
            continue
        figures = (rate_hz(status), latency_ms(status, "p50"), latency_ms(status))
        rate, middle, worst = ("–" if math.isnan(value) else f"{value:.1f}" for value in figures)
        rows.append(_row((escape(name), label, rate, middle, worst, str(lost(status)))))
    return f"<div style='{_BOX};overflow-x:auto'><table style='border-collapse:collapse'>{''.join(rows)}</table></div>"


def problems_html(problems: Sequence[Problem]) -> str:
    """Return the newest problems, each with its time and who said it."""
    if not problems:
        return f"<div style='{_BOX}'>None.</div>"
    lines = [
        f"<div style='margin-bottom:0.4em;overflow-wrap:anywhere'><span style='opacity:0.6'>{escape(p.at)}</span> "
        f"<b>{escape(p.service)}</b><br>{sentence_html(p.text)}</div>"
        for p in problems
    ]
    return f"<div style='{_BOX};max-height:16em;overflow-y:auto'>{''.join(lines)}</div>"


_BOX: Final = "padding:0.2em 0.8em;font-size:0.9em;line-height:1.45"


def _row(cells: tuple[str, ...], *, bold: bool = False) -> str:
    tag = "th" if bold else "td"
    done = [
        f"<{tag} style='{_CELL.format(align='left' if index < 2 else 'right')}'>{cell}</{tag}>"
        for index, cell in enumerate(cells)
    ]
    return f"<tr>{''.join(done)}</tr>"
