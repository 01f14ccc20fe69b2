"""The distance of fingertips from the truth of their own moment."""

from __future__ import annotations

import pytest
from stub_rig import StubRig

from rhot.messages import HandPose, Truth
from rhot_viewer.rig.truth_track import TruthTrack

SECOND_NS = 1_000_000_000


def pose_at(stub: StubRig, t_s: float) -> HandPose:
    message = stub.messages(t_s, round(t_s * SECOND_NS), 0)["rhot/hand/right"]
    assert isinstance(message, HandPose)
    return message


def truth_at(stub: StubRig, t_s: float) -> Truth:
    return stub.world.truth(t_s, round(t_s * SECOND_NS))


def test_a_late_hand_is_compared_with_its_own_moment(stub: StubRig) -> None:
    track = TruthTrack()
    for tick in range(60):
        track.add(truth_at(stub, tick / 60))
    errors = track.fingertip_errors(pose_at(stub, 0.708))  # between two samples
    assert errors is not None
    assert 1e3 * errors == pytest.approx(2.0, abs=0.15), "the stub's hand stands 2 mm beside the truth"


def test_without_a_truth_around_it_there_is_no_error(stub: StubRig) -> None:
    track = TruthTrack()
    assert track.fingertip_errors(pose_at(stub, 0.5)) is None
    track.add(truth_at(stub, 0.2))
    track.add(truth_at(stub, 0.8))
    assert track.fingertip_errors(pose_at(stub, 0.5)) is None, "too far apart to read in between"
    assert track.fingertip_errors(pose_at(stub, 0.5).model_copy(update={"joints": {}})) is None


def test_another_session_starts_over(stub: StubRig) -> None:
    track = TruthTrack()
    for t_s in (5.0, 5.02, 1.0, 1.02):
        track.add(truth_at(stub, t_s))
    assert track.fingertip_errors(pose_at(stub, 5.01)) is None
    track.add(truth_at(stub, 1.04))
    assert track.fingertip_errors(pose_at(stub, 1.03)) is not None
