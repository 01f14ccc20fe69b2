from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from rhot_capture.detection.blob import PADDING_PX
from rhot_capture.detection.subpixel.batch import find_centres
from rhot_capture.detection.subpixel.windows import BlobWindow, Centre


def window_of(mask: Any) -> tuple[slice, slice]:
    """Rows and columns of the window that the detector cuts about a mask."""
    v, u = np.nonzero(mask)
    top, left = max(v.min() - PADDING_PX, 0), max(u.min() - PADDING_PX, 0)
    return slice(top, v.max() + PADDING_PX + 1), slice(left, u.max() + PADDING_PX + 1)


def centre_in(image: Any, mask: Any, round_part: bool = False) -> Centre:
    """The centre of what a mask shows, measured in a window as the detector cuts it, in the picture's coordinates."""
    part = window_of(mask)
    (centre,) = find_centres([BlobWindow(image[part], mask[part], round_part)])
    return centre._replace(u=centre.u + part[1].start, v=centre.v + part[0].start)


def share_in(image: Any, mask: Any) -> Any:
    """The painted share of every pixel, 0 outside of the window."""
    part = window_of(mask)
    (centre,) = find_centres([BlobWindow(image[part], mask[part])])
    share = np.zeros(mask.shape, np.float32)
    rows, columns = np.indices(mask[part].shape, np.float32)
    assert centre.shares is not None
    share[part] = centre.shares.at(np.dstack(centre.shares.on_grid((columns, rows))))
    return share


def hard_mask(image: Any, paint: tuple[float, float, float], radius: float) -> Any:
    near = np.linalg.norm(image[..., ::-1].astype(float) - paint, axis=-1) < radius
    return np.where(near, 255, 0).astype(np.uint8)


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-1.5, 1.5))
@settings(deadline=None, max_examples=25)
def test_moving_the_paint_moves_the_centre_alike(
    scene: Callable[..., Any], shape: type[Any], paints: Any, du: float, dv: float, angle: float
) -> None:
    centres = []
    for move_u, move_v in ((0.0, 0.0), (du, dv)):
        drawn = scene([shape("index", 30 + move_u, 30 + move_v, angle=angle)], size=(61, 61))
        mask = hard_mask(drawn.image, paints["index"], 60)
        centre = centre_in(drawn.image, mask)
        truth = drawn.truth["index"]
        centres.append((centre.u, centre.v, truth[0], truth[1]))
    (u0, v0, true_u0, true_v0), (u1, v1, true_u1, true_v1) = centres
    assert u1 - u0 == pytest.approx(true_u1 - true_u0, abs=0.04)
    assert v1 - v0 == pytest.approx(true_v1 - true_v0, abs=0.04)


@pytest.mark.parametrize("blur", [0.4, 0.7, 1.0])
@pytest.mark.parametrize("name", ["thumb", "middle", "ring"])
def test_skin_on_one_side_does_not_pull_the_centre(
    scene: Callable[..., Any], shape: type[Any], paints: Any, name: str, blur: float
) -> None:
    drawn = scene([shape(name, 30.3, 29.8)], size=(61, 61), blur=blur)
    centre = centre_in(drawn.image, hard_mask(drawn.image, paints[name], 60))
    u, v, area = drawn.truth[name]
    assert np.hypot(centre.u - u, centre.v - v) < 0.1
    assert centre.area == pytest.approx(area, rel=0.02)


@pytest.mark.parametrize("grow", [-1, 1])
def test_a_mask_too_small_or_large_by_a_pixel_does_not_matter(
    scene: Callable[..., Any], shape: type[Any], paints: Any, grow: int
) -> None:
    import cv2

    drawn = scene([shape("ring", 30.4, 30.2)], size=(61, 61))
    mask = hard_mask(drawn.image, paints["ring"], 60)
    changed = (cv2.dilate if grow > 0 else cv2.erode)(mask, np.ones((3, 3), np.uint8))
    centre = centre_in(drawn.image, np.asarray(changed, dtype=np.uint8))
    u, v, area = drawn.truth["ring"]
    assert np.hypot(centre.u - u, centre.v - v) < 0.08
    assert centre.area == pytest.approx(area, rel=0.04)


@pytest.mark.parametrize("radius", [7, 10, 20])
def test_shares_are_zero_outside_and_one_inside(
    scene: Callable[..., Any], shape: type[Any], paints: Any, radius: int
) -> None:
    drawn = scene([shape("ring", 50, 50, radius=radius)], size=(101, 101), noise=3.0)
    share = share_in(drawn.image, hard_mask(drawn.image, paints["ring"], 60))
    assert np.allclose(share[48:53, 48:53], 1.0, atol=0.15)
    assert np.mean(share[48:53, 48:53]) == pytest.approx(1.0, abs=0.03)
    assert np.all(share[:15] == 0.0), "outside of the window"
    assert np.mean(share[50 - int(1.4 * radius) - 5 : 50 - int(1.4 * radius) - 2, 45:55]) == pytest.approx(
        0.0, abs=0.03
    )


