from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rhot.errors import CalibrationError
from rhot.rig.colors import ColorsFile, RgbColor
from rhot_calibration.colors.calibration import calibrate
from rhot_calibration.colors.model.fit import bhattacharyya, fit_component, fit_mixture
from rhot_capture.detection.color_table import build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_capture.detection.result import Detection

FLOOR = (1e-3, 1e-3, 1e-3)


def detect(image: Any, colors: Any, markers: Mapping[str, Any]) -> dict[str, Detection]:
    table = build_color_table(colors, list(markers))
    return MarkerDetector(markers, table, image.shape[1], image.shape[0]).detect(image)


def test_a_distribution_is_recovered_from_its_samples() -> None:
    rng = np.random.default_rng(0)
    covariance = np.array([[0.010, 0.004, 0.0], [0.004, 0.008, -0.006], [0.0, -0.006, 0.04]])
    mean = np.array([0.2, -0.3, 4.5])
    fitted = fit_component(rng.multivariate_normal(mean, covariance, 40_000), FLOOR)
    assert np.allclose(fitted.mean(), mean, atol=0.01)
    # Leaving out what is beyond three standard deviations narrows a normal distribution by a few per cent.
    assert np.allclose(fitted.covariance(), covariance, rtol=0.12, atol=5e-4)


def test_a_few_wild_samples_do_not_widen_it() -> None:
    rng = np.random.default_rng(0)
    clean = rng.normal((0.2, -0.3, 4.5), 0.05, (2_000, 3))
    wild = np.concatenate([clean, np.full((40, 3), 2.0)])
    assert np.allclose(fit_component(wild, FLOOR).sigma, fit_component(clean, FLOOR).sigma, rtol=0.25)


def test_clusters_are_found_with_their_shares() -> None:
    rng = np.random.default_rng(0)
    many, few = rng.normal((0.0, 0.0, 4.0), 0.03, (3_000, 3)), rng.normal((1.0, 1.0, 5.0), 0.03, (1_000, 3))
    samples = np.concatenate([many, few])
    first, second = fit_mixture(samples, 2, FLOOR)
    assert [first.weight, second.weight] == pytest.approx([0.75, 0.25], abs=0.01)
    assert np.allclose(first.mean(), (0, 0, 4), atol=0.02)


def test_distance_between_distributions() -> None:
    rng = np.random.default_rng(0)
    first = fit_component(rng.normal((0, 0, 4), 0.1, (20_000, 3)), FLOOR)
    second = fit_component(rng.normal((0.4, 0, 4), 0.1, (20_000, 3)), FLOOR)
    assert bhattacharyya(first, first) == pytest.approx(0.0, abs=1e-9)
    # Equal covariances: distance² / 8σ².
    assert bhattacharyya(first, second) == pytest.approx(0.4**2 / (8 * 0.1**2), rel=0.1)


def test_picks_off_the_middle_give_colours_that_find_all_markers(scene: Any, six_shapes: Any, markers: Any) -> None:
    for seed in range(2):
        drawn = scene(six_shapes(seed), noise=3.0, seed=seed)
        rng = np.random.default_rng(seed)
        picks = {name: (u + rng.uniform(-6, 6), v + rng.uniform(-6, 6)) for name, (u, v, _) in drawn.truth.items()}
        result = calibrate([drawn.image], [picks], markers)
        found = detect(drawn.image, result.colors, markers)
        assert set(found) == set(drawn.truth)
        for name, (u, v, area) in drawn.truth.items():
            assert np.hypot(found[name].u - u, found[name].v - v) < 0.5
            assert found[name].area == pytest.approx(area, rel=0.15)
            assert result.markers[name].recovered > 0.7


def test_several_pictures_make_colours_fit_several_lights(scene: Any, six_shapes: Any, markers: Any) -> None:
    bright = scene(six_shapes(1), noise=2.0)
    dark_image = np.clip(0.5 * bright.image, 0, 255).astype(np.uint8)
    picks = {name: (u, v) for name, (u, v, _) in bright.truth.items()}
    colors = calibrate([bright.image, dark_image], [picks, picks], markers).colors
    for light in (0.5, 0.7, 1.0):
        image = np.clip(light * bright.image, 0, 255).astype(np.uint8)
        assert set(detect(image, colors, markers)) == set(picks), light


