"""Which marker is meant by a click."""

from __future__ import annotations

import pytest

from rhot.messages import Marker, MarkerFrame
from rhot_viewer.panels.pictures import marker_at

FRAME = MarkerFrame(
    t_ns=1,
    camera="left",
    width=640,
    height=480,
    markers={
        "thumb": Marker(u=100.0, v=100.0, area=314.0, score=1.0),
        "index": Marker(u=130.0, v=100.0, area=314.0, score=1.0),
        "base": Marker(u=400.0, v=300.0, area=5000.0, score=1.0),
    },
)


@pytest.mark.parametrize(
    ("pixel", "meant"),
    [
        ((101.0, 102.0), "thumb"),
        ((114.0, 100.0), "thumb"),
        ((116.0, 100.0), "index"),
        ((430.0, 325.0), "base"),
        ((300.0, 200.0), None),
        ((100.0, 125.0), None),
    ],
)
def test_the_nearest_within_reach(pixel: tuple[float, float], meant: str | None) -> None:
    assert marker_at(FRAME, *pixel) == meant
