"""What hides a part of a painted fingertip from one camera more than from the other, and what that does to depth."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest
from marker_streams import MARKERS, models
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.messages import HandPose, Joint, Side
from rhot.rig import Rig
from rhot_fusion.filter.cap_directions import CapDirections
from rhot_fusion.filter.cap_model import CapModel
from rhot_fusion.views.sightings import Sightings

MakeRig = Callable[..., Rig]

INDEX = MARKERS.index("index")
ONE = np.array([INDEX])
PLACE = np.array([0.0375, 0.0, 0.8])
KNOWN = np.tile([*PLACE, 0.0, 0.0, 0.0], (len(MARKERS), 1))
ALL = np.ones(len(MARKERS), dtype=bool)


def pose(hinge: tuple[float, float, float], tip: tuple[float, float, float]) -> HandPose:
    joints = {
        name: Joint(position=place, orientation=(0.0, 0.0, 0.0, 1.0), radius=0.008)
        for name, place in (("index_distal", hinge), ("index_tip", tip))
    }
    return HandPose(t_ns=1, seq=0, side="right", frame="rig", joints=joints, angles={}, residual={}, state="measured")


@pytest.fixture
def caps(make_rig: MakeRig) -> CapDirections:
    """The index finger points across the view, upwards in the picture."""
    rig = make_rig()
    caps = CapDirections(models(rig), rig.config.markers, {"right": HandModel.from_file(rig.hand, "right")})
    caps.learn(pose((0.0375, 0.02, 0.8), (0.0375, 0.0, 0.8)))
    return caps


def look(caps: CapDirections, camera: int, area_px: float, rounds: int = 20) -> NDArray[np.float64]:
    """Let a camera report an area until it is believed; return the last shift, pixels."""
    x = (PLACE[0] - 0.075 * camera) / PLACE[2]
    for _ in range(rounds):
        seen = Sightings(camera, 0.0, ONE, np.zeros(1), np.array([[x, 0.0]]), np.array([area_px]))
        shift, _ = caps.correct(seen, KNOWN, ALL)
    last: NDArray[np.float64] = shift[0] * 530.0
    return last


def test_views_of_the_same_area_keep_their_distance(caps: CapDirections) -> None:
    look(caps, 0, 80.0)
    right, left = look(caps, 1, 81.0), look(caps, 0, 80.0)
    assert abs(right[0] - left[0]) < 0.05
    # The finger lies across the view: what is seen is nearly the middle of the cap.
    assert np.abs(left).max() < 0.5


def test_the_area_tells_where_a_finger_points_that_was_solved_wrong(make_rig: MakeRig) -> None:
    """The finger points up in the picture and away, 45° and more; its solver believes that it is 20° less bent."""
    rig = make_rig()
    hands: dict[Side, HandModel] = {"right": HandModel.from_file(rig.hand, "right")}
    caps, model = CapDirections(models(rig), rig.config.markers, hands), CapModel(rig.config.markers, hands)
    for bend_deg in (45.0, 55.0, 65.0):
        caps.clear()
        true, solved = (np.array([0.0, -np.cos(a), np.sin(a)]) for a in np.radians([bend_deg, bend_deg - 20.0]))
        caps.learn(pose(tuple(PLACE - 0.02 * solved), tuple(PLACE)))
        errors = []
        for camera in (0, 1, 0, 1):
            away = PLACE - [0.075 * camera, 0.0, 0.0]
            cosine = float(-(true @ away) / np.linalg.norm(away))
            along, area = model.look_up(INDEX, cosine)
            seen = away + true * along
            xy, paint_px = seen[:2] / seen[2], np.array([0.9 * area * (530.0 / PLACE[2]) ** 2])
            shift, _ = caps.correct(Sightings(camera, 0.0, ONE, np.zeros(1), xy[None], paint_px), KNOWN, ALL)
            errors.append((xy + shift[0] - away[:2] / away[2]) * 530.0)
        assert np.hypot(*(xy - away[:2] / away[2])) * 530.0 > 1.0
        assert np.abs(errors[2:]).max() < 0.15
        assert abs(errors[3][0] - errors[2][0]) < 0.05


def test_the_view_that_shows_less_is_moved_away_from_the_other(caps: CapDirections) -> None:
    left = look(caps, 0, 80.0)
    # Of the right camera: to the right, which takes the marker away, behind what hides it.
    assert 0.3 < look(caps, 1, 56.0)[0] - left[0] < 3.0
    assert look(caps, 0, 80.0) == pytest.approx(left)
    right = look(caps, 1, 80.0)
    assert -5.0 < look(caps, 0, 32.0)[0] - right[0] < -0.3


def test_what_is_hidden_is_less_sure(caps: CapDirections) -> None:
    for camera in (0, 1):
        look(caps, camera, 80.0)
    whole = caps.sigmas()[INDEX]
    look(caps, 0, 10.0)
    assert caps.sigmas()[INDEX] > 3.0 * whole
    assert caps.sigmas()[MARKERS.index("base")] == 0.0


@pytest.mark.parametrize("area_px", [0.0, 20.0, 300.0, 5000.0])
def test_no_direction_however_wrong_moves_a_view_by_more_than_a_cap(make_rig: MakeRig, area_px: float) -> None:
    """A hand that was just found may point anywhere, also straight away from the cameras, where no paint would show."""
    rig = make_rig()
    for aside, along in itertools.product((-0.002, 0.0005, 0.003), (-0.02, -0.01, 0.01, 0.02)):
        caps = CapDirections(models(rig), rig.config.markers, {"right": HandModel.from_file(rig.hand, "right")})
        caps.learn(pose((0.0375, 0.0, 0.8), (0.0375 + aside, 0.001, 0.8 + along)))
        first, second = look(caps, 0, area_px, rounds=1), look(caps, 1, area_px, rounds=1)
        # 10 mm at 0.8 m; the difference is depth, 1 px being 16 mm.
        assert np.abs([first, second]).max() < 7.0
        assert abs(second[0] - first[0]) < 1.2


def test_a_direction_alone_changes_no_depth(caps: CapDirections) -> None:
    """Tracks that state no area."""
    caps.learn(pose((0.02, 0.01, 0.79), (0.0375, 0.0, 0.8)))
    assert abs(look(caps, 0, 0.0)[0] - look(caps, 1, 0.0)[0]) < 0.05


def test_nothing_is_moved_while_no_direction_is_known(caps: CapDirections) -> None:
    caps.clear()
    look(caps, 0, 100.0)
    assert np.abs(look(caps, 1, 10.0)).max() == 0.0