def test_a_marker_without_a_pick_is_never_seen(scene: Any, six_shapes: Any, markers: Any) -> None:
    drawn = scene(six_shapes(2))
    picks = {name: (u, v) for name, (u, v, _) in drawn.truth.items() if name != "base"}
    colors = calibrate([drawn.image], [picks], markers).colors
    assert "base" not in colors.markers
    assert set(detect(drawn.image, colors, markers)) == set(picks)


def test_skin_is_a_class_of_its_own(scene: Any, six_shapes: Any, markers: Any) -> None:
    drawn = scene(six_shapes(2))
    colors = calibrate([drawn.image], [{name: (u, v) for name, (u, v, _) in drawn.truth.items()}], markers).colors
    assert colors.skin is not None
    nearest = min(np.linalg.norm(np.array(part.rgb) - (215, 170, 140)) for part in colors.skin.components)
    assert nearest < 15


def test_alike_paints_are_named(scene: Any, shape: Any, markers: Any) -> None:
    twin: RgbColor = (48, 66, 208)
    shapes = [shape("ring", 100, 100), shape("index", 200, 100, paint=twin), shape("middle", 300, 100)]
    drawn = scene(shapes, noise=2.0, size=(400, 200))
    picks = {name: (u, v) for name, (u, v, _) in drawn.truth.items()}
    result = calibrate([drawn.image], [picks], markers)
    assert [set(pair[:2]) for pair in result.separability.confusable()] == [{"ring", "index"}]
    assert result.separability.nearest("ring")[0] == "index"


def test_a_look_alike_in_the_room_is_not_the_marker(scene: Any, shape: Any, markers: Any) -> None:
    poster: RgbColor = (75, 95, 190)
    shapes = [shape("ring", 100, 100), shape("index", 300, 150, radius=14, paint=poster, on_skin=False)]
    drawn = scene(shapes, noise=2.0, size=(400, 250))
    result = calibrate([drawn.image], [{"ring": drawn.truth["ring"][:2]}], markers)
    found = detect(drawn.image, result.colors, markers)
    assert np.hypot(found["ring"].u - drawn.truth["ring"][0], found["ring"].v - drawn.truth["ring"][1]) < 0.5
    assert found["ring"].score > 0.6


@pytest.mark.parametrize(
    ("picks", "words"),
    [
        ({}, "no picks"),
        ({"nose": (10.0, 10.0)}, "pick nose: no such marker"),
        ({"ring": (100.0, 1000.0)}, "100,1000 lies outside picture 1, which is 400x200"),
        ({"ring": (350.0, 150.0)}, "pick ring"),
        ({"ring": (100.0, 100.0), "index": (103.0, 102.0)}, "picks (index and ring|ring and index)"),
    ],
)
def test_bad_picks_are_named(
    scene: Any, shape: Any, markers: Any, picks: dict[str, tuple[float, float]], words: str
) -> None:
    image = scene([shape("ring", 100, 100)], size=(400, 200), noise=1.0).image
    with pytest.raises(CalibrationError, match=words):
        calibrate([image], [picks], markers)


@pytest.fixture(scope="module")
def photo_colors(thesis_rig: Path, markers: Any) -> Callable[[str, float], ColorsFile]:
    """Colours from picks in one photo, some pixels away from the annotated centres."""
    done: dict[tuple[str, float], ColorsFile] = {}

    def make(source: str, offset_px: float) -> ColorsFile:
        if (source, offset_px) not in done:
            rng = np.random.default_rng(7)
            picks = {}
            for name, marker in annotated(thesis_rig, source).items():
                angle = rng.uniform(0.0, 2.0 * np.pi)
                picks[name] = (marker["cx"] + offset_px * np.cos(angle), marker["cy"] + offset_px * np.sin(angle))
            done[source, offset_px] = calibrate([read(thesis_rig, source)], [picks], markers).colors
        return done[source, offset_px]

    return make


def annotated(thesis_rig: Path, photo: str) -> dict[str, dict[str, Any]]:
    photos = json.loads((thesis_rig / "photos" / "markers.json").read_text())["photos"]
    chosen = next(each for each in photos if each["file"] == photo)
    return {marker["label"]: marker for marker in chosen["markers"]}


