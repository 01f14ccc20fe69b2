"""Real foot sensors with motion capture: the truth is shown to the filter while the foot stands, its swings are hidden.

The captured point is not quite the sensor, and a foot that is seen standing alone does not tell the lever between them;
so what counts is the end of each swing, where the foot is level again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot_feet.foot_filter import FootFilter
from rhot_feet.foot_filter_model import FootFilterSettings
from rhot_feet.inertial import RawReader

START_NS = 1_700_000_000_000_000_000
SIGMA_M = 0.003
PICTURE_S = 1.0 / 60.0


@pytest.mark.parametrize(
    ("trial", "mean_m", "worst_m"),
    [("2017-11-22-11-28-39", 0.015, 0.025), ("2017-11-22-11-48-35", 0.045, 0.08), ("2017-11-27-11-11-24", 0.11, 0.2)],
    ids=["small steps", "walking", "walking fast"],
)
def test_hidden_swings_end_near_the_truth(shared_data: Path, trial: str, mean_m: float, worst_m: float) -> None:
    table = np.genfromtxt(shared_data / "foot_imu" / f"{trial}_raw200.csv", delimiter=",", names=True)
    table = table[table["t"] < 15.0]
    force, rate, place = (np.stack([table[name] for name in names], axis=1) for names in
                          (("ax", "ay", "az"), ("gx", "gy", "gz"), ("px", "py", "pz")))  # fmt: skip
    t_ns = START_NS + np.round(1e9 * table["t"]).astype(np.int64)
    stands = table["zv"] > 0.5
    samples = RawReader().read(t_ns, force, rate)
    foot, random = FootFilter(FootFilterSettings(up=(0.0, 0.0, 1.0))), np.random.default_rng(1)
    shown_s, aligned_s, ends = -1.0, np.inf, []
    for k, t in enumerate(table["t"].tolist()):
        foot.imu(samples.rows(k, k + 1))
        landed = k > 0 and stands[k] and not stands[k - 1]
        if landed and t > aligned_s + 0.2:
            state = foot.state(int(t_ns[k]))
            assert state is not None
            ends.append(float(np.linalg.norm(state.position - place[k])))
        if stands[k] and t - shown_s >= PICTURE_S:
            shown_s = t
            foot.marker(int(t_ns[k]), place[k] + random.normal(0.0, SIGMA_M, 3), SIGMA_M**2 * np.eye(3))
        if foot.aligned:
            aligned_s = min(aligned_s, t)
    assert aligned_s < 5.0
    assert len(ends) > 5
    assert np.mean(ends) < mean_m
    assert np.max(ends) < worst_m
