from __future__ import annotations

import pytest

from rhot.errors import ConfigError
from rhot_calibration.colors.picking.picks import Box, parse_places


def test_picks_and_boxes_name_their_picture() -> None:
    places = parse_places(
        ["thumb=1,2", "ring=3.5, 4@2", "thumb=5,6@right"], ["index=7,8,20,30", "little=1,2,3,4@2"], ["left", "right"]
    )
    assert places == [
        {"thumb": (1.0, 2.0), "index": Box(7.0, 8.0, 20.0, 30.0)},
        {"ring": (3.5, 4.0), "thumb": (5.0, 6.0), "little": Box(1.0, 2.0, 3.0, 4.0)},
    ]


def test_the_middle_of_a_box_is_the_middle_of_its_pixels() -> None:
    assert Box(10.0, 20.0, 3.0, 5.0).middle == (11.0, 22.0)


@pytest.mark.parametrize(
    ("picks", "boxes", "words"),
    [
        (["thumb"], [], "--pick thumb: not NAME=U,V"),
        ([], ["thumb=1,2"], "--box thumb=1,2: not NAME=U,V,W,H"),
        (["thumb=1,2@0"], [], "no picture 0; say @1 = left, @2 = right, @3 = right"),
        (["thumb=1,2@top"], [], "no picture top"),
        (["thumb=1,2@right"], [], "2 pictures are called right; say @2 or @3"),
        (["thumb=1,2"], ["thumb=1,2,9,9@left"], r"picked twice in picture 1 \(left\)"),
    ],
)
def test_wrong_places_are_named(picks: list[str], boxes: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        parse_places(picks, boxes, ["left", "right", "right"])
