from __future__ import annotations

from typing import Any

import numpy as np

from rhot_calibration.colors.calibration import calibrate
from rhot_calibration.colors.report.picture import report_picture
from rhot_calibration.colors.report.plot import share_text
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector


def test_report_of_several_pictures_and_one_marker_grows_with_them(scene: Any, six_shapes: Any, markers: Any) -> None:
    drawn = [scene(six_shapes(seed), noise=2.0) for seed in (0, 1)]
    images = [each.image for each in drawn]
    kept = [image.copy() for image in images]
    places = [{name: (u, v) for name, (u, v, _) in each.truth.items() if name != "base"} for each in drawn]
    result = calibrate(images, places, markers)
    table = build_color_table(result.colors, list(markers))
    found = [MarkerDetector(markers, table, 640, 480).detect(image) for image in images]
    plain = report_picture(images, ["a", "b"], result, [table, table], found)
    longer = report_picture(images, ["a", "b"], result, [table, table], found, ["warning: words " * 60])
    assert plain.shape[1] == longer.shape[1] == 1280
    assert plain.dtype == np.uint8
    assert all(np.array_equal(image, before) for image, before in zip(images, kept, strict=True))
    # Two overlays side by side, five masks in two rows, plot and table.
    assert 480 + 2 * 240 + 640 < plain.shape[0] <= 480 + 2 * 240 + 640 + 3 * 26
    # The picture shows the paint of the first marker somewhere in its own mask tile, and dark surroundings.
    tile = plain[26 + 480 + 26 : 26 + 480 + 26 + 240, :320]
    assert np.median(tile) < 10
    assert tile[..., 1].max() > 80


def test_shares_are_short() -> None:
    assert [share_text(share) for share in (0.0, 0.0004, 0.014, 0.096, 0.11, 1.0)] == [
        "", "<.1", "1.4", "9.6", "11", "100",
    ]  # fmt: skip
