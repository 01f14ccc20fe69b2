"""Where a foot points, by its lifted heel."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rhot_bench.steps.command import heel_directions
from rhot_bench.steps.walks import read_step_trial


def test_a_lifted_heel_tells_where_a_recorded_foot_points(shared_data: Path) -> None:
    off = heel_directions(read_step_trial(shared_data / "foot_imu" / "2017-11-22-11-48-35_raw200.csv"))
    assert len(off) > 8
    assert np.sqrt(np.mean(off**2)) < np.radians(10.0)
