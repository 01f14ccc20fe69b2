from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.track import find_regions

CLOTH = 30


def painted(size: tuple[int, int], boxes: Any, paints: Any) -> Any:
    image = np.full((size[1], size[0], 3), CLOTH, np.uint8)
    for name, left, top, width, height in boxes:
        image[top : top + height, left : left + width] = paints[name][::-1]
    return image


@given(st.integers(0, 95), st.integers(0, 75), st.integers(3, 12), st.integers(3, 12), st.booleans())
@settings(deadline=None, max_examples=60)
def test_whatever_holds_three_by_three_pixels_is_found_and_held(
    table: ColorTable, paints: Any, left: int, top: int, width: int, height: int, odd: bool
) -> None:
    size = (107 + odd, 87)
    image = painted(size, [("ring", left, top, width, height)], paints)
    ((label, region),) = find_regions(image, table.labels)
    assert label == 1 + list(paints).index("ring")
    assert region.left <= max(left - 6, 0)
    assert region.top <= max(top - 6, 0)
    assert region.right >= min(left + width + 6, size[0])
    assert region.bottom >= min(top + height + 6, size[1])


def test_each_colour_has_its_own_regions_also_where_they_touch(table: ColorTable, paints: Any) -> None:
    boxes = [("ring", 20, 20, 10, 10), ("index", 30, 20, 10, 10), ("ring", 120, 90, 8, 8)]
    found = find_regions(painted((160, 120), boxes, paints), table.labels)
    names = list(paints)
    assert sorted(label for label, _ in found) == sorted([1 + names.index(name) for name, *_ in boxes])
    (index_region,) = (region for label, region in found if label == 1 + names.index("index"))
    assert index_region.left >= 18, "no larger than its own colour and the room round it"


def test_parts_near_one_another_are_one_region(table: ColorTable, paints: Any) -> None:
    boxes = [("ring", 20, 20, 10, 10), ("ring", 33, 20, 10, 10)]
    assert len(find_regions(painted((160, 120), boxes, paints), table.labels)) == 1


def test_merged_regions_that_overlap_a_third_one_are_merged_again(table: ColorTable, paints: Any) -> None:
    # The last and smallest overlaps the first alone; what both span overlaps the second, which neither of them does.
    boxes = [("ring", 10, 10, 9, 92), ("ring", 45, 30, 40, 30), ("ring", 30, 95, 44, 5)]
    assert len(find_regions(painted((160, 120), boxes, paints), table.labels)) == 1


def test_an_empty_picture_has_no_region(table: ColorTable) -> None:
    assert find_regions(np.full((120, 160, 3), CLOTH, np.uint8), table.labels) == []


def test_speckle_everywhere_hides_no_marker_and_stays_bounded(table: ColorTable, paints: Any) -> None:
    image = painted((640, 480), [("ring", 300, 200, 20, 20)], paints)
    rng = np.random.default_rng(3)
    speckle = rng.random((480, 640)) < 0.02
    image[speckle] = paints["ring"][::-1]
    regions = [region for label, region in find_regions(image, table.labels) if label == 1 + list(paints).index("ring")]
    assert len(regions) <= 6
    assert any(one.left <= 294 and one.right >= 326 and one.top <= 194 and one.bottom >= 226 for one in regions)
