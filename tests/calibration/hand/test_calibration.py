from __future__ import annotations

from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from marker_streams import make_rig, thesis_cameras

from rhot.anatomy.hand import HandModel
from rhot.anatomy.skeleton import CHAINS, FINGERS
from rhot.errors import CalibrationError
from rhot.messages import PointSet
from rhot.recording import load_recording, marker_track_frames
from rhot.rig import HandFile, Rig
from rhot_calibration.hand.calibration import measure_hand
from rhot_calibration.hand.samples import Phases, PoseWindow
from rhot_fusion.core import FusionCore

SHORTEST_M, LONGEST_M = 0.165, 0.212
"""About the 5th percentile of women to the 95th of men."""
HANDS = 6
SAID = Phases(PoseWindow(1.0, 4.0), PoseWindow(5.0, 15.0))


@pytest.fixture(scope="module")
def measured(person: Callable[..., Any], rig: Rig) -> list[tuple[HandFile, HandFile]]:
    """True and calibrated hands over all sizes of adults; half of them with the phases to be found."""
    pairs = []
    for seed, length_m in enumerate(np.linspace(SHORTEST_M, LONGEST_M, HANDS), start=900):
        one = person(seed, float(length_m))
        pairs.append((one.hand, measure_hand(one.points, rig, "right", SAID if seed % 2 else Phases())))
    return pairs


def true_lengths(hand: HandFile, rig: Rig) -> dict[str, dict[str, float]]:
    model = HandModel.from_file(hand, "right")
    flat = model.marker_positions(model.forward_local(np.zeros((5, 4))), rig.config.markers)
    return {
        "bones": {joint: 1e3 * hand.bones_m[joint] for finger in FINGERS for joint in CHAINS[finger][1:]},
        "fingers": {finger: 1e3 * float(model.bones[k].sum()) for k, finger in enumerate(FINGERS)},
        "reach": {finger: 1e3 * float(np.linalg.norm(flat[finger] - flat["base"])) for finger in FINGERS},
    }


def errors_mm(truth: HandFile, found: HandFile, rig: Rig) -> list[tuple[str, float, float, bool]]:
    """Kind, error, standard deviation and whether measured, of every length."""
    assert truth.width_m is not None
    assert found.width_m is not None
    lengths = true_lengths(truth, rig) | {"": {"length": 1e3 * truth.length_m, "width": 1e3 * truth.width_m}}
    rows = []
    for kind, group in lengths.items():
        for name, length in group.items():
            figure = found.quality[kind][name] if kind else found.quality[name]
            rows.append((kind, figure["mm"] - length, figure["sd_mm"], figure["source"] == "measured"))
    return rows


@pytest.mark.xdist_group("measured hands")
def test_measured_lengths_are_within_two_millimetres(measured: list[tuple[HandFile, HandFile]], rig: Rig) -> None:
    rows = [row for truth, found in measured for row in errors_mm(truth, found, rig)]
    errors = [abs(error) for _, error, _, is_measured in rows if is_measured]
    assert len(errors) >= 4 * HANDS
    assert np.percentile(errors, 95.0) < 2.0
    sources = {found.quality["fingers"][finger]["source"] for _, found in measured for finger in FINGERS[1:]}
    assert sources <= {"measured", "roughly measured"}


@pytest.mark.xdist_group("measured hands")
def test_uncertainties_cover_the_errors(measured: list[tuple[HandFile, HandFile]], rig: Rig) -> None:
    rows = [row for truth, found in measured for row in errors_mm(truth, found, rig)]
    inside = np.mean([abs(error) <= 2.0 * sd for _, error, sd, _ in rows])
    assert 0.90 <= inside < 0.999


@pytest.mark.xdist_group("measured hands")
def test_fingers_are_known_better_than_from_proportions(measured: list[tuple[HandFile, HandFile]], rig: Rig) -> None:
    """An average hand of the right length would miss them by 2.5 mm, one of average length by more."""
    rows = [row for truth, found in measured for row in errors_mm(truth, found, rig)]
    fingers = np.array([error for kind, error, _, _ in rows if kind == "fingers"]).reshape(HANDS, 5)[:, 1:]
    assert np.sqrt((fingers**2).mean()) < 1.8
    assert abs(fingers.mean()) < 0.8
    assert all(found.quality["knuckles_s"] for _, found in measured)


def test_without_knuckles_phase_knuckles_follow_from_proportions(person: Callable[..., Any], rig: Rig) -> None:
    one = person(31, 0.178, knuckles=False)
    found = measure_hand(one.points, rig, "right", Phases(flat=SAID.flat))
    rows = errors_mm(one.hand, found, rig)
    assert all(abs(error) < 2.0 for _, error, _, is_measured in rows if is_measured)
    assert np.mean([abs(error) <= 2.0 * sd for _, error, sd, _ in rows]) >= 0.9
    assert all(found.quality["reach"][finger]["source"] == "measured" for finger in FINGERS[1:])
    assert all(found.quality["fingers"][finger]["source"] != "measured" for finger in FINGERS)


