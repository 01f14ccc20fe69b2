from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rhot.geometry.hull import Region
from rhot_capture.detection.blob import blobs_of
from rhot_capture.detection.candidates import MIN_PLAUSIBILITY, Candidate, judge
from rhot_capture.detection.color_table import ColorTable
from rhot_capture.detection.cutouts import Cutouts
from rhot_capture.detection.track import MarkerTrack


@pytest.mark.parametrize("room", [1, 3, 8])
def test_a_candidate_is_the_same_however_little_of_its_surroundings_was_cut_out(
    scene: Any, shape: Any, table: ColorTable, room: int
) -> None:
    image = scene([shape("ring", 60, 60, radius=8)], size=(121, 121), noise=3.0).image
    found = []
    for margin in (30, room):
        whole = Region(52 - margin, 49 - margin, 69 + margin, 72 + margin)
        cutouts = Cutouts(image, table, [(4, whole)])
        ((blob,),) = blobs_of(cutouts.own, cutouts.parts, [(12.0, 4000.0)], (121, 121))
        candidate = judge(cutouts, blob, 4, 12.0, MarkerTrack(), alone=True)
        assert isinstance(candidate, Candidate)
        found.append(candidate)
    wide, tight = found
    assert np.array_equal(wide.blob.mask, tight.blob.mask)
    assert (wide.blob.x0, wide.blob.y0) == (tight.blob.x0, tight.blob.y0)
    assert tight.evidence == pytest.approx(wide.evidence)
    assert tight.plausibility == pytest.approx(wide.plausibility)
    assert tight.plausibility >= MIN_PLAUSIBILITY
