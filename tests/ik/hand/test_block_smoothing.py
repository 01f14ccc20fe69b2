"""Hands of a recording as the samples before and after each moment show them."""

from __future__ import annotations

import numpy as np
import pytest
from hands.moving_hand import MakePoints, Wrist, moving_angles, positions

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import JOINTS
from rhot.arrays import FloatArray
from rhot.core import Output
from rhot.messages import HandPose, PointSet
from rhot.rig import Rig
from rhot_ik.hand_core import BlockSmoother, HandCore

RATE_HZ = 40.0
TIP = JOINTS.index("ring_tip")


Clip = tuple[list[PointSet], FloatArray]


@pytest.fixture
def clip(right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist) -> Clip:
    """From rest to a fist in a second, most of it unseen."""
    return clip_of(right_rig, right_hand, make_points, wrist, closes=(20, 60), hidden=(24, 52))


def clip_of(
    right_rig: Rig,
    right_hand: HandModel,
    make_points: MakePoints,
    wrist: Wrist,
    *,
    closes: tuple[int, int],
    hidden: tuple[int, int],
) -> Clip:
    """Return points of 2 s in which the ring finger closes while nobody sees it, and its true tips."""
    sets, tips = [], []
    for k in range(80):
        t_s = k / RATE_HZ
        angles = moving_angles(t_s, right_hand)
        angles[3, 0] += np.radians(60.0) * np.clip((k - closes[0]) / (closes[1] - closes[0]), 0.0, 1.0)
        joints = right_hand.forward(wrist(), right_hand.clamp(angles))
        hide = ("ring",) if hidden[0] <= k < hidden[1] else ()
        sets.append(make_points(right_hand, joints, right_rig.config.markers, t_s, hide=hide))
        tips.append(joints.positions[TIP])
    return sets, np.array(tips)


def tips_of(hands: list[tuple[PointSet, list[Output]]]) -> FloatArray:
    poses = [message for _, outputs in hands for _, message in outputs if isinstance(message, HandPose)]
    assert len(poses) == len(hands)
    return np.array([positions(pose)[TIP] for pose in poses])


def test_a_hidden_finger_goes_to_where_it_comes_out(right_rig: Rig, clip: Clip) -> None:
    sets, truth = clip
    live = tips_of([(points, core.feed(points)) for core in [HandCore(right_rig)] for points in sets])
    core = HandCore(right_rig)
    assert all(core.feed_smoothed(points) == [] for points in sets)
    smooth = tips_of(core.finish())
    hidden = slice(24, 52)
    before, after = (np.linalg.norm(found - truth, axis=1)[hidden] for found in (live, smooth))
    assert after.max() < 0.6 * before.max()
    assert after.mean() < 0.6 * before.mean()
    # It comes out without a step, and seen tips stay where they were seen.
    steps = np.linalg.norm(np.diff(smooth, axis=0), axis=1) - np.linalg.norm(np.diff(truth, axis=0), axis=1)
    assert steps[15:].max() < 0.004
    assert np.linalg.norm(smooth - truth, axis=1)[60:].max() < 0.004


def test_a_finger_that_moved_fast_while_hidden_comes_out_without_a_jump(
    right_rig: Rig, right_hand: HandModel, make_points: MakePoints, wrist: Wrist
) -> None:
    sets, truth = clip_of(right_rig, right_hand, make_points, wrist, closes=(40, 48), hidden=(41, 48))
    core = HandCore(right_rig)
    assert all(core.feed_smoothed(points) == [] for points in sets)
    smooth = tips_of(core.finish())
    steps = np.linalg.norm(np.diff(smooth, axis=0), axis=1)
    fastest_m = np.linalg.norm(np.diff(truth, axis=0), axis=1).max()
    assert steps[41:50].max() < 2.0 * fastest_m


def test_pieces_come_in_order_and_all_of_them(right_rig: Rig, clip: Clip) -> None:
    sets, _ = clip
    whole, pieces = HandCore(right_rig), HandCore(right_rig)
    pieces._block_smoother = BlockSmoother(pieces._solvers, ahead_ns=1_000_000_000, piece_ns=300_000_000)
    for points in sets:
        whole.feed_smoothed(points)
    settled = [pieces.feed_smoothed(points) for points in sets]
    assert max(map(len, settled)) < 20
    assert sum(map(len, settled)) > 30
    found = [hand for piece in settled for hand in piece] + pieces.finish()
    assert [points.seq for points, _ in found] == [points.seq for points in sets]
    assert np.linalg.norm(tips_of(found) - tips_of(whole.finish()), axis=1).max() < 0.004
    assert pieces.finish() == []
