from __future__ import annotations

import numpy as np
import pytest

from rhot_tools.measures.streams import Stream, lateral_delay, measured_glitches, rest_noise_m, step_p99_m

COUNT = 900


@pytest.fixture
def stream() -> Stream:
    """One marker that rests for ten seconds, moves for ten and rests again; whole pixels; noise of 0.5 and 3 mm."""
    rng = np.random.default_rng(0)
    t = np.arange(COUNT) / 30.0
    moving = (t >= 10.0) & (t < 20.0)
    x = np.where(moving, 0.08 * np.sin(2.5 * (t - 10.0)), 0.0)
    places = np.stack([x, np.zeros(COUNT), np.full(COUNT, 0.8)], axis=1)[:, None]
    u = np.round(320.0 + 530.0 * x / 0.8)
    uv = np.stack([np.stack([u - shift, np.full(COUNT, 240.0)], axis=1)[:, None] for shift in (0.0, 50.0)])
    positions = places + rng.normal(0.0, (0.0005, 0.0005, 0.003), places.shape)
    return Stream(uv, positions, np.ones((COUNT, 1), dtype=bool), np.full((COUNT, 1), 2))


def test_noise_at_rest_is_found_without_masks(stream: Stream) -> None:
    sideways, depth = rest_noise_m(stream)
    assert 35 <= len(sideways) <= 41
    assert np.median(sideways) * 1e3 == pytest.approx(0.5, rel=0.1)
    assert np.median(depth) * 1e3 == pytest.approx(3.0, rel=0.1)


def test_steps_and_delay(stream: Stream) -> None:
    assert 5.0 < step_p99_m(stream) * 1e3 < 20.0
    assert abs(lateral_delay(stream)) < 0.15
    late = Stream(stream.uv, np.roll(stream.positions, 1, axis=0), stream.measured, stream.views)
    assert lateral_delay(late) == pytest.approx(1.0, abs=0.15)


def test_glitches_count_when_both_views_were_believed(stream: Stream) -> None:
    glitch = np.zeros((COUNT, 1), dtype=bool)
    glitch[10:14] = True
    stream.views[10] = 1
    stream.measured[11] = False
    assert measured_glitches(stream, glitch) == 2
