"""What goes out of what is there, predicted, or gone."""

from __future__ import annotations

import dataclasses

import pytest
from bridged import poses as bridge_poses

from rhot.rig import BridgeConfig
from rhot_bridge.newest import MOST_KEYS, Newest
from rhot_bridge.scene import Scene

KEY = "rhot/hand/left"
HAND = bridge_poses.hand("flat", "left")
PREDICTED = dataclasses.replace(HAND, state="predicted", t_ns=HAND.t_ns + 1)


def newest(**settings: object) -> Newest:
    return Newest(BridgeConfig.model_validate({"target": "json", "absent_after_s": 0.25, "fade_s": 0.5, **settings}))


def ns(seconds: float) -> int:
    return round(seconds * 1e9)


def test_the_newest_of_each_key_goes_to_its_place() -> None:
    kept = newest()
    for key in ("rhot/hand/left", "rhot/hand/right"):
        kept.put(key, HAND, 0)
    for key in ("rhot/object/cube", "rhot/head", "rhot/foot/left"):
        kept.put(key, bridge_poses.thing((0.0, 0.0, 0.0)), 0)
    kept.put(KEY, dataclasses.replace(HAND, t_ns=HAND.t_ns + 7), 1)
    scene = kept.scene(2)
    assert set(scene.hands) == {"left", "right"}
    assert scene.hands["left"].t_ns == scene.t_ns == HAND.t_ns + 7
    assert list(scene.objects) == ["cube"]
    assert list(scene.feet) == ["left"]
    assert scene.head is not None
    assert Scene("rig").empty
    assert not scene.empty


@pytest.mark.parametrize(
    ("absent", "weights"),
    [("keep", (1.0, 1.0, 1.0)), ("fade", (1.0, 0.5, None)), ("stop", (1.0, None, None))],
)
def test_what_is_gone_is_kept_faded_or_not_sent(absent: str, weights: tuple[float | None, ...]) -> None:
    kept = newest(absent=absent)
    kept.put(KEY, HAND, 0)
    for at_s, weight in zip((0.25, 0.5, 0.76), weights, strict=True):
        hand = kept.scene(ns(at_s)).hands.get("left")
        assert (None if hand is None else hand.weight) == (weight if weight is None else pytest.approx(weight))
        if hand is not None:
            assert hand.state == ("measured" if at_s <= 0.25 else "kept")


def test_fading_asks_for_more_frames_while_it_lasts() -> None:
    kept = newest()
    kept.put(KEY, HAND, 0)
    for at_s, fading in ((0.2, False), (0.4, True), (0.9, False)):
        kept.scene(ns(at_s))
        assert kept.fading is fading


def test_what_is_predicted_counts_as_gone_where_that_is_wanted() -> None:
    kept = newest(predicted="absent")
    kept.put(KEY, HAND, 0)
    kept.put(KEY, PREDICTED, ns(0.2))
    assert kept.scene(ns(0.2)).hands["left"].t_ns == HAND.t_ns
    assert kept.scene(ns(0.5)).hands["left"].weight == pytest.approx(0.5)
    sent = newest()
    sent.put(KEY, PREDICTED, 0)
    assert sent.scene(0).hands["left"].state == "predicted"


def test_strangers_keys_take_no_more_room_than_there_is() -> None:
    kept = newest()
    for number in range(2 * MOST_KEYS):
        kept.put(f"rhot/object/{number}", bridge_poses.thing((0.0, 0.0, 0.0)), 0)
    assert len(kept.scene(0).objects) == MOST_KEYS
    kept.clear()
    assert kept.scene(0).empty


def test_what_is_only_kept_makes_room_for_what_is_there() -> None:
    kept = newest(absent="keep")
    thing = bridge_poses.thing((0.0, 0.0, 0.0))
    for number in range(MOST_KEYS):
        kept.put(f"rhot/object/{number}", thing, 0)
    kept.put("rhot/object/0", thing, ns(0.5))
    kept.put("rhot/object/cup", thing, ns(0.5))
    names = kept.scene(ns(0.5)).objects.keys()
    assert "cup" in names
    assert "1" not in names, "silent longest"
    assert len(names) == MOST_KEYS
