"""Blobs of paints of both hands are assigned by predicted positions; ambiguous ones are not assigned."""

from __future__ import annotations

import pytest

from rhot.rig import MarkerConfig
from rhot_capture.detection.hand.sharing import SharedPaints, Spot

MARKERS = {
    "ring": MarkerConfig(hand="right", joint="ring_tip"),
    "base": MarkerConfig(hand="right", joint="wrist", kind="patch", size_m=(0.04, 0.03)),
    "left_index": MarkerConfig(hand="left", joint="index_tip", paint_of="ring"),
    "left_base": MarkerConfig(hand="left", joint="wrist", kind="patch", size_m=(0.04, 0.03)),
}
PX_M = 600.0
APART = {"base": (200.0, 200.0), "left_base": (440.0, 200.0)}
"""Patches 0.4 m apart: further than a hand reaches."""
CROSSED = {"base": (300.0, 200.0), "left_base": (310.0, 205.0)}


def tip(u: float, v: float, width: float = 10.0) -> Spot:
    return Spot(u, v, width, 10.0, 10.0 * width, 1.0)


def patches(places: dict[str, tuple[float, float]]) -> dict[str, Spot]:
    return {name: Spot(u, v, 0.04 * PX_M, 0.03 * PX_M, 0.04 * 0.03 * PX_M**2, 1.0) for name, (u, v) in places.items()}


class Camera:
    """What the detector does with shared paints, for blobs that are given."""

    def __init__(self) -> None:
        self.sharing = SharedPaints(MARKERS)
        self.before: dict[str, tuple[float, float]] = {}

    def see(self, spots: list[Spot], hands: dict[str, tuple[float, float]]) -> dict[str, int]:
        self.sharing.see_patches(patches(hands))
        found = self.sharing.match("ring", spots, {name: self.before.get(name) for name in ("ring", "left_index")})
        self.before = {name: (spots[number].u, spots[number].v) for name, number in found.items()}
        self.sharing.remember({**hands, **self.before})
        return found


def test_separate_hands_are_identified_by_their_patches() -> None:
    spots = [tip(420.0, 280.0), tip(190.0, 290.0)]
    assert Camera().see(spots, APART) == {"ring": 1, "left_index": 0}
    assert Camera().see(spots[:1], APART) == {"left_index": 0}


def test_blob_that_may_be_either_gets_no_name() -> None:
    assert Camera().see([tip(305.0, 280.0)], CROSSED) == {}
    assert Camera().see([tip(305.0, 280.0), tip(330.0, 280.0)], CROSSED) == {}


def test_blob_beyond_the_reach_of_both_hands_gets_no_name() -> None:
    assert Camera().see([tip(600.0, 460.0)], {"base": (100.0, 60.0), "left_base": (160.0, 60.0)}) == {}


def test_names_stay_while_hands_cross() -> None:
    camera = Camera()
    for step in range(61):
        u = 4.0 * step
        hands = {"base": (200.0 + u, 200.0), "left_base": (440.0 - u, 205.0)}
        right, left = tip(190.0 + u, 290.0), tip(420.0 - u, 275.0)
        # The tips pass each other 15 px apart; which blob comes first says nothing.
        spots = [left, right] if step % 2 else [right, left]
        found = camera.see(spots, hands)
        assert {name: spots[number] for name, number in found.items()} == {"ring": right, "left_index": left}


def test_covered_tip_does_not_take_the_other_hands_name() -> None:
    camera = Camera()
    for _ in range(5):
        camera.see([tip(300.0, 280.0), tip(330.0, 290.0)], APART | CROSSED)
    camera = Camera()
    for _ in range(5):
        assert len(camera.see([tip(190.0, 290.0), tip(420.0, 280.0)], APART)) == 2
    # From one frame to the next the right tip is covered, and the left one stays.
    for _ in range(40):
        assert camera.see([tip(420.0, 280.0)], APART) == {"left_index": 0}


def test_touching_tips_of_one_paint_are_neither_hands() -> None:
    camera = Camera()
    hands = {"base": (250.0, 200.0), "left_base": (390.0, 200.0)}
    assert camera.see([tip(240.0, 290.0), tip(400.0, 290.0)], APART) == {"ring": 0, "left_index": 1}
    for step in range(1, 17):
        camera.see([tip(240.0 + 4.4 * step, 290.0), tip(400.0 - 4.4 * step, 290.0)], hands)
    assert camera.see([tip(320.0, 290.0, width=22.0)], hands) == {}


def test_tip_that_comes_back_beside_its_hand_is_named_again() -> None:
    camera = Camera()
    camera.see([tip(190.0, 290.0), tip(420.0, 280.0)], APART)
    for _ in range(30):
        camera.see([], APART)
    assert camera.see([tip(196.0, 284.0), tip(424.0, 286.0)], APART) == {"ring": 0, "left_index": 1}


@pytest.mark.parametrize("seen", [1.0, 0.3])
def test_patch_that_is_partly_covered_makes_its_hand_no_smaller(seen: float) -> None:
    camera = Camera()
    camera.see([], APART)
    small = patches(APART)
    small["base"] = small["base"]._replace(area=seen * small["base"].area)
    camera.sharing.see_patches(small)
    # A stretched finger: 0.165 m from its patch.
    assert camera.sharing.match("ring", [tip(200.0, 299.0)], {"ring": None, "left_index": None}) == {"ring": 0}
