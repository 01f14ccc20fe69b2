from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rhot.errors import ConfigError
from rhot.rig.colors import RgbColor, nominal_colors
from rhot_capture.color_table import build_color_table
from rhot_capture.detector import MarkerDetector


@pytest.fixture
def detector(markers: Any, table: Any) -> MarkerDetector:
    return MarkerDetector(markers, table, 640, 480)


def errors_over_scenes(detector: MarkerDetector, scene: Any, six_shapes: Any, noise: float, count: int) -> Any:
    errors = []
    for seed in range(count):
        blur = 0.5 + 0.5 * (seed % 6) / 5.0
        drawn = scene(six_shapes(seed), blur=blur, noise=noise, seed=seed)
        detector.reset()
        found = detector.detect(drawn.image)
        assert set(found) == set(drawn.truth)
        errors += [np.hypot(found[name].u - u, found[name].v - v) for name, (u, v, _) in drawn.truth.items()]
    return np.array(errors)


def test_without_noise_every_centre_is_within_a_tenth_of_a_pixel(
    detector: MarkerDetector, scene: Any, six_shapes: Any
) -> None:
    errors = errors_over_scenes(detector, scene, six_shapes, noise=0.0, count=10)
    assert errors.max() < 0.1


def test_with_sensor_noise_centres_are_within_a_fifth_of_a_pixel(
    detector: MarkerDetector, scene: Any, six_shapes: Any
) -> None:
    errors = errors_over_scenes(detector, scene, six_shapes, noise=3.0, count=10)
    assert np.percentile(errors, 95) < 0.2


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
@settings(deadline=None, max_examples=20)
def test_a_sub_pixel_shift_moves_the_centre_by_as_much(
    scene: Any, shape: Any, markers: Any, table: Any, du: float, dv: float
) -> None:
    centres, truths = [], []
    for u, v in ((50.0, 50.0), (50.0 + du, 50.0 + dv)):
        drawn = scene([shape("ring", u, v)], size=(101, 101))
        found = MarkerDetector(markers, table, 101, 101).detect(drawn.image)["ring"]
        centres.append(np.array([found.u, found.v]))
        truths.append(np.array(drawn.truth["ring"][:2]))
    assert np.allclose(centres[1] - centres[0], truths[1] - truths[0], atol=0.03)


def test_area_is_the_painted_area(detector: MarkerDetector, scene: Any, six_shapes: Any) -> None:
    drawn = scene(six_shapes(3))
    found = detector.detect(drawn.image)
    for name, (_, _, area) in drawn.truth.items():
        assert found[name].area == pytest.approx(area, rel=0.03)


def test_a_moving_marker_is_reported_where_it_is_and_not_one_frame_further(
    detector: MarkerDetector, scene: Any, shape: Any
) -> None:
    for frame in range(6):
        drawn = scene([shape("index", 100 + 47.3 * frame, 200 - 20.6 * frame)])
        found = detector.detect(drawn.image)["index"]
        u, v, _ = drawn.truth["index"]
        assert np.hypot(found.u - u, found.v - v) < 0.1


def test_a_marker_out_of_sight_is_absent_and_back_at_once_anywhere(
    detector: MarkerDetector, scene: Any, shape: Any
) -> None:
    seen = scene([shape("index", 100, 100), shape("ring", 300, 300)])
    gone = scene([shape("ring", 300, 300)])
    back = scene([shape("index", 600, 450), shape("ring", 300, 300)])
    assert set(detector.detect(seen.image)) == {"index", "ring"}
    for _ in range(3):
        assert set(detector.detect(gone.image)) == {"ring"}
    found = detector.detect(back.image)["index"]
    assert np.hypot(found.u - back.truth["index"][0], found.v - back.truth["index"][1]) < 0.1


def test_an_empty_desk_shows_nothing(detector: MarkerDetector, scene: Any) -> None:
    assert detector.detect(scene([], noise=3.0).image) == {}


