"""Small plots as SVG, for reports that are one file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np

from rhot.arrays import FloatArray

WIDTH: Final = 760
HEIGHT: Final = 260
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 12, 28, 40
_LEGEND_X = 380
COLORS: Final = ("#1b6ca8", "#c8553d", "#588157", "#8e5ea2", "#b8860b", "#444444")


def line_plot(title: str, x_label: str, y_label: str, lines: Mapping[str, tuple[FloatArray, FloatArray]]) -> str:
    """Return lines in one frame; a line breaks where a value is not finite.

    Args:
        title: above the plot.
        x_label, y_label: of the axes, with units.
        lines: name to x (N,) and y (N,).
    """
    xs = _finite([x for x, _ in lines.values()])
    ys = _finite([y for _, y in lines.values()])
    if not xs.size or not ys.size:
        return _frame(title, x_label, y_label, (0.0, 1.0), (0.0, 1.0), ["<text x='60' y='120'>no data</text>"])
    x_range, y_range = (float(xs.min()), float(xs.max())), (0.0, float(ys.max()) * 1.05 or 1.0)
    parts = []
    for index, (name, (x, y)) in enumerate(lines.items()):
        color = COLORS[index % len(COLORS)]
        for stretch in _stretches(y):
            points = " ".join(
                f"{_x(a, x_range):.1f},{_y(b, y_range):.1f}" for a, b in zip(x[stretch], y[stretch], strict=True)
            )
            parts.append(f"<polyline fill='none' stroke='{color}' stroke-width='1.3' points='{points}'/>")
        at = _LEGEND_X + index * min(62.0, (WIDTH - _LEGEND_X) / len(lines))
        parts.append(f"<text x='{at:.1f}' y='18' fill='{color}'>{escape(name)}</text>")
    return _frame(title, x_label, y_label, x_range, y_range, parts)


def histogram(title: str, x_label: str, values: FloatArray) -> str:
    """Return the distribution of finite values; the last half percent is counted in the last bar."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return _frame(title, x_label, "share", (0.0, 1.0), (0.0, 1.0), ["<text x='60' y='120'>no data</text>"])
    top = float(np.percentile(finite, 99.5)) or 1.0
    counts, edges = np.histogram(np.minimum(finite, top), 60, (0.0, top))
    shares = counts / finite.size
    x_range, y_range = (0.0, top), (0.0, float(shares.max()) * 1.05)
    parts = []
    for share, low, high in zip(shares, edges[:-1], edges[1:], strict=True):
        left, right, up, down = _x(low, x_range), _x(high, x_range), _y(share, y_range), _y(0.0, y_range)
        parts.append(
            f"<rect x='{left:.1f}' y='{up:.1f}' width='{max(right - left - 0.6, 0.4):.1f}' "
            f"height='{max(down - up, 0.0):.1f}' fill='{COLORS[0]}'/>"
        )
    for text, share in (("median", 50.0), ("p95", 95.0)):
        at = _x(min(float(np.percentile(finite, share)), top), x_range)
        parts.append(f"<line x1='{at:.1f}' x2='{at:.1f}' y1='{_TOP}' y2='{HEIGHT - _BOTTOM}' stroke='{COLORS[1]}'/>")
        parts.append(f"<text x='{at + 3:.1f}' y='{_TOP + 12}' fill='{COLORS[1]}'>{text}</text>")
    return _frame(title, x_label, "share", x_range, y_range, parts)


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar.

    Attributes:
        value: its height.
        low, high: ends of its whisker; NaN = none.
    """

    value: float
    low: float = float("nan")
    high: float = float("nan")


def bar_plot(title: str, y_label: str, groups: Mapping[str, Mapping[str, Bar]]) -> str:
    """Return groups of bars with whiskers.

    Args:
        title: above the plot.
        y_label: of the axis, with its unit.
        groups: name below a group to its bars by series; a series keeps its colour.
    """
    series = list(dict.fromkeys(name for bars in groups.values() for name in bars))
    ends = [end for bars in groups.values() for bar in bars.values() for end in (bar.value, bar.high)]
    tops = [end for end in ends if np.isfinite(end)]
    if not tops:
        return _frame(title, "", y_label, (0.0, 1.0), (0.0, 1.0), ["<text x='60' y='120'>no data</text>"])
    y_range = (0.0, max(tops) * 1.05 or 1.0)
    x_range = (0.0, float(len(groups)))
    width = 0.8 / len(series)
    parts = []
    for number, (name, bars) in enumerate(groups.items()):
        middle = _x(number + 0.5, x_range)
        parts.append(f"<text x='{middle:.1f}' y='{HEIGHT - _BOTTOM + 15}' text-anchor='middle'>{escape(name)}</text>")
        for one, bar in bars.items():
            if not np.isfinite(bar.value):
                continue
            begin = number + 0.1 + width * series.index(one)
            left, right, up, down = (
                _x(begin, x_range),
                _x(begin + width, x_range),
                _y(bar.value, y_range),
                _y(0.0, y_range),
            )
            parts.append(
                f"<rect x='{left + 0.5:.1f}' y='{up:.1f}' width='{right - left - 1.0:.1f}' height='{down - up:.1f}' "
                f"fill='{COLORS[series.index(one) % len(COLORS)]}'/>"
            )
            if np.isfinite(bar.low) and np.isfinite(bar.high):
                at, top, foot = 0.5 * (left + right), _y(bar.high, y_range), _y(max(bar.low, 0.0), y_range)
                parts.append(f"<path d='M{at:.1f} {top:.1f}V{foot:.1f}' stroke='#222' stroke-width='1.2'/>")
                parts += [f"<path d='M{at - 3:.1f} {end:.1f}h6' stroke='#222'/>" for end in (top, foot)]
    for index, name in enumerate(series):
        at = _LEGEND_X + index * min(90.0, (WIDTH - _LEGEND_X) / len(series))
        parts.append(f"<text x='{at:.1f}' y='18' fill='{COLORS[index % len(COLORS)]}'>{escape(name)}</text>")
    return _frame(title, "", y_label, x_range, y_range, parts, x_ticks=False)


def _frame(
    title: str,
    x_label: str,
    y_label: str,
    x_range: tuple[float, float],
    y_range: tuple[float, float],
    parts: Sequence[str],
    *,
    x_ticks: bool = True,
) -> str:
    bottom, right = HEIGHT - _BOTTOM, WIDTH - _RIGHT
    ticks = []
    for value in _ticks(*x_range) if x_ticks else ():
        at = _x(value, x_range)
        ticks.append(f"<line x1='{at:.1f}' x2='{at:.1f}' y1='{_TOP}' y2='{bottom}' stroke='#eee'/>")
        ticks.append(f"<text x='{at:.1f}' y='{bottom + 15}' text-anchor='middle'>{value:g}</text>")
    for value in _ticks(*y_range):
        at = _y(value, y_range)
        ticks.append(f"<line x1='{_LEFT}' x2='{right}' y1='{at:.1f}' y2='{at:.1f}' stroke='#eee'/>")
        ticks.append(f"<text x='{_LEFT - 6}' y='{at + 4:.1f}' text-anchor='end'>{value:g}</text>")
    middle_y = (_TOP + bottom) / 2
    return (
        f"<svg viewBox='0 0 {WIDTH} {HEIGHT}' width='{WIDTH}' height='{HEIGHT}' role='img' "
        f"xmlns='http://www.w3.org/2000/svg' font-family='sans-serif' font-size='11'><title>{escape(title)}</title>"
        f"<rect width='{WIDTH}' height='{HEIGHT}' fill='white'/>{''.join(ticks)}{''.join(parts)}"
        f"<rect x='{_LEFT}' y='{_TOP}' width='{right - _LEFT}' height='{bottom - _TOP}' fill='none' stroke='#888'/>"
        f"<text x='{_LEFT}' y='18' font-size='13' font-weight='bold'>{escape(title)}</text>"
        f"<text x='{(_LEFT + right) / 2}' y='{HEIGHT - 6}' text-anchor='middle'>{escape(x_label)}</text>"
        f"<text x='14' y='{middle_y}' text-anchor='middle' transform='rotate(-90 14 {middle_y})'>{escape(y_label)}"
        "</text></svg>"
    )


def _ticks(low: float, high: float) -> list[float]:
    """Return about six round values between two."""
    span = max(high - low, 1e-12)
    rough = span / 6.0
    power = 10.0 ** np.floor(np.log10(rough))
    step = float(power * min((1.0, 2.0, 5.0, 10.0), key=lambda factor: abs(factor * power - rough)))
    first = np.ceil(low / step - 1e-9)
    # Adding 0 turns −0 into 0.
    return [float(round(k * step, 12)) + 0.0 for k in np.arange(first, np.floor(high / step + 1e-9) + 1)]


def _x(value: float, limits: tuple[float, float]) -> float:
    return _LEFT + (value - limits[0]) / max(limits[1] - limits[0], 1e-12) * (WIDTH - _LEFT - _RIGHT)


def _y(value: float, limits: tuple[float, float]) -> float:
    return HEIGHT - _BOTTOM - (value - limits[0]) / max(limits[1] - limits[0], 1e-12) * (HEIGHT - _TOP - _BOTTOM)


def _finite(arrays: Sequence[FloatArray]) -> FloatArray:
    joined = np.concatenate(arrays) if arrays else np.empty(0)
    return joined[np.isfinite(joined)]


def _stretches(y: FloatArray) -> list[slice]:
    """Return the stretches of finite values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], np.isfinite(y).astype(np.int8), [0]])))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
