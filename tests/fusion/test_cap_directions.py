"""What hides a part of a painted fingertip from one camera more than from the other, and what that does to depth."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from marker_streams import MARKERS, models
from numpy.typing import NDArray

from rhot.hand import HandModel
from rhot.messages import HandPose, Joint
from rhot.rig import Rig
from rhot_fusion.cap_directions import CapDirections
from rhot_fusion.sightings import Sightings

MakeRig = Callable[..., Rig]

INDEX = MARKERS.index("index")
ONE = np.array([INDEX])
PLACE = np.array([0.0375, 0.0, 0.8])
KNOWN = np.tile([*PLACE, 0.0, 0.0, 0.0], (len(MARKERS), 1))
ALL = np.ones(len(MARKERS), dtype=bool)


@pytest.fixture
def caps(make_rig: MakeRig) -> CapDirections:
    """The index finger points across the view, upwards in the picture."""
    rig = make_rig()
    caps = CapDirections(models(rig), rig.config.markers, {"right": HandModel.from_file(rig.hand, "right")})
    joints = {
        name: Joint(position=(0.0375, y, 0.8), orientation=(0.0, 0.0, 0.0, 1.0), radius=0.008)
        for name, y in (("index_distal", 0.02), ("index_tip", 0.0))
    }
    caps.learn(
        HandPose(t_ns=1, seq=0, side="right", frame="rig", joints=joints, angles={}, residual={}, state="measured")
    )
    return caps


def look(caps: CapDirections, camera: int, area_px: float) -> NDArray[np.float64]:
    """Let a camera report an area until it is believed; return the last shift, pixels."""
    x = (PLACE[0] - 0.075 * camera) / PLACE[2]
    for _ in range(60):
        seen = Sightings(camera, 0.0, ONE, np.zeros(1), np.array([[x, 0.0]]), np.array([area_px]))
        shift = caps.hidden_shift(seen, KNOWN, ALL)
    last: NDArray[np.float64] = shift[0] * 530.0
    return last


def test_views_of_the_same_area_are_not_moved(caps: CapDirections) -> None:
    look(caps, 0, 90.0)
    assert np.abs(look(caps, 1, 91.0)).max() < 1e-9
    assert np.abs(look(caps, 0, 90.0)).max() < 1e-9


def test_the_view_that_shows_less_is_moved_away_from_the_other(caps: CapDirections) -> None:
    look(caps, 0, 100.0)
    shift = look(caps, 1, 70.0)
    # Of the right camera: to the right, which takes the marker away, behind what hides it.
    assert 0.3 < shift[0] < 3.0
    assert abs(shift[1]) < 1e-9
    assert np.abs(look(caps, 0, 100.0)).max() < 1e-9
    shift = look(caps, 0, 40.0)
    assert -5.0 < shift[0] < -0.3


def test_what_is_hidden_is_less_sure(caps: CapDirections) -> None:
    for camera in (0, 1):
        look(caps, camera, 500.0)
    whole = caps.sigmas()[INDEX]
    look(caps, 0, 10.0)
    assert caps.sigmas()[INDEX] > 3.0 * whole
    assert caps.sigmas()[MARKERS.index("base")] == 0.0


def test_nothing_is_moved_while_no_direction_is_known(caps: CapDirections) -> None:
    caps.clear()
    look(caps, 0, 100.0)
    assert np.abs(look(caps, 1, 10.0)).max() == 0.0
