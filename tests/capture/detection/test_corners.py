from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

from rhot_capture.detection.detector import MarkerDetector


def corner_errors(found: Any, true: Any) -> Any:
    """Distance of each found corner from its true one, for the best cyclic assignment."""
    return min((np.linalg.norm(found - np.roll(true, turn, axis=0), axis=1) for turn in range(4)), key=np.max)


@pytest.mark.parametrize(("noise", "limit_px"), [(0.0, 0.1), (3.0, 0.25)])
def test_corners_are_sub_pixel(
    scene: Callable[..., Any], shape: type[Any], markers: Any, table: Any, noise: float, limit_px: float
) -> None:
    errors = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        patch = shape(
            "base",
            60 + rng.uniform(-0.5, 0.5),
            60 + rng.uniform(-0.5, 0.5),
            radius=rng.uniform(6, 12),
            angle=rng.uniform(-1.5, 1.5),
            kind="rectangle",
        )
        drawn = scene([patch], size=(121, 121), blur=rng.uniform(0.5, 1.0), noise=noise, seed=seed)
        detection = MarkerDetector(markers, table, 121, 121).detect(drawn.image)["base"]
        assert detection.corners is not None, f"seed {seed}"
        errors.extend(corner_errors(detection.corners, patch.corners))
    assert np.percentile(errors, 95) < limit_px


def test_order_is_clockwise_from_the_upper_left(
    scene: Callable[..., Any], shape: type[Any], markers: Any, table: Any
) -> None:
    drawn = scene([shape("base", 60, 60, radius=10, angle=0.1, kind="rectangle")], size=(121, 121))
    corners = MarkerDetector(markers, table, 121, 121).detect(drawn.image)["base"].corners
    assert corners is not None
    u, v = corners.T
    assert np.sum(u * np.roll(v, -1) - np.roll(u, -1) * v) > 0
    assert np.argmin(corners.sum(axis=1)) == 0
    assert not corners.flags.writeable


def test_foreshortened_patch_keeps_its_own_angles(markers: Any, table: Any, paints: Any) -> None:
    true = np.array([[30.0, 34.0], [85.0, 28.0], [83.0, 66.0], [34.0, 68.0]])
    fine = np.zeros((121 * 8, 121 * 8, 3), np.uint8)
    cv2.fillPoly(fine, [np.rint((true + 0.5) * 8 - 0.5).astype(np.int32)], paints["base"][::-1])
    image = cv2.GaussianBlur(cv2.resize(fine, (121, 121), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    corners = MarkerDetector(markers, table, 121, 121).detect(np.asarray(image, np.uint8))["base"].corners
    assert corners is not None
    assert corner_errors(corners, true).max() < 0.3


def test_a_round_blob_has_no_corners(scene: Callable[..., Any], shape: type[Any], markers: Any, table: Any) -> None:
    drawn = scene([shape("base", 60, 60, radius=12)], size=(121, 121))
    assert MarkerDetector(markers, table, 121, 121).detect(drawn.image)["base"].corners is None


def test_a_patch_cut_by_the_border_has_no_corners(
    scene: Callable[..., Any], shape: type[Any], markers: Any, table: Any
) -> None:
    drawn = scene([shape("base", 4, 60, radius=10, kind="rectangle")], size=(121, 121))
    assert MarkerDetector(markers, table, 121, 121).detect(drawn.image)["base"].corners is None


def test_what_hides_a_corner_is_no_side(scene: Callable[..., Any], shape: type[Any], markers: Any, table: Any) -> None:
    for turn in (0.4, 0.8, 1.2):
        drawn = scene([shape("base", 60, 60, radius=11, kind="rectangle")], size=(121, 121))
        image = drawn.image.copy()
        v, u = np.mgrid[0:121, 0:121]
        image[(u - 60) * np.cos(turn) + (v - 60) * np.sin(turn) > 9.0] = (140, 170, 215)
        detection = MarkerDetector(markers, table, 121, 121).detect(image)["base"]
        assert detection.corners is None


@pytest.mark.parametrize("motion_px", [2, 4])
def test_corners_of_a_smeared_patch_are_those_at_mid_exposure(
    scene: Callable[..., Any], shape: type[Any], markers: Any, table: Any, motion_px: int
) -> None:
    moments = np.linspace(-0.5, 0.5, 9) * motion_px
    patches = [shape("base", 60 + move, 60, radius=10, angle=0.3, kind="rectangle") for move in moments]
    pictures = [scene([patch], size=(121, 121)).image.astype(float) for patch in patches]
    image = np.rint(np.mean(pictures, axis=0)).astype(np.uint8)
    corners = MarkerDetector(markers, table, 121, 121).detect(image)["base"].corners
    assert corners is not None
    assert corner_errors(corners, patches[4].corners).max() < 0.4


def test_corners_of_a_turning_patch_are_followed_as_well_as_found_afresh(
    scene: Callable[..., Any], shape: type[Any], markers: Any, table: Any
) -> None:
    following = MarkerDetector(markers, table, 121, 121)
    for frame in range(6):
        # The last one has turned too far for the one before to tell where the corners are.
        angle = 0.1 * frame if frame < 5 else 1.4
        patch = shape("base", 55 + 1.3 * frame, 60, radius=9, angle=angle, kind="rectangle")
        corners = following.detect(scene([patch], size=(121, 121)).image)["base"].corners
        assert corners is not None
        assert corner_errors(corners, patch.corners).max() < 0.15
        assert np.argmin(corners.sum(axis=1)) == 0