def read(thesis_rig: Path, photo: str) -> Any:
    image = cv2.imread(str(thesis_rig / "photos" / photo))
    assert image is not None
    return np.asarray(image, np.uint8)


@pytest.mark.xdist_group("colours of photos")
@pytest.mark.parametrize(
    ("source", "target"),
    [
        ("GOPR0442.MP4.Standbild001.jpg", "GOPR0442.MP4.Standbild001.jpg"),
        ("GOPR0442.MP4.Standbild001.jpg", "no_occclusion_full.jpg"),
        ("no_occclusion_full.jpg", "no_occclusion_full.jpg"),
        ("final_finger_markers.jpg", "final_finger_markers.jpg"),
        ("WP_20180522_08_28_56_Rich.jpg", "WP_20180522_08_28_56_Rich.jpg"),
    ],
)
@pytest.mark.parametrize("offset_px", [0.0, 6.0])
def test_painted_markers_of_real_photos_are_found(
    thesis_rig: Path,
    photo_colors: Callable[[str, float], ColorsFile],
    markers: Any,
    source: str,
    target: str,
    offset_px: float,
) -> None:
    found = detect(read(thesis_rig, target), photo_colors(source, offset_px), markers)
    true = annotated(thesis_rig, target)
    assert set(found) == set(true)
    for name, marker in true.items():
        assert np.hypot(found[name].u - marker["cx"], found[name].v - marker["cy"]) < 3.0, name
        assert found[name].area == pytest.approx(marker["area_px"], rel=0.35), name


@pytest.mark.xdist_group("colours of photos")
@pytest.mark.parametrize(
    ("photo", "light"),
    [("final_finger_markers.jpg", (1.25, 0.8)), ("GOPR0442.MP4.Standbild001.jpg", (0.8, 1.25))],
)
def test_real_paints_are_found_while_the_light_changes(
    thesis_rig: Path,
    photo_colors: Callable[[str, float], ColorsFile],
    markers: Any,
    photo: str,
    light: tuple[float, float],
) -> None:
    image, colors, true = read(thesis_rig, photo), photo_colors(photo, 0.0), annotated(thesis_rig, photo)
    detector = MarkerDetector(markers, build_color_table(colors, list(markers)), image.shape[1], image.shape[0])
    for frame in range(125):
        red, blue = np.power(light, min(frame / 100.0, 1.0))
        found = detector.detect(np.clip(np.rint(image * [blue, 1.0, red]), 0, 255).astype(np.uint8))
    assert set(found) == set(true)
    for name, marker in true.items():
        assert np.hypot(found[name].u - marker["cx"], found[name].v - marker["cy"]) < 3.0, name


@pytest.mark.xdist_group("colours of photos")
def test_pictures_without_markers_show_none(
    thesis_rig: Path, photo_colors: Callable[[str, float], ColorsFile], markers: Any
) -> None:
    colors = photo_colors("GOPR0442.MP4.Standbild001.jpg", 0.0)
    for number in (1, 5, 9):
        image = read(thesis_rig, f"../chessboard/left/{number:06d}.jpg")
        sure = {name: each for name, each in detect(image, colors, markers).items() if each.score > 0.7}
        assert not sure, number


@pytest.mark.parametrize("gloss", [-30, 30, 80])
def test_a_patch_is_found_whole_with_more_or_less_gloss(gloss: int, scene: Any, six_shapes: Any, markers: Any) -> None:
    drawn = scene(six_shapes(1), noise=2.0)
    result = calibrate([drawn.image], [{name: (u, v) for name, (u, v, _) in drawn.truth.items()}], markers)
    (patch,) = (name for name, marker in markers.items() if marker.kind == "patch")
    image = drawn.image.astype(np.int16)
    image[result.regions[0][patch]] += gloss
    found = detect(np.clip(image, 0, 255).astype(np.uint8), result.colors, markers)[patch]
    u, v, area = drawn.truth[patch]
    assert np.hypot(found.u - u, found.v - v) < 0.5
    assert found.area == pytest.approx(area, rel=0.15)
