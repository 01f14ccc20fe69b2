"""Why blobs are accepted or rejected: each reason on a picture that causes it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated_take import simulated_rig

from rhot.arrays import ImageArray
from rhot.rig import Rig
from rhot_bench.speed.simulated import Cameras, Moment, moments, world_of
from rhot_capture.explain import PictureExplainer

# In one worker: what they share takes seconds.
pytestmark = pytest.mark.xdist_group("explained pictures")


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Rig:
    return simulated_rig(tmp_path_factory.mktemp("explain") / "rig")


@pytest.fixture(scope="module")
def pictures(rig: Rig) -> list[ImageArray]:
    """Three pictures in a row of the left camera: an open hand."""
    cameras = Cameras(rig, world_of(rig))
    chosen: list[Moment] = [moment for moment in moments(rig, 0.5, 0.7) if moment.camera == "left"][:3]
    return [cameras.picture(moment) for moment in chosen]


def with_markers(rig: Rig, **areas: dict[str, float]) -> Rig:
    markers = {name: marker.model_copy(update=areas.get(name, {})) for name, marker in rig.config.markers.items()}
    return dataclasses.replace(rig, config=rig.config.model_copy(update={"markers": markers}))


def verdicts(rig: Rig, pictures: list[ImageArray]) -> dict[str, list[str]]:
    """Marker to the verdicts on its blobs in the last picture."""
    explainer = PictureExplainer(rig, "left")
    for picture in pictures[:-1]:
        explainer.detect(picture)
    found: dict[str, list[str]] = {}
    for row in explainer.explain(pictures[-1]).candidates.rows:
        found.setdefault(row.cells[0], []).append(row.cells[-1])
    return found


def test_detected_blobs_are_accepted(rig: Rig, pictures: list[ImageArray]) -> None:
    explainer = PictureExplainer(rig, "left")
    for picture in pictures[:-1]:
        explainer.detect(picture)
    explained = explainer.explain(pictures[-1])
    again = PictureExplainer(rig, "left")
    detections = [again.detect(picture) for picture in pictures][-1]
    accepted = {row.cells[0]: row for row in explained.candidates.rows if row.verdict == "accepted"}
    assert set(accepted) == set(detections) == set(rig.config.markers)
    for name, detection in detections.items():
        assert accepted[name].cells[1] == f"{detection.u:.2f}, {detection.v:.2f}"
        assert float(accepted[name].cells[7]) < 5.0, "from prediction, px"
    outlines = [outline for outline in explained.outlines if outline.verdict == "accepted"]
    for outline, detection in zip(outlines, detections.values(), strict=True):
        assert np.linalg.norm(outline.points.mean(axis=0) - (detection.u, detection.v)) < 3.0


def test_reasons(rig: Rig, pictures: list[ImageArray]) -> None:
    strict = with_markers(rig, thumb={"min_area_px": 900.0}, base={"max_area_px": 100.0})
    found = verdicts(strict, pictures)
    assert found["thumb"][0].startswith("too small")
    assert "min_area_px = 900" in found["thumb"][0]
    assert found["base"][0].startswith("too large")
    assert found["index"][0] == "accepted"
    dark = [np.zeros_like(pictures[0])]
    assert {reason for found in verdicts(rig, dark).values() for reason in found} == {
        "no blob of its colour in the picture"
    }


def test_a_second_blob_of_the_colour_is_rejected(rig: Rig, pictures: list[ImageArray]) -> None:
    doubled = [picture.copy() for picture in pictures]
    explainer = PictureExplainer(rig, "left")
    seen = explainer.detect(pictures[0])["base"]
    u, v = round(seen.u), round(seen.v)
    for picture in doubled:
        picture[20:36, 20:44] = picture[v - 8 : v + 8, u - 12 : u + 12]
    reasons = verdicts(rig, doubled)["base"]
    assert reasons.count("accepted") == 1
    assert any(reason.startswith("another blob") for reason in reasons)