def test_fingers_bent_in_the_knuckles_phase_are_not_believed(person: Callable[..., Any], rig: Rig) -> None:
    """Fists where straight fingers were promised leave their spheres by far more than 2.5 mm."""
    one = person(32, 0.195)
    found = measure_hand(one.points, rig, "right", Phases(SAID.flat, PoseWindow(16.5, 24.0)))
    assert found.quality["knuckles_s"] is None
    rows = errors_mm(one.hand, found, rig)
    assert np.mean([abs(error) <= 2.0 * sd for _, error, sd, _ in rows]) >= 0.9


def test_a_typed_length_sharpens_the_metacarpals(person: Callable[..., Any], rig: Rig) -> None:
    one = person(33, 0.200)
    plain = measure_hand(one.points, rig, "right", SAID)
    typed = measure_hand(one.points, rig, "right", SAID, typed_length_m=0.200)
    assert typed.length_m == pytest.approx(0.200, abs=0.003)
    for joint in ("index_proximal", "middle_proximal", "ring_proximal", "little_proximal"):
        assert typed.quality["bones"][joint]["sd_mm"] < plain.quality["bones"][joint]["sd_mm"]


@pytest.mark.parametrize(
    ("hide", "words"), [("ring", r"seen in too few samples: ring \(0 %\)"), ("base", "base was never seen")]
)
def test_a_hidden_marker_is_named(person: Callable[..., Any], rig: Rig, hide: str, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        measure_hand(person(1, 0.19, hide=(hide,)).points, rig, "right")


def test_too_short_a_recording_says_how_long(person: Callable[..., Any], rig: Rig) -> None:
    with pytest.raises(CalibrationError, match=r"only \d+ samples .*, at least 60"):
        measure_hand(person(1, 0.19).points[:38], rig, "right")


def test_a_flat_phase_outside_the_recording_is_refused(person: Callable[..., Any], rig: Rig) -> None:
    with pytest.raises(CalibrationError, match=r"flat phase 90\.0 to 93\.0 s"):
        measure_hand(person(1, 0.19).points, rig, "right", Phases(flat=PoseWindow(90.0, 93.0)))


def test_a_hand_that_was_never_still_is_refused(person: Callable[..., Any], rig: Rig) -> None:
    """Free movements, four times as fast."""
    free = person(1, 0.19).points[16 * 30 :: 4] * 2
    fast = [one.model_copy(update={"t_ns": free[0].t_ns + round(k / 30.0 * 1e9)}) for k, one in enumerate(free)]
    with pytest.raises(CalibrationError, match=r"--flat START-END"):
        measure_hand(fast, rig, "right")


def renamed(one: PointSet, names: dict[str, str]) -> PointSet:
    return one.model_copy(update={"points": {names.get(name, name): point for name, point in one.points.items()}})


def test_swapped_paints_are_named(person: Callable[..., Any], rig: Rig) -> None:
    swapped = [renamed(one, {"index": "ring", "ring": "index"}) for one in person(1, 0.19).points]
    with pytest.raises(CalibrationError, match="in the order ring, middle, index, little; two paints are swapped"):
        measure_hand(swapped, rig, "right")


def test_the_other_hand_is_noticed(person: Callable[..., Any], rig: Rig) -> None:
    names = {"index": "little", "middle": "ring", "ring": "middle", "little": "index"}
    with pytest.raises(CalibrationError, match="is it the right hand"):
        measure_hand([renamed(one, names) for one in person(1, 0.19).points], rig, "right")


def scaled(one: PointSet, factor: float) -> PointSet:
    points = {
        name: point.model_copy(update={"position": tuple(factor * x for x in point.position), "corners": None})
        for name, point in one.points.items()
    }
    return one.model_copy(update={"points": points})


def test_a_wrong_scale_is_no_hand(person: Callable[..., Any], rig: Rig) -> None:
    with pytest.raises(CalibrationError, match="human hands are 140 to 240 mm"):
        measure_hand([scaled(one, 2.0) for one in person(1, 0.19).points], rig, "right")


def test_without_corners_reaches_alone_give_a_rough_hand(person: Callable[..., Any], rig: Rig) -> None:
    one = person(34, 0.172)
    found = measure_hand([scaled(each, 1.0) for each in one.points], rig, "right")
    assert not found.quality["palm_from_corners"]
    assert abs(found.length_m - 0.172) <= 2e-3 * found.quality["length"]["sd_mm"]
    assert found.quality["length"]["sd_mm"] > 3.0


def test_recorded_hand_is_an_adults(tmp_path: Path, shared_data: Path) -> None:
    thesis = shared_data / "thesis_rig"
    rig = make_rig(tmp_path, thesis_cameras(thesis))
    fusion = FusionCore(rig)
    frames = marker_track_frames(rig, load_recording(thesis / "recordings" / "hand_recovered"))
    # The first 50 s: they show the hand at its flattest.
    points = [found for frame in islice(frames, 3000) for _, found in fusion.feed(frame) if isinstance(found, PointSet)]
    hand = measure_hand(points, rig, "right")
    assert 0.160 < hand.length_m < 0.215
    for finger in FINGERS[1:]:
        assert 0.05 < sum(hand.bones_m[joint] for joint in CHAINS[finger][-3:]) < 0.12
    assert not hand.quality["palm_from_corners"]
