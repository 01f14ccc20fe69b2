from __future__ import annotations

from xml.etree import ElementTree

import numpy as np
import pytest

from rhot.report.svg import HEIGHT, WIDTH, histogram, line_plot

SVG = "{http://www.w3.org/2000/svg}"


def test_lines_lie_in_the_frame_and_break_at_gaps() -> None:
    x = np.linspace(2.0, 9.0, 50)
    y = 3.0 + np.sin(x)
    y[20:25] = np.nan
    root = ElementTree.fromstring(line_plot("a < b", "t [s]", "mm", {"thumb": (x, y), "index": (x, 0.5 * y)}))
    lines = root.findall(f"{SVG}polyline")
    assert len(lines) == 4
    points = np.array([[float(v) for v in p.split(",")] for line in lines for p in line.attrib["points"].split()])
    assert len(points) == 90
    assert points.min() >= 0.0
    assert points[:, 0].max() <= WIDTH
    assert points[:, 1].max() <= HEIGHT
    # Larger values lie further up.
    first = np.array([float(p.split(",")[1]) for p in lines[0].attrib["points"].split()])
    assert np.argmin(first) == np.nanargmax(y[:20])


def test_bars_hold_every_value() -> None:
    values = np.abs(np.random.default_rng(0).normal(0.0, 2.0, 1000))
    values[7] = np.nan
    root = ElementTree.fromstring(histogram("errors", "mm", values))
    bars = root.findall(f"{SVG}rect")[1:-1]
    assert len(bars) == 60
    assert float(bars[0].attrib["height"]) > float(bars[45].attrib["height"])


@pytest.mark.parametrize("values", [np.empty(0), np.full(3, np.nan), np.zeros(5)])
def test_little_data_still_makes_a_plot(values: np.ndarray) -> None:
    ElementTree.fromstring(histogram("errors", "mm", values))
    ElementTree.fromstring(line_plot("errors", "s", "mm", {"a": (values, values)}))
    ElementTree.fromstring(line_plot("errors", "s", "mm", {}))
