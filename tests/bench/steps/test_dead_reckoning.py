"""Walks that are played faster."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rhot_bench.steps.dead_reckoning import faster, horizontal_error_m, reckon
from rhot_bench.steps.walks import read_places
from rhot_feet.imu.samples import GRAVITY_M_S2, RawImuConverter
from rhot_feet.sources.imu.recorded import read_samples


def test_a_faster_sensor_measures_what_its_path_asks_for() -> None:
    t = np.arange(400) / 200.0
    force = np.stack([np.sin(7.0 * t), np.zeros(400), np.full(400, GRAVITY_M_S2)], axis=1)
    samples = RawImuConverter().convert(np.round(1e9 * t).astype(np.int64), force, np.zeros((400, 3)))
    twice = faster(samples, 2.0)
    assert np.ptp(twice.t_ns) * 2 == np.ptp(samples.t_ns)
    R_up = twice.specific_force - 4.0 * samples.specific_force
    assert np.allclose(np.linalg.norm(R_up, axis=1), 3.0 * GRAVITY_M_S2), "gravity stays what it is"
    assert np.allclose(faster(samples, 1.0).specific_force, samples.specific_force)


def test_who_walks_as_fast_as_others_run_is_not_lost(shared_data: Path) -> None:
    """With a fixed cap on the threshold it was 979 mm off at 200 Hz: such a foot is never as still as a walker's."""
    path = shared_data / "foot_imu" / "2017-11-27-11-11-24_raw200.csv"
    assert horizontal_error_m(reckon(faster(read_samples(path), 1.6)), read_places(path)) < 0.15
