"""Real foot sensors with motion capture: swings that nobody sees."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot_bench.steps.walks import hide_swings, read_places, read_step_trial


@pytest.mark.parametrize(
    ("trial", "mean_m", "worst_m"),
    [("2017-11-22-11-28-39", 0.015, 0.025), ("2017-11-22-11-48-35", 0.045, 0.08), ("2017-11-27-11-11-24", 0.11, 0.2)],
    ids=["small steps", "walking", "walking fast"],
)
def test_hidden_swings_end_near_the_truth(shared_data: Path, trial: str, mean_m: float, worst_m: float) -> None:
    found = hide_swings(read_step_trial(shared_data / "foot_imu" / f"{trial}_raw200.csv", longest_s=15.0))
    assert found.aligned_s < 5.0
    assert len(found.ends_m) > 5
    assert np.mean(found.ends_m) < mean_m
    assert np.max(found.ends_m) < worst_m


HEADER = "t,ax,ay,az,gx,gy,gz,px,py,pz,zv\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,ax\n0,1\n0.1,1\n", r"no column ay, az, gx, .*, zv"),
        (HEADER, "holds no rows|under 11 columns"),
        (HEADER + 2 * "0.1,0,0,9.8,0,0,0,0,0,0,1\n", "times do not rise"),
        (HEADER + "0.1,0,0,nan,0,0,0,0,0,0,1\n", "finite"),
    ],
)
def test_what_is_no_recording_of_steps_is_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "steps.csv"
    file.write_text(text)
    with pytest.raises(ConfigError, match=rf"steps\.csv: .*({words})"):
        read_step_trial(file)


def test_places_need_no_sensor(tmp_path: Path) -> None:
    file = tmp_path / "steps.csv"
    file.write_text("t,px,py,pz\n0,1,2,3\n0.1,1,2,4\n")
    np.testing.assert_array_equal(read_places(file), [[1, 2, 3], [1, 2, 4]])