@pytest.mark.parametrize("radius", [16, 24, 45])
def test_large_parts_are_measured_as_well_on_a_coarser_grid(
    scene: Callable[..., Any], shape: type[Any], paints: Any, radius: int
) -> None:
    for kind in ("ellipse", "rectangle"):
        drawn = scene([shape("ring", 100.3, 99.6, radius=radius, kind=kind)], size=(201, 201), noise=3.0)
        centre = centre_in(drawn.image, hard_mask(drawn.image, paints["ring"], 60))
        u, v, area = drawn.truth["ring"]
        assert np.hypot(centre.u - u, centre.v - v) < 0.1
        assert centre.area == pytest.approx(area, rel=0.01)


@pytest.mark.parametrize("side", [0, 1, 2, 3])
def test_a_large_part_at_the_border_keeps_all_that_is_seen_of_it(side: int) -> None:
    image = np.full((101, 101, 3), (32, 30, 30), np.uint8)
    image[60:, 30:71] = (200, 60, 40)
    mask = np.zeros((101, 101), np.uint8)
    mask[60:, 30:71] = 255
    centre = centre_in(np.ascontiguousarray(np.rot90(image, side)), np.ascontiguousarray(np.rot90(mask, side)))
    v, u = np.nonzero(np.rot90(mask, side))
    assert (centre.u, centre.v) == pytest.approx((u.mean(), v.mean()), abs=0.1)
    assert centre.area == pytest.approx(41 * 41, rel=0.01)


def test_paint_like_its_surroundings_falls_back_to_the_mask() -> None:
    image = np.full((40, 40, 3), 90, np.uint8)
    mask = np.zeros((40, 40), np.uint8)
    mask[10:20, 12:22] = 255
    centre = centre_in(image, mask)
    assert (centre.u, centre.v, centre.area) == (16.5, 14.5, 100.0)


def test_a_window_without_surroundings_falls_back_to_the_mask() -> None:
    image = np.random.default_rng(0).integers(0, 255, (12, 12, 3), dtype=np.uint8)
    centre = centre_in(image, np.full((12, 12), 255, np.uint8))
    assert (centre.u, centre.v, centre.area) == (5.5, 5.5, 144.0)


@pytest.mark.parametrize("radius", [1.6, 2.2, 3.0])
def test_tiny_markers_have_a_centre_too(
    scene: Callable[..., Any], shape: type[Any], paints: Any, radius: float
) -> None:
    drawn = scene([shape("index", 20.3, 20.6, radius=radius, on_skin=False)], size=(41, 41))
    centre = centre_in(drawn.image, hard_mask(drawn.image, paints["index"], 110))
    u, v, _ = drawn.truth["index"]
    assert np.hypot(centre.u - u, centre.v - v) < 0.12


def test_a_dark_edge_of_a_round_part_pulls_the_centre_less() -> None:
    # A disc whose shaded ring is dark against black cloth, cut off on one side where it meets bright skin.
    v, u = np.mgrid[0:41, 0:41].astype(float)
    radius = np.hypot(u - 20.0, v - 20.0)
    painted = (radius < 9.0) & (v >= 17)
    image = np.zeros((41, 41, 3), np.uint8)
    image[(radius < 9.0) & (v < 17)] = (140, 170, 215)
    image[painted] = (200, 60, 40)
    image[painted & (radius > 7.0)] = (160, 48, 32)
    mask = np.where(painted, 255, 0).astype(np.uint8)
    true_v = float(v[painted].mean())
    plain, rounded = centre_in(image, mask), centre_in(image, mask, round_part=True)
    assert abs(rounded.v - true_v) < 0.5 * abs(plain.v - true_v)


def test_blobs_measured_together_are_what_they_are_alone(
    scene: Callable[..., Any], shape: type[Any], paints: Any
) -> None:
    windows = []
    for index, (name, radius) in enumerate((("ring", 11.0), ("index", 3.0), ("thumb", 7.0), ("little", 2.5))):
        drawn = scene([shape(name, 24.3, 25.6, radius=radius)], size=(47 + 3 * index, 51), noise=3.0, seed=index)
        windows.append(BlobWindow(drawn.image, hard_mask(drawn.image, paints[name], 70), True))
    for together, window in zip(find_centres(windows), windows, strict=True):
        (alone,) = find_centres([window])
        assert (together.u, together.v) == pytest.approx((alone.u, alone.v), abs=1e-3)
        assert together.area == pytest.approx(alone.area, rel=1e-4)


def test_nothing_to_measure_gives_nothing() -> None:
    assert find_centres([]) == []


@given(st.integers(0, 2**31 - 1))
@example(110773)  # one pixel of paint in a small window, measured together with larger ones
@settings(deadline=None, max_examples=60)
def test_garbage_has_a_centre_in_its_window(seed: int) -> None:
    rng = np.random.default_rng(seed)
    windows = []
    for _ in range(int(rng.integers(1, 5))):
        height, width = rng.integers(3, 70, 2).tolist()
        image = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
        mask = np.where(rng.random((height, width)) < rng.uniform(0.05, 1.0), 255, 0).astype(np.uint8)
        mask[height // 2, width // 2] = 255
        if rng.integers(3) == 0:
            mask[:] = 0
            mask[height // 2, width // 2] = 255
        windows.append(BlobWindow(image, mask, bool(rng.integers(2))))
    for window, centre in zip(windows, find_centres(windows), strict=True):
        height, width = window.mask.shape
        assert -5.0 < centre.u < width + 5.0
        assert -5.0 < centre.v < height + 5.0
        assert 0.0 < centre.area <= 1.3 * height * width
