"""Disparities of a rig of known geometry, and the laws through them."""

from __future__ import annotations

from collections.abc import Callable
from io import StringIO

import numpy as np
import pytest
from marker_streams import Motion, watch
from rich.console import Console

from rhot.errors import ConfigError
from rhot.messages import MarkerFrame, Truth
from rhot.rig import BusConfig, Rig
from rhot_calibration.depth.fit import fit_power_law
from rhot_tools.measures.rows import Row
from rhot_tools.rig import heard as session
from rhot_tools.rig.depth import (
    DepthRow,
    depth_plot,
    depth_sections,
    disparities,
    power_law_figures,
    printed_table,
    row_at,
    rows_by_truth,
)
from rhot_tools.rig.heard import Heard

MakeRig = Callable[..., Rig]
DEEP = Motion(amplitude_m=(0.02, 0.02, 0.2), frequency_hz=(0.3, 0.3, 0.25))


def frames(rig: Rig, motion: Motion, seconds: float) -> list[MarkerFrame]:
    return [seen.frame for seen in watch(rig, motion, seconds, rate_hz=30.0)]


def true_fb(rig: Rig) -> float:
    (left, right) = rig.cameras.values()
    baseline = np.linalg.norm(np.array(left.T_rig_camera)[:3, 3] - np.array(right.T_rig_camera)[:3, 3])
    return float(np.array(left.K)[0, 0] * baseline)


def test_the_printed_table_ships_and_gives_the_law_that_the_thesis_prints() -> None:
    distance, disparity = printed_table()
    assert len(distance) == 17
    law = fit_power_law(distance, disparity)
    assert 100.0 * law.k == pytest.approx(4543.3, rel=0.01)
    assert law.z == pytest.approx(-1.035, abs=0.003)


def test_disparities_of_cameras_out_of_step_are_what_geometry_says(make_rig: MakeRig) -> None:
    rig = make_rig()
    still = Motion(amplitude_m=(0.0, 0.0, 0.0))
    _, found = disparities(rig, frames(rig, still, 3.0), "index")
    depth = float(still.at(0.0)[0, 1, 2])
    assert row_at(depth, found, 0.0).disparity_px.holds(true_fb(rig) / depth)
    assert row_at(depth, found, 0.01).disparity_px.half_width > row_at(depth, found, 0.0).disparity_px.half_width


def test_by_the_truth_every_distance_and_the_law_agree(make_rig: MakeRig) -> None:
    rig = make_rig()
    seen = frames(rig, DEEP, 6.0)
    base_ns = 1_700_000_000_000_000_000
    truth = [
        Truth(
            t_ns=base_ns + round(1e9 * t),
            frame="rig",
            points={"index": tuple(DEEP.at(t)[0, 1].tolist())},
            hands={},
            objects={},
        )
        for t in np.arange(0.0, 6.0, 1.0 / 60.0).tolist()
    ]
    rows = rows_by_truth(rig, seen, truth, "index")
    assert len(rows) >= 8
    beside = depth_sections(rows, true_fb(rig))[-1].rows
    assert np.mean([row.value for row in beside]) >= 0.9
    _, k, z = power_law_figures(rows)
    assert z.holds(-1.0)
    assert k.holds(100.0 * true_fb(rig))
    assert "<svg" in depth_plot(rows)


def test_intervals_of_the_law_hold_the_truth_in_95_of_100_cases() -> None:
    rng = np.random.default_rng(11)
    distance = np.linspace(0.3, 0.9, 13)
    held = []
    for _ in range(200):
        disparity = (45.0 / (100.0 * distance)) * 100.0 * np.exp(rng.normal(0.0, 0.01, 13))
        rows = [
            DepthRow(d, row_at(d, np.full(20, px), 0.0).disparity_px) for d, px in zip(distance, disparity, strict=True)
        ]
        _, _, z = power_law_figures(rows)
        held.append(z.holds(-1.0))
    assert np.mean(held) == pytest.approx(0.95, abs=0.05)


def test_a_session_leads_through_distances_and_asks_again(make_rig: MakeRig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = make_rig()
    depths = iter([0.5, None, 0.7, 0.9])

    async def listen(*_: object) -> Heard:
        depth = next(depths)
        if depth is None:
            return Heard()
        heard = Heard()
        heard.frames = frames(rig, Motion(amplitude_m=(0.0, 0.0, 0.0)), 1.0)
        return heard

    monkeypatch.setattr(session, "listen", listen)
    answers = iter(["", "", "", "s", ""])
    asked: list[str] = []

    def ask(text: str) -> str:
        asked.append(text)
        return next(answers)

    out = StringIO()
    rows = session.depth_session(
        rig, BusConfig(), "index", (50.0, 60.0, 65.0, 70.0), 0.005, Console(file=out, width=200), 3.0, ask
    )
    assert [row.distance_m for row in rows] == pytest.approx([0.5, 0.6, 0.7])
    assert "1 of 4: hold index 50 cm" in asked[0]
    assert asked[1] == asked[2]
    assert "try again" in out.getvalue()


def test_a_marker_that_was_not_seen_is_named() -> None:
    with pytest.raises(ConfigError, match="at 50 cm both cameras saw the marker 0 times"):
        row_at(0.5, np.empty(0), 0.0)
    assert isinstance(depth_sections([row_at(d, np.full(20, 40.0 / d), 0.0) for d in (0.3, 0.5, 0.8)])[1].rows[0], Row)


def test_too_few_distances_say_what_to_look_at(make_rig: MakeRig) -> None:
    rig = make_rig()
    heard = Heard()
    heard.truth = [Truth(t_ns=1, frame="rig", points={}, hands={}, objects={})]
    with pytest.raises(ConfigError, match="saw index at 0 distances only, 3 are the least"):
        session.depth_rows(rig, BusConfig(), heard, "index", (), 0.008, Console())
