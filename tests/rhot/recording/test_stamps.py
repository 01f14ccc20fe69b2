"""Stamps that cannot be true are told from those that can."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from rhot.recording.tables import CONFIRMATIONS, StampGate

FRAME_NS = 16_000_000
FUTURE_NS = 3_600_000_000_000
RIG_NS = 1_800_000_000_000_000_000


def begun(gate: StampGate) -> int:
    """Show it its first stamps; return the number of the next frame."""
    for frame in range(CONFIRMATIONS):
        gate.admits(RIG_NS + frame * FRAME_NS, frame * FRAME_NS)
    assert gate.ready
    return CONFIRMATIONS


def test_one_stamp_from_the_future_is_refused_wherever_it_comes() -> None:
    for index in range(6):
        gate = StampGate()
        for frame in range(10):
            arrived_ns = frame * FRAME_NS
            if frame == index:
                assert not gate.admits(RIG_NS + FUTURE_NS, arrived_ns)
            admitted = gate.admits(RIG_NS + frame * FRAME_NS, arrived_ns)
            assert admitted or frame < CONFIRMATIONS, (index, frame)


def test_every_second_stamp_from_the_future_changes_nothing() -> None:
    gate = StampGate()
    for frame in range(begun(gate), 60):
        assert not gate.admits(RIG_NS + FUTURE_NS + frame * FRAME_NS, frame * FRAME_NS)
        assert gate.admits(RIG_NS + frame * FRAME_NS, frame * FRAME_NS)


def test_a_clock_that_is_set_is_followed() -> None:
    gate = StampGate()
    first = begun(gate)
    admitted = [
        gate.admits(RIG_NS + FUTURE_NS + frame * FRAME_NS, frame * FRAME_NS) for frame in range(first, first + 10)
    ]
    assert admitted == [False] * (CONFIRMATIONS - 1) + [True] * (11 - CONFIRMATIONS)


@given(st.lists(st.integers(0, 8_000_000_000), max_size=50))
def test_pictures_that_come_late_are_never_refused(delays_ns: list[int]) -> None:
    gate = StampGate()
    for frame, delay_ns in enumerate(delays_ns, start=begun(gate)):
        assert gate.admits(RIG_NS + frame * FRAME_NS, frame * FRAME_NS + delay_ns)