@pytest.mark.parametrize(("u", "v"), [(0.0, 240.0), (639.0, 240.0), (320.0, 0.0), (320.0, 479.0), (0.0, 0.0)])
def test_a_marker_cut_by_the_border_is_its_visible_part_with_a_lower_score(
    detector: MarkerDetector, scene: Any, shape: Any, u: float, v: float
) -> None:
    whole = detector.detect(scene([shape("ring", 320, 240)]).image)["ring"]
    drawn = scene([shape("ring", u, v, on_skin=False)])
    detector.reset()
    found = detector.detect(drawn.image)["ring"]
    true_u, true_v, area = drawn.truth["ring"]
    assert np.hypot(found.u - true_u, found.v - true_v) < 0.4
    assert found.area == pytest.approx(area, rel=0.1)
    assert found.score < 0.9 * whole.score


def test_touching_markers_of_different_colours_are_told_apart(detector: MarkerDetector, scene: Any, shape: Any) -> None:
    drawn = scene([shape("ring", 300, 240), shape("index", 315.5, 240), shape("middle", 331, 240)])
    found = detector.detect(drawn.image)
    assert set(found) == {"ring", "index", "middle"}
    for name in found:
        u, v, area = drawn.truth[name]
        assert np.hypot(found[name].u - u, found[name].v - v) < 0.5
        assert found[name].area == pytest.approx(area, rel=0.1)


def test_the_larger_of_two_is_the_marker_and_its_score_tells_of_the_other(
    detector: MarkerDetector, scene: Any, shape: Any, paints: Any
) -> None:
    alone = detector.detect(scene([shape("ring", 300, 240, radius=9)]).image)["ring"]
    distractor = shape("thumb", 500, 400, radius=3.5, on_skin=False, paint=paints["ring"])
    detector.reset()
    found = detector.detect(scene([shape("ring", 300, 240, radius=9), distractor]).image)["ring"]
    assert np.hypot(found.u - alone.u, found.v - alone.v) < 0.05
    assert 0.5 * alone.score < found.score < alone.score


def test_of_two_alike_the_one_that_continues_the_track_is_kept(
    detector: MarkerDetector, scene: Any, shape: Any, paints: Any
) -> None:
    for frame in range(3):
        detector.detect(scene([shape("ring", 300 + frame, 240, radius=8)]).image)
    twin = shape("thumb", 100, 100, radius=9, paint=paints["ring"])
    found = detector.detect(scene([shape("ring", 303, 240, radius=8), twin]).image)["ring"]
    assert abs(found.u - 303) < 1.0


def test_a_split_marker_is_found_in_its_middle(detector: MarkerDetector, scene: Any, shape: Any) -> None:
    drawn = scene([shape("ring", 300, 240, radius=10)])
    image = drawn.image.copy()
    image[241:243, 280:320] = 255
    found = detector.detect(image)["ring"]
    u, v, _ = drawn.truth["ring"]
    assert np.hypot(found.u - u, found.v - v) < 1.0


def test_the_mixed_rim_of_another_marker_is_no_marker(
    markers: Any, paints: dict[str, RgbColor], scene: Any, shape: Any
) -> None:
    # A darker shade of the same hue is exactly what light green becomes where it fades into black cloth.
    colors = {**paints, "thumb": (105.0, 130.0, 60.0)}
    detector = MarkerDetector(markers, build_color_table(nominal_colors(colors), list(colors)), 640, 480)
    drawn = scene([shape("middle", 300, 240, radius=16, on_skin=False)], blur=1.4)
    found = detector.detect(drawn.image)
    assert np.count_nonzero(detector.labels == 1) > markers["thumb"].min_area_px
    assert set(found) == {"middle"}


def test_marker_below_the_size_gate_is_not_seen(scene: Any, shape: Any, markers: Any, table: Any) -> None:
    drawn = scene([shape("ring", 50, 50, radius=4, on_skin=False)], size=(101, 101))
    area = drawn.truth["ring"][2]
    gated = {**markers, "ring": markers["ring"].model_copy(update={"min_area_px": 1.5 * area})}
    assert "ring" in MarkerDetector(markers, table, 101, 101).detect(drawn.image)
    assert "ring" not in MarkerDetector(gated, table, 101, 101).detect(drawn.image)


