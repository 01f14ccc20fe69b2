"""Paints that two hands share: what `rig.toml` may say of them."""

from __future__ import annotations

import pytest

from rhot.anatomy.markers import own_paints, worn_paints
from rhot.rig import MarkerConfig
from rhot.rig.sections import check_shared_paints

PATCH = {"kind": "patch", "joint": "wrist", "size_m": (0.04, 0.03)}


def markers(**changed: dict[str, object]) -> dict[str, MarkerConfig]:
    """Return the markers of two hands, some of them changed."""
    plain: dict[str, dict[str, object]] = {
        "thumb": {"joint": "thumb_tip"},
        "index": {"joint": "index_tip"},
        "base": dict(PATCH),
        "left_thumb": {"joint": "thumb_tip", "hand": "left", "paint_of": "index"},
        "left_index": {"joint": "index_tip", "hand": "left"},
        "left_base": {**PATCH, "hand": "left"},
    }
    return {name: MarkerConfig.model_validate({**plain[name], **changed.get(name, {})}) for name in plain}


def test_paints_are_named_after_the_marker_that_owns_them() -> None:
    both = markers()
    check_shared_paints(both)
    assert list(own_paints(both)) == ["thumb", "index", "base", "left_index", "left_base"]
    assert worn_paints(both)["left_thumb"] == "index"
    assert worn_paints(both)["thumb"] == "thumb"


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"left_thumb": {"paint_of": "nose"}}, "markers.left_thumb: paint_of must name"),
        ({"left_thumb": {"paint_of": "left_index"}}, "markers.left_thumb: paint_of must name"),
        ({"left_index": {"paint_of": "index"}}, "each of them once"),
        ({"left_index": {"paint_of": "left_thumb"}}, "markers.left_index: paint_of must name"),
        ({"left_base": {"paint_of": "base"}}, "a patch of a paint of its own on each hand"),
        ({"base": {"kind": "ball"}}, "a patch of a paint of its own on each hand"),
    ],
)
def test_hands_that_could_not_be_told_apart_are_refused(changed: dict[str, dict[str, object]], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        check_shared_paints(markers(**changed))
