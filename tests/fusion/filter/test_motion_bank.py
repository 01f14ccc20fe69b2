from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from rhot_fusion.filter.innovation import Eye, innovate
from rhot_fusion.filter.motion_bank import SHARES, MotionBank

FloatArray = NDArray[np.float64]

ALONE = np.zeros((1, 1))
ONE = np.zeros(1, dtype=np.intp)
NOISE = 0.08 / 530.0
PERIOD_S = 1.0 / 120.0


def follow(path: FloatArray, seed: int = 0) -> tuple[FloatArray, MotionBank]:
    """Let two cameras 75 mm apart see a point on its path (N, 3) in turns; return the estimates (N, 3)."""
    rng = np.random.default_rng(seed)
    bank = MotionBank(ALONE)
    bank.start(ONE, path[:1], np.diag([1e-7, 1e-7, 1e-5])[None], 0.0)
    estimates = np.empty_like(path)
    for number, place in enumerate(path):
        t = np.array([-0.075 * (number % 2), 0.0, 0.0])
        local = place + t
        xy = (local[:2] / local[2] + rng.normal(0.0, NOISE, 2))[None]
        forecast = bank.forecast(ONE, np.array([number * PERIOD_S]))
        eye = Eye((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (t[0], t[1], t[2]))
        variance = [(NOISE**2, 0.0, NOISE**2)]
        innovation = innovate(forecast.mean.tolist(), forecast.filters, eye, xy.tolist(), variance)
        bank.update(ONE, np.ones(1, dtype=bool), forecast, innovation)
        estimates[number] = bank.mean[0, :3]
    return estimates, bank


def test_a_still_point_freezes() -> None:
    estimates, bank = follow(np.tile([0.02, 0.01, 0.8], (600, 1)))
    jitter = estimates[240:].std(axis=0) * 1e3
    assert jitter[:2].max() < 0.1
    # One pair alone has 1.9 mm.
    assert jitter[2] < 0.6
    assert bank.weight[0, 0] > 0.9


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_steady_motion_does_not_lag(speed: float) -> None:
    path = np.array([0.0, 0.0, 0.8]) + np.outer(np.arange(120) * PERIOD_S, [speed, 0.0, 0.0])
    error = (follow(path)[0] - path)[60:]
    assert abs(error[:, 0].mean()) / speed < 0.001


def test_a_sudden_start_is_followed_within_frames() -> None:
    t = np.arange(480) * PERIOD_S
    way = np.where(t > 2.0, 0.5 * 10.0 * (t - 2.0) ** 2, 0.0)
    way = np.where(t > 2.1, 0.05 + 1.0 * (t - 2.1), way)
    path = np.array([-0.2, 0.0, 0.8]) + np.outer(way, [0.6, 0.8, 0.0])
    error = np.linalg.norm((follow(path)[0] - path)[:, :2], axis=1) * 1e3
    assert error[240:].max() < 1.5


def test_unseen_markers_become_less_sure() -> None:
    _, bank = follow(np.tile([0.02, 0.01, 0.8], (300, 1)))
    before = np.trace(bank.cov[0, :3, :3])
    spans = [0.1, 0.2, 0.4]
    traces = []
    for span in spans:
        forecast = bank.forecast(ONE, bank.t_s + span)
        mixed = (forecast.weight[..., None, None] * forecast.P).sum(axis=1)[0]
        traces.append(np.trace(mixed[:3, :3]))
    assert before < traces[0] < traces[1] < traces[2]


def test_weights_return_to_their_shares() -> None:
    _, bank = follow(np.tile([0.02, 0.01, 0.8], (300, 1)))
    forecast = bank.forecast(ONE, bank.t_s + 10.0)
    np.testing.assert_allclose(forecast.weight[0], SHARES, atol=1e-9)


def test_mixing_keeps_mean_and_covariance() -> None:
    """Mixing only spreads what is known over the models: the joint estimate stays what it was."""
    rng = np.random.default_rng(3)
    bank = follow(np.array([0.0, 0.0, 0.8]) + np.cumsum(rng.normal(0.0, 0.002, (100, 3)), axis=0))[1]
    forecast = bank.forecast(ONE, bank.t_s + 1e-9)
    np.testing.assert_allclose(forecast.mean, bank.mean, atol=1e-9)
    away = forecast.away[0]
    cov = np.einsum("k,kij->ij", forecast.weight[0], forecast.P[0] + away[:, :, None] * away[:, None, :])
    np.testing.assert_allclose(cov[:3, :3], bank.cov[0, :3, :3], atol=1e-10)


def test_saved_states_come_back() -> None:
    _, bank = follow(np.tile([0.02, 0.01, 0.8], (50, 1)))
    saved = bank.save()
    mean = bank.mean.copy()
    bank.start(ONE, np.array([[0.1, 0.1, 0.5]]), np.eye(3)[None], 9.0)
    bank.restore(saved)
    np.testing.assert_array_equal(bank.mean, mean)


def test_covariances_stay_symmetric_over_minutes() -> None:
    _, bank = follow(np.tile([0.02, 0.01, 0.8], (6000, 1)))
    cov = bank.cov[0]
    scale = np.sqrt(np.outer(np.diag(cov), np.diag(cov)))
    assert (np.abs(cov - cov.T) / scale).max() < 1e-6
