from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from rhot.errors import ConfigError
from rhot.messages import ServiceStatus
from rhot_bench.command import bench
from rhot_bench.speed.live import Arrivals, latencies_s, live_rows
from rhot_bench.speed.pages import Turn, page_rows
from rhot_bench.speed.pi_budget import frame_s
from rhot_bench.speed.scaling import growth_row

Invoke = Callable[..., str]

ROWS = (
    "tracked, ours / thesis, medians",
    "searched, ours / thesis, medians",
    "one camera frame, filter, median",
    "one camera frame, ours / thesis, p95",
    "five fingers, closed form, median",
    "whole hand from a point set, p95",
    "picture in memory to encoded pose, p50",
    "picture in memory to encoded pose, p99",
    "Pi 3, all markers tracked, a frame, at most",
    "Pi 5, frames a second on one core, at least",
    "capture, a frame grows as markers to the power",
    "fusion, 8 cameras, 12 markers, a camera frame",
    "fusion, 12 markers, a second grows as cameras to the power",
    "fusion, a second grows as frame rate to the power",
)


def test_quick_bench_prints_every_row_and_valid_json(invoke: Invoke, rig_path: Path, tmp_path: Path) -> None:
    file = tmp_path / "bench.json"
    parts = [word for part in ("capture", "fusion", "ik", "pipeline", "scaling", "budget") for word in ("--part", part)]
    text = invoke(bench, "--quick", "--rig", rig_path, "--json", file, *parts)
    document = json.loads(file.read_text())
    rows = {row["name"]: row for section in document["sections"] for row in section["rows"]}
    for name in ROWS:
        assert name in text
        assert rows[name]["value"] is not None, name
    assert rows["tracked, ours / thesis, medians"]["most"] == 1.0
    assert rows["searched, ours / thesis, medians"]["most"] == 0.25
    assert rows["one camera frame, filter, median"]["most"] == 250.0
    assert rows["markers that the thesis's detector finds"]["value"] > 4.0
    assert "targets missed" in text


def test_wrong_rigs_and_outputs_are_refused_before_the_work(invoke: Invoke, rig_folder: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"holds no rig\.toml"):
        invoke(bench, "--rig", tmp_path)
    with pytest.raises(ConfigError, match="simulated cameras"):
        invoke(bench, "--rig", rig_folder)
    with pytest.raises(ConfigError, match="does not exist"):
        invoke(bench, "--json", tmp_path / "nowhere" / "bench.json")


def test_growth_is_the_slope_of_the_logarithms() -> None:
    assert growth_row("linear", (2, 4, 8), (10.0, 20.0, 40.0)).value == pytest.approx(1.0)
    assert growth_row("square", (2, 4, 8), (1.0, 4.0, 16.0)).verdict == "missed"


def test_pis_are_ordered_by_what_their_cores_execute() -> None:
    times_s = [frame_s(board, "tracked") for board in ("Zero 2 W", "Pi 3", "Pi 4", "Pi 5")]
    assert times_s == sorted(times_s, reverse=True)
    assert all(slow == pytest.approx(2.0 * fast) for fast, slow in times_s)


def test_latency_counts_from_the_newest_picture_of_a_hand() -> None:
    frames = [(0, 9_000_000), (7_000_000, 16_000_000), (16_700_000, 25_700_000)]
    hands = [(7_000_400, 19_000_000), (16_700_000, 30_700_000), (16_700_000, 20_000_000)]
    assert latencies_s(frames, hands) == pytest.approx([0.003, 0.005])
    assert {row.verdict for row in live_rows(Arrivals(), 1.0, 60.0)} == {"not measured", "missed", "met", ""}


def test_live_tells_how_much_of_the_latency_is_work() -> None:
    rows = {row.name: row.value for row in live_rows(Arrivals(compute_s={"fusion": 0.0008, "ik": 0.001}), 1.0, 60.0)}
    assert rows["work: fusion, one camera's frame, p50"] == pytest.approx(0.8)
    assert rows["work: ik, a hand, p50"] == pytest.approx(1.0)


def shown(p99_s: float, pictures_hz: float, without_graphics: float) -> ServiceStatus:
    return ServiceStatus(
        t_ns=1,
        service="viewer",
        instance="grasp",
        state="running",
        figures={"pictures_hz": pictures_hz, "without_graphics": without_graphics, "clock_ms": 0.2, "browsers": 2.0},
        latency_s={"to_picture": {"p50": 0.005, "p99": p99_s, "max": 1.0}},
    )


def test_pages_are_judged_beside_the_turns_without_them() -> None:
    waits_ms = tuple(range(1, 101))
    turns = [
        Turn(0, 1.0, tuple(map(float, waits_ms)), None),
        Turn(2, 1.0, tuple(2.0 * wait for wait in waits_ms[:70]), shown(0.02, 60.0, 0.0)),
    ]
    rows = {row.name: row for row in page_rows(turns, 60.0)}
    assert rows["fewer poses with pages"].value == pytest.approx(30.0)
    assert rows["fewer poses with pages"].verdict == "missed"
    assert rows["later with pages, p99"].verdict == "missed"
    last = rows["pose on the bus to the picture that shows it, p99"]
    assert last.value == pytest.approx(20.0)
    assert last.most == 20.7, "one picture at 60 Hz and 4 ms"
    assert last.verdict == "met"

    turns[1] = Turn(2, 1.0, turns[1].waits_ms, shown(0.2, 10.0, 2.0))
    rows = {row.name: row for row in page_rows(turns, 60.0)}
    assert rows["later with pages, p99"].verdict == "", "the processor draws: it is the poses that count"
    assert rows["pose on the bus to the picture that shows it, p99"].verdict == "missed"

    rows = {row.name: row for row in page_rows([Turn(0, 1.0, (), None), Turn(2, 1.0, (), None)], 60.0)}
    assert rows["fewer poses with pages"].verdict == "not measured"

    rows = {row.name: row for row in page_rows(turns, 240.0)}
    assert rows["fewer poses with pages"].verdict == "not measured", "others use this machine"
    assert "keep up" in rows["fewer poses with pages"].note
