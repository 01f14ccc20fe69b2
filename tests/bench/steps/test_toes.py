"""Depth pictures of really walking feet, followed from the first marks alone."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot_bench.steps.command import NEAR_PX, ToeWalk, follow_toes, thesis_toes


@pytest.fixture(scope="module")
def folder(shared_data: Path) -> Path:
    return shared_data / "realsense" / "feet_rgbd"


@pytest.mark.parametrize("focal_px", [460.0, 610.0])
def test_both_toes_are_followed_whatever_the_lens(folder: Path, focal_px: float) -> None:
    off_px = follow_toes(ToeWalk(folder, focal_px))
    assert len(off_px) == 10
    assert np.mean(off_px < NEAR_PX) >= 0.9
    assert float(np.median(off_px)) < 6.0


def test_the_thesiss_blob_loses_the_toes(folder: Path) -> None:
    off_px = thesis_toes(ToeWalk(folder))
    assert len(off_px) > 5
    assert np.mean(off_px < NEAR_PX) < 0.5


def test_a_walk_needs_marks_of_its_first_picture(folder: Path, tmp_path: Path) -> None:
    walk = tmp_path / "walk"
    (walk / "color").mkdir(parents=True)
    shutil.copy(sorted((folder / "color").iterdir())[0], walk / "color")
    marks = walk / "manual_toe_tips.csv"
    header, _, *later = (folder / "manual_toe_tips.csv").read_text().splitlines()
    marks.write_text("\n".join([header, *later]))
    with pytest.raises(ConfigError, match=r"first picture .* not marked"):
        ToeWalk(walk)
    marks.write_text("frame,left_toe_u\n0,1\n")
    with pytest.raises(ConfigError, match="no column left_toe_v"):
        ToeWalk(walk)
