from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rhot.anatomy.hand import HandModel
from rhot.rig import CameraConfig, HandFile, MarkerConfig
from rhot.rig.cameras import camera_model
from rhot.rig.config import SimConfig
from rhot_calibration.colors.calibration import calibrate
from rhot_calibration.colors.model.fit import drawn, in_other_light
from rhot_calibration.colors.model.separability import Separability, labels_of
from rhot_calibration.colors.picking.picks import Box
from rhot_capture.detection.color_table import ColorTable, build_color_table
from rhot_capture.detection.detector import MarkerDetector
from rhot_sim.rendering.renderer import Renderer
from rhot_sim.rig.calibration import simulated_rig_calibration
from rhot_sim.world.paint import PAINTS
from rhot_sim.world.world import World

WIDTH, HEIGHT = 960, 720
PICKED_S = (0.4, 6.3)
SEEN_S = tuple(np.arange(0.9, 22.0, 1.7))
CLOSE = ("little", "base")
PURE = {
    "thumb": (255.0, 0.0, 0.0),
    "index": (0.0, 255.0, 0.0),
    "middle": (0.0, 0.0, 255.0),
    "ring": (255.0, 255.0, 0.0),
    "little": (255.0, 0.0, 255.0),
    "base": (0.0, 255.0, 255.0),
    "skin": (0.0, 0.0, 0.0),
}

Masks = Mapping[str, NDArray[np.bool_]]


@dataclass(frozen=True)
class Outcome:
    """What was predicted for the two close paints, and what then happened in other pictures and other light."""

    predicted: float
    happened: float
    warned: bool
    lost: int
    expected: int


@pytest.fixture(scope="module")
def renderer(markers: dict[str, MarkerConfig]) -> Callable[..., Renderer]:
    config = CameraConfig(source="simulated", width=WIDTH, height=HEIGHT)
    truth = simulated_rig_calibration({"left": config, "right": config}, seed=1).truth.cameras["left"]
    world = World(1, {"right": HandModel.from_file(HandFile(), "right")}, markers)

    def make(paints: Mapping[str, tuple[float, float, float]], noise: float) -> Renderer:
        sim = SimConfig(noise_sigma=noise, light_drift=0.0)
        return Renderer(camera_model(truth), world, sim, config, paints=paints)

    return make


@pytest.fixture(scope="module")
def truths(renderer: Callable[..., Renderer]) -> dict[float, Masks]:
    """Where each marker's paint is, without its rim, by time: seen in pure colours, without noise."""
    pure = renderer(PURE, 0.0)

    def masks(t_s: float) -> Masks:
        image = pure.render(t_s)
        found = {}
        for name in CLOSE:
            on = np.array(PURE[name]) > 0
            painted = (image[..., on].min(axis=-1) > 150) & (image[..., ~on].max(axis=-1) < 12)
            found[name] = cv2.erode(painted.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        return found

    return {t_s: masks(t_s) for t_s in (*PICKED_S, *SEEN_S)}


@pytest.fixture(scope="module")
def outcome(
    renderer: Callable[..., Renderer], truths: dict[float, Masks], markers: dict[str, MarkerConfig]
) -> Callable[[float], Outcome]:
    """Paint two markers alike (0 as usual, 1 the same), calibrate, and see what is mixed up."""

    def run(closeness: float) -> Outcome:
        first, second = (np.array(PAINTS[name]) for name in CLOSE)
        blend = tuple(second + closeness * (first - second))
        hand = renderer({**PAINTS, CLOSE[1]: blend}, 3.0)
        places = [{name: around(mask) for name, mask in truths[t_s].items()} for t_s in PICKED_S]
        result = calibrate([hand.render(t_s) for t_s in PICKED_S], places, markers)
        table = build_color_table(result.colors, list(markers))
        apart = result.separability
        a, b = (apart.names.index(name) for name in CLOSE)
        happened, lost, expected = np.zeros((2, 2)), 0, 0
        # Light all over the range that the prediction allows for, in no order.
        lights = np.random.default_rng(3).permutation(np.linspace(0.8, 1.2, len(SEEN_S)))
        for t_s, light in zip(SEEN_S, lights, strict=True):
            image = np.clip(np.rint(hand.render(t_s) * light), 0, 255).astype(np.uint8)
            found = MarkerDetector(markers, table, WIDTH, HEIGHT).detect(image)
            labels, _ = table.classify(image)
            for row, (name, other) in enumerate((CLOSE, CLOSE[::-1])):
                mask = truths[t_s][name]
                happened[row] += np.count_nonzero(labels[mask] == table.names.index(other) + 1), np.count_nonzero(mask)
                if np.count_nonzero(mask) >= 12:
                    u, v = middle(mask)
                    expected += 1
                    lost += name not in found or np.hypot(found[name].u - u, found[name].v - v) > 10.0
        return Outcome(
            predicted=0.5 * float(apart.expected[a, b] + apart.expected[b, a]),
            happened=0.5 * float((happened[:, 0] / happened[:, 1]).sum()),
            warned=any({first, second} == set(CLOSE) for first, second, _ in apart.confusable()),
            lost=lost,
            expected=expected,
        )

    return run


def around(mask: NDArray[np.bool_]) -> Box:
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    return Box(left - 4, top - 4, width + 8, height + 8)


def middle(mask: NDArray[np.bool_]) -> tuple[float, float]:
    rows, columns = np.nonzero(mask)
    return float(columns.mean()), float(rows.mean())


def test_the_predicted_confusion_of_close_paints_is_what_happens(outcome: Callable[[float], Outcome]) -> None:
    levels = [outcome(closeness) for closeness in (0.4, 0.8, 0.87, 0.92, 0.97)]
    for well_apart in levels[:1]:
        assert well_apart.predicted < 0.01
        assert well_apart.happened < 0.01
        assert not well_apart.warned
        assert well_apart.lost == 0
    assert [each.predicted for each in levels] == sorted(each.predicted for each in levels)
    assert [each.happened for each in levels] == sorted(each.happened for each in levels)
    in_range = [each for each in levels if 0.01 <= each.happened <= 0.3]
    assert len(in_range) >= 3
    for each in in_range:
        assert 0.5 < each.predicted / each.happened < 2.0, each
    assert all(each.warned for each in levels if each.happened > 0.05)
    assert levels[-1].lost > 0.1 * levels[-1].expected, "paints this close lose detections too"


def test_labels_of_single_colours_are_those_of_a_picture(table: ColorTable) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (500, 3))
    image = rgb[:, ::-1].reshape(1, -1, 3).astype(np.uint8)
    assert np.array_equal(labels_of(table, rgb.astype(np.float64)), table.classify(image)[0][0])


