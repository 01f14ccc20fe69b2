"""Tracks of one rig of the family: deterministic, exact where they say so, and the truth fits them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rhot.anatomy.hand import HandModel
from rhot.errors import ConfigError
from rhot.rig import HandFile
from rhot_bench.motion.errors import coverage, hand_errors, point_errors
from rhot_bench.motion.recordings import HandMotion, list_recordings, read_recording
from rhot_bench.motion.references.spline_reference import spline_reference, views_of
from rhot_bench.motion.rigs import Family
from rhot_bench.motion.tracks import MARKERS, START_NS, Tracks, make_tracks

QUICK = Family(boards=(12, 13))
EXACT = replace(QUICK, corner_px=(1e-3, 1.001e-3), lost=(0.0, 0.0))


@pytest.fixture(scope="module")
def exact(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Tracks:
    folder = tmp_path_factory.mktemp("exact") / "rig"
    return make_tracks(4, shared_data, folder, seconds=1.5, rate_hz=60.0, noise_px=0.0, markers="points", family=EXACT)


def test_a_folder_without_recordings_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no recorded hands"):
        list_recordings(tmp_path)


def test_spline_of_exact_tracks_meets_the_truth(exact: Tracks) -> None:
    errors = point_errors(exact, spline_reference(views_of(exact.frames, exact.rig), len(MARKERS)))
    seen = errors.views >= 2
    assert np.median(errors.error_m[seen]) < 5e-5
    assert np.percentile(errors.error_m[seen], 95) < 3e-4


def test_row_times_are_those_of_the_rolling_shutter(exact: Tracks) -> None:
    draw = exact.draw
    for frame in exact.frames[:10]:
        for marker in frame.markers.values():
            expected = frame.t_ns + 1e9 * draw.readout_s * (marker.v / (frame.height - 1) - 0.5)
            assert abs((marker.t_ns or frame.t_ns) - expected) < 2e4


def test_frames_come_in_order_and_carry_the_patch(exact: Tracks) -> None:
    times = [frame.t_ns for frame in exact.frames]
    assert times == sorted(times)
    assert any("base" in frame.markers and frame.markers["base"].corners for frame in exact.frames)


def test_the_same_seed_gives_the_same_frames(shared_data: Path, tmp_path: Path) -> None:
    first, second = (
        make_tracks(6, shared_data, tmp_path / name, seconds=1.0, rate_hz=30.0, family=QUICK) for name in "ab"
    )
    assert first.frames == second.frames
    other = make_tracks(8, shared_data, tmp_path / "c", seconds=1.0, rate_hz=30.0, family=QUICK)
    assert other.frames != first.frames


def test_bones_are_constant_and_motion_is_plausible(exact: Tracks) -> None:
    t_ns = START_NS + (np.linspace(0.05, 1.4, 200) * 1e9).astype(np.int64)
    chain = exact.truth.hand(t_ns).chain
    lengths = np.linalg.norm(np.diff(chain, axis=2), axis=-1)
    assert np.ptp(lengths, axis=0).max() < 1e-9
    tips = chain[:, :, 3]
    step_s = 1.35 / 199
    acceleration = np.linalg.norm(np.diff(tips, 2, axis=0), axis=-1) / step_s**2
    assert np.percentile(acceleration, 99) < 60.0


def test_views_and_hidden_times_agree(exact: Tracks) -> None:
    t_ns = START_NS + (np.linspace(0.1, 1.4, 50) * 1e9).astype(np.int64)
    any_view, hidden = exact.truth.views(t_ns, 0.0) > 0, exact.truth.hidden_s(t_ns)
    assert (hidden[any_view] == 0.0).all()
    assert not (hidden[~any_view] == 0.0).any()
    assert (exact.truth.views(t_ns) <= exact.truth.views(t_ns, 0.0)).all()


def test_every_source_is_read_as_a_hand_of_believable_size(shared_data: Path) -> None:
    for source, files in list_recordings(shared_data).items():
        # The shortest of each: every file may be drawn.
        hand = read_recording(min(files, key=lambda file: len(file.read_text().splitlines())), source)
        length = float(np.linalg.norm(hand.knuckles[2]) + hand.bones[2].sum())
        assert 0.14 < length < 0.24, source
        assert np.isfinite(hand.chains).all()
        # A right hand: the thumb stands at −x of the wrist frame.
        assert HandModel.from_file(HandFile(), "right").knuckles[0, 0] * hand.knuckles[1, 0] > 0.0


def test_coverage_is_whole_for_the_spline_and_nothing_for_nothing(exact: Tracks) -> None:
    found = spline_reference(views_of(exact.frames, exact.rig), len(MARKERS))
    assert coverage(exact, found) > 0.95
    assert coverage(exact, found.of(found.t_ns < 0)) == 0.0


def test_no_hands_are_no_errors(exact: Tracks) -> None:
    assert len(hand_errors(exact, []).age_s) == 0


def test_a_clip_is_as_long_as_the_recording_lets_it(shared_data: Path) -> None:
    files = list_recordings(shared_data)["msra"]
    motion = HandMotion(read_recording(files[0], "msra"), 0.0, 1.0, 1.0, np.full(5, 0.007))
    assert motion.at(np.array([0.0, 1.0])).joints.shape == (2, 26, 3)