def test_random_pictures_never_break_it(markers: Any, table: Any) -> None:
    detector = MarkerDetector(markers, table, 160, 120)
    rng = np.random.default_rng(5)
    for cell in (1, 2, 4, 9, 30):
        small = rng.integers(0, 256, (-(-120 // cell), -(-160 // cell), 3), dtype=np.uint8)
        image = np.ascontiguousarray(np.kron(small, np.ones((cell, cell, 1), np.uint8))[:120, :160])
        for detection in detector.detect(image).values():
            assert 0.0 <= detection.score <= 1.0
            assert np.isfinite([detection.u, detection.v, detection.area]).all()
            assert detection.area > 0.0


def test_a_picture_all_of_one_paint_has_no_marker_beyond_the_gate(markers: Any, table: Any, paints: Any) -> None:
    image = np.empty((480, 640, 3), np.uint8)
    image[:] = paints["ring"][::-1]
    assert MarkerDetector(markers, table, 640, 480).detect(image) == {}


def test_colours_can_be_replaced_while_running(detector: MarkerDetector, scene: Any, shape: Any, paints: Any) -> None:
    drawn = scene([shape("ring", 300, 240)])
    assert "ring" in detector.detect(drawn.image)
    narrow = nominal_colors(paints).with_tolerances({"ring": 0.1})
    detector.table = build_color_table(narrow.model_copy(update={"markers": {}}), list(paints))
    assert detector.detect(drawn.image) == {}
    with pytest.raises(ConfigError, match="ring, thumb"):
        detector.table = build_color_table(narrow, ["ring", "thumb"])


def test_wrong_frames_are_refused(detector: MarkerDetector) -> None:
    with pytest.raises(ConfigError, match=r"\(480, 640, 3\)"):
        detector.detect(np.zeros((240, 320, 3), np.uint8))


def test_one_pass_costs_no_more_than_six_threshold_pipelines(
    detector: MarkerDetector, scene: Any, six_shapes: Any
) -> None:
    image = scene(six_shapes(0), noise=3.0).image
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    kernel = np.ones((3, 3), np.uint8)

    def thresholds() -> None:
        for value in range(6):
            mask = cv2.inRange(image, (value, 0, 0), (value + 40, 90, 90))
            mask = cv2.morphologyEx(cv2.GaussianBlur(mask, (5, 5), 0), cv2.MORPH_OPEN, kernel)
            cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)

    def best_of(work: Callable[[], Any]) -> float:
        times = []
        for _ in range(25):
            begun = time.perf_counter()
            work()
            times.append(time.perf_counter() - begun)
        return min(times)

    try:
        ratio = best_of(lambda: detector.detect(image)) / best_of(thresholds)
    finally:
        cv2.setNumThreads(threads)
    assert ratio < 1.2


def covered_from(image: Any, row: int) -> Any:
    """The picture with a dark object over everything from a row on."""
    covered = image.copy()
    covered[row:] = (32, 30, 30)
    return covered


def test_a_marker_that_is_being_covered_is_followed_to_its_last_sliver(
    detector: MarkerDetector, scene: Any, shape: Any
) -> None:
    image = scene([shape("ring", 320.0, 240.0, radius=14.0)]).image
    for row in range(244, 224, -1):
        assert "ring" in detector.detect(covered_from(image, row))
    seen = detector.detect(covered_from(image, 224))
    assert seen["ring"].score < 0.5, "a sliver is not as sure as a whole marker"
    assert abs(seen["ring"].u - 320.0) < 1.5


def test_a_sliver_out_of_nowhere_is_no_marker(detector: MarkerDetector, scene: Any, shape: Any) -> None:
    image = scene([shape("ring", 320.0, 240.0, radius=14.0)]).image
    assert "ring" not in detector.detect(covered_from(image, 224))
