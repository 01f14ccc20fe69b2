"""Figures of the last two minutes."""

from __future__ import annotations

import numpy as np
import pytest

from rhot.messages import ServiceStatus
from rhot_viewer.rig.inbox import MOST_ROWS, SECONDS, History


def status(service: str, rate: float, missed: int = 0) -> ServiceStatus:
    return ServiceStatus(
        t_ns=1,
        service=service,
        instance="main",
        state="running",
        rates={"output": rate},
        counts={"missed": missed, "output": 1000},
        latency_s={"output_age": {"p50": 0.01, "p99": 0.025}},
    )


def test_a_second_a_value() -> None:
    history = History()
    history.add({"ik/main": status("ik", 60.0)}, {})
    history.add({"ik/main": status("ik", 59.0), "fusion/main": status("fusion", 61.0)}, {"tip": 1.5})
    chart = history.chart("rate")
    assert chart.x_s.tolist() == [-1.0, 0.0]
    assert {name: row.tolist() for name, row in chart.rows.items()} == {"fusion/main": [0, 61], "ik/main": [60, 59]}
    assert history.chart("latency").rows["ik/main"] == pytest.approx([25.0, 25.0])
    assert history.chart("error").rows["tip"].tolist() == [0.0, 1.5]


def test_losses_are_counted_per_second_also_over_a_restart() -> None:
    history = History()
    for missed in (100, 103, 103, 0, 2):
        history.add({"capture/left": status("capture", 60.0, missed)}, {})
    assert history.chart("lost").rows["capture/left"].tolist() == [0, 3, 0, 0, 2]


def test_the_charts_end_after_two_minutes_and_the_gone_are_forgotten() -> None:
    history = History()
    history.add({"ik/main": status("ik", 60.0), "viewer/main": status("viewer", 60.0)}, {})
    assert set(history.chart("rate").rows) == {"ik/main"}, "the viewer looks, it does not track"
    for _ in range(SECONDS - 1):
        history.add({}, {})
    assert len(history.chart("rate").x_s) == SECONDS
    assert np.count_nonzero(history.chart("rate").rows["ik/main"]) == 1
    history.add({}, {})
    assert history.chart("rate").rows == {}


def test_names_that_somebody_makes_up_fill_no_memory_and_make_room_again() -> None:
    history = History()
    for number in range(3 * MOST_ROWS):
        history.add({f"{number}/main": status(str(number), 60.0)}, {})
    assert len(history.chart("rate").rows) <= MOST_ROWS
    assert len(history._lost_before) <= MOST_ROWS
    for _ in range(SECONDS):
        history.add({"ik/main": status("ik", 60.0)}, {})
    assert list(history.chart("rate").rows) == ["ik/main"]
