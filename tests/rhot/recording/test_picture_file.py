"""Pictures of a recording are read whole or refused by name."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot.recording.picture_file import read_picture

IMAGE = np.random.default_rng(1).integers(0, 256, (24, 32, 3), dtype=np.uint8)


def test_pixels_come_back(tmp_path: Path) -> None:
    file = tmp_path / "a.png"
    cv2.imwrite(str(file), IMAGE)
    assert np.array_equal(read_picture(file), IMAGE)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_picture_that_is_cut_off_is_refused(tmp_path: Path, suffix: str) -> None:
    file = tmp_path / f"000007{suffix}"
    cv2.imwrite(str(file), IMAGE)
    read_picture(file)
    data = file.read_bytes()
    for length in range(0, len(data) - 12, 53):
        file.write_bytes(data[:length])
        with pytest.raises(ConfigError, match=rf"000007\{suffix}: "):
            read_picture(file)


def test_what_is_no_picture_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"absent\.png: cannot be read: No such file"):
        read_picture(tmp_path / "absent.png")
    (tmp_path / "text.png").write_text("no picture")
    with pytest.raises(ConfigError, match="no picture"):
        read_picture(tmp_path / "text.png")


def test_a_pipe_in_place_of_a_picture_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    with pytest.raises(ConfigError, match="no picture"):
        read_picture(tmp_path / "pipe.png")
