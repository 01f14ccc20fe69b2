from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from rhot.errors import ConfigError
from rhot_capture.detection.cutouts import marker_mask
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.preview import mark_positions, preview_jpeg, preview_png


def decoded(data: bytes) -> Any:
    assert data[:4] in (b"\xff\xd8\xff\xe0", b"\x89PNG")
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)


def test_plain_preview_is_the_frame(scene: Any, shape: Any) -> None:
    image = scene([shape("ring", 60, 60)], size=(121, 121)).image
    shown = decoded(preview_jpeg(image))
    assert shown.shape == image.shape
    assert np.abs(shown.astype(int) - image).mean() < 4.0


def test_lossless_preview_is_the_frame_to_the_bit(scene: Any, shape: Any) -> None:
    image = scene([shape("ring", 60, 60)], size=(121, 121)).image
    assert np.array_equal(decoded(preview_png(image)), image)


def test_overlay_marks_the_centre_and_leaves_the_frame_alone(scene: Any, shape: Any, markers: Any, table: Any) -> None:
    image = scene([shape("base", 60, 60, kind="rectangle")], size=(121, 121)).image
    kept = image.copy()
    found = MarkerDetector(markers, table, 121, 121).detect(image)
    shown = decoded(preview_jpeg(image, found))
    assert np.array_equal(image, kept)
    assert shown[60, 60].min() > 200
    assert np.abs(shown.astype(int) - image).mean() > 1.0


def test_mask_darkens_everything_else(scene: Any, shape: Any, table: Any) -> None:
    image = scene([shape("ring", 60, 60)], size=(121, 121)).image
    mask = marker_mask(image, table, "ring")
    assert set(np.unique(mask)) == {0, 255}
    shown = decoded(preview_jpeg(image, mask=mask))
    assert shown[60, 60, 0] > 150
    assert shown[45, 60].max() < 90


def test_unknown_marker_is_named(table: Any) -> None:
    with pytest.raises(ConfigError, match=r"mask=nose.*thumb"):
        marker_mask(np.zeros((2, 2, 3), np.uint8), table, "nose")


def test_texts_do_not_cover_one_another() -> None:
    apart, together = np.zeros((200, 300, 3), np.uint8), np.zeros((200, 300, 3), np.uint8)
    for text, place in {"index": (50.0, 50.0), "middle": (60.0, 130.0)}.items():
        mark_positions(apart, {text: place})
    mark_positions(together, {"index": (50.0, 50.0), "middle": (60.0, 51.0)})
    # Crosses and texts one upon the other would leave far fewer bright pixels.
    assert np.count_nonzero(together == 255) > 0.9 * np.count_nonzero(apart == 255)