def test_drawn_pixels_have_the_given_ones_distribution() -> None:
    rng = np.random.default_rng(0)
    pixels = np.concatenate([rng.normal((200, 60, 90), 4.0, (900, 3)), rng.normal((120, 36, 54), 4.0, (600, 3))])
    new = drawn(pixels, 4_000, rng)
    assert np.allclose(new.mean(axis=0), pixels.mean(axis=0), rtol=0.03)
    assert np.allclose(new.std(axis=0), pixels.std(axis=0), rtol=0.12)


def test_other_light_is_up_to_a_fifth_brighter_or_darker() -> None:
    lit = in_other_light(np.full((2_000, 3), (100.0, 50.0, 240.0)), np.random.default_rng(0))
    assert lit[:, 0].min() == pytest.approx(80.0, abs=1.0)
    assert lit[:, 0].max() == pytest.approx(120.0, abs=1.0)
    assert lit.max() == 255.0


def test_rows_add_up_and_the_margin_is_the_drift_that_mixes(scene: Any, shape: Any, markers: Any) -> None:
    shapes = [shape("ring", 80, 100), shape("index", 180, 100, paint=(44, 92, 196)), shape("middle", 280, 100)]
    drawn_scene = scene(shapes, noise=2.0, size=(360, 200))
    picks = {name: (u, v) for name, (u, v, _) in drawn_scene.truth.items()}
    result = calibrate([drawn_scene.image], [picks], markers)
    apart = result.separability
    assert np.allclose(apart.expected.sum(axis=1), 1.0)
    assert np.allclose(apart.measured.sum(axis=1), 1.0)
    row, near, far = (apart.names.index(name) for name in ("ring", "index", "middle"))
    assert apart.nearest("ring")[0] == "index"
    assert apart.distance[row, near] < apart.distance[row, far]
    assert apart.margin[row, near] < 0.3
    assert apart.margin[row, near] < apart.margin[row, far]
    assert np.isnan(apart.margin[row, row])


def test_what_takes_in_skin_is_named() -> None:
    expected = np.array([[0.9, 0.0, 0.0, 0.0, 0.1], [0.0, 1.0, 0.0, 0.0, 0.0], [0.6, 0.02, 0.38, 0.0, 0.0]])
    nothing = np.full((3, 3), np.nan)
    apart = Separability(
        names=("thumb", "index"),
        classes=("thumb", "index", "skin"),
        seen=("thumb", "index", "skin", "background", "nothing"),
        expected=expected,
        measured=expected,
        distance=nothing,
        margin=nothing[:2],
    )
    assert apart.skin_like() == [("thumb", 0.6)]
