"""Stated standard deviations beside the errors that points have: neither a third as large nor twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rhot.messages import PointSet
from rhot.offline import track
from rhot_bench.hands.accuracy import START_NS
from rhot_bench.speed.simulated import world_of
from rhot_bench.tracking.tracking import scene_frames
from rhot_sim.rig.folder import write_simulated_rig


def test_error_of_measured_points_is_what_they_state(tmp_path: Path) -> None:
    rig = write_simulated_rig(tmp_path / "rig", rate_hz=30.0, seed=1)
    world = world_of(rig, 1.0)
    error2, stated2 = [], []
    for _, message in track(rig, scene_frames(rig, world, 3.0, lambda: None)):
        if not isinstance(message, PointSet) or message.t_ns < START_NS + 10**9:
            continue
        true = world.sample(np.array([(message.t_ns - START_NS) / 1e9])).markers
        for name, point in message.points.items():
            if point.state == "measured":
                error2.append(np.sum((np.array(point.position) - true[name][0]) ** 2))
                stated2.append(point.sigma**2)
    assert len(error2) > 500
    assert 0.5 < np.sqrt(np.mean(error2) / np.mean(stated2)) < 1.5
