from __future__ import annotations

import numpy as np

from rhot_fusion.filter.timing_noise import TimingNoise

NOISE = 0.1 / 530.0
PAIRS = 3000
MARKERS = 6


def learnt(sigma_s: float, glitch_share: float = 0.0) -> TimingNoise:
    """Show pairs of views of markers at 0.1 to 1.5 units per second whose times are wrong by sigma_s."""
    rng = np.random.default_rng(3)
    noise = TimingNoise(0.3 / 530.0)
    for _ in range(PAIRS):
        speed2 = rng.uniform(0.1, 1.5, MARKERS) ** 2
        jump2 = (4.0 * NOISE**2 + sigma_s**2 * speed2) * rng.normal(size=MARKERS) ** 2
        glitch = rng.random(MARKERS) < glitch_share
        noise.learn(np.where(glitch, (20.0 / 530.0) ** 2, jump2), speed2)
    return noise


def test_errors_of_time_are_found() -> None:
    assert 7.0 < learnt(0.010).sigma_s * 1e3 < 11.0


def test_well_timed_cameras_are_believed_to_be() -> None:
    assert learnt(0.0).sigma_s * 1e3 < 0.5


def test_glitches_are_no_error_of_time() -> None:
    assert learnt(0.0, glitch_share=0.01).sigma_s * 1e3 < 1.0


def test_nothing_teaches_nothing() -> None:
    noise = TimingNoise(NOISE)
    noise.learn(np.zeros(0), np.zeros(0))
    assert (noise.sigma, noise.sigma_s) == (NOISE, 0.0)
