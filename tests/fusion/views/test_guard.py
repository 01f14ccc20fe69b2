from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from rhot.geometry.camera import CameraModel
from rhot.messages import MarkerFrame
from rhot_fusion.core import StreamGuard

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000


@pytest.fixture
def guard() -> StreamGuard:
    camera = CameraModel.from_arrays(640, 480, np.diag([530.0, 530.0, 1.0]), np.zeros(0), np.eye(4))
    return StreamGuard({"left": camera, "right": camera}, Counter())


def frame(t_ms: float, camera: str = "left", width: int = 640) -> MarkerFrame:
    return MarkerFrame(t_ns=START_NS + round(t_ms * MS), camera=camera, width=width, height=480, markers={})


def test_ordinary_stream_passes(guard: StreamGuard) -> None:
    for number in range(10):
        assert guard.judge(frame(33.3 * number)) == "accept"
        assert guard.judge(frame(33.3 * number - 5.0, "right")) == "accept"
    assert not guard.counts


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (frame(40.0, "middle"), "unknown_camera"),
        (frame(40.0, width=320), "wrong_size"),
        (frame(20.0), "late"),
        (frame(33.0), "duplicate"),
        (frame(40_000.0), "wrong_time"),
        (frame(-1e9), "wrong_time"),
    ],
)
def test_implausible_frames_are_rejected_and_counted(guard: StreamGuard, bad: MarkerFrame, reason: str) -> None:
    assert guard.judge(frame(0.0)) == guard.judge(frame(33.0)) == "accept"
    assert guard.judge(bad) == "refuse"
    assert guard.counts == {reason: 1}
    assert guard.judge(frame(66.0)) == "accept"


def test_garbage_among_good_frames_never_takes_over(guard: StreamGuard) -> None:
    for number in range(100):
        assert guard.judge(frame(10.0 * number)) == "accept"
        assert guard.judge(frame(1e6 + 10.0 * number, "right")) == "refuse"
    assert guard.counts == {"wrong_time": 100}


def test_paused_stream_resumes_after_three_frames(guard: StreamGuard) -> None:
    guard.judge(frame(0.0))
    assert [guard.judge(frame(5000.0 + 33.0 * number)) for number in range(4)] == [
        "refuse",
        "refuse",
        "restart",
        "accept",
    ]


def test_stream_started_again_is_followed_after_eight_frames(guard: StreamGuard) -> None:
    guard.judge(frame(60_000.0))
    verdicts = [guard.judge(frame(33.0 * number)) for number in range(9)]
    assert verdicts == ["refuse"] * 7 + ["restart", "accept"]
    assert guard.counts == {"wrong_time": 7, "restarts": 1}
