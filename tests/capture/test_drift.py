"""How far unlocked settings carry a picture away: by the light of the scene, not by hands that come into it."""

from __future__ import annotations

import numpy as np
import pytest

from rhot_capture.drift import Drift


def scene(seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform(40, 180, (480, 640, 3))


def camera(light: np.ndarray, seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0.0, 4.0, light.shape)
    return np.clip(np.round(light + noise), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("brightness", "red"), [(1.0, 1.0), (1.2, 1.0), (0.7, 1.0), (1.0, 1.15), (0.9, 0.85)])
def test_gain_and_colour_are_told_apart(brightness: float, red: float) -> None:
    drift = Drift()
    light = scene()
    drift.see(camera(light, 2))
    gains = brightness * np.array([red ** (-1 / 3), red ** (-1 / 3), red ** (2 / 3)])
    later = light * gains
    later[100:300, 200:400] = 120.0  # a hand
    drift.see(camera(later, 3))
    assert drift.brightness == pytest.approx(brightness - 1.0, abs=0.015)
    assert drift.colour == pytest.approx(np.max(np.abs(gains / brightness - 1.0)), abs=0.015)


def test_a_picture_too_dark_to_judge_changes_nothing() -> None:
    drift = Drift()
    drift.see(camera(scene(), 2))
    drift.see(np.zeros((480, 640, 3), np.uint8))
    assert (drift.brightness, drift.colour) == (0.0, 0.0)
