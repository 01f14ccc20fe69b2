"""A machine that cannot draw all frames draws every second one, in step, and tries again with patience."""

from __future__ import annotations

from rhot_sim.sources.camera import Stride


def started() -> Stride:
    """Return one that is past its start, which tells nothing."""
    stride = Stride()
    for _ in range(180):
        assert not stride.count(True)
    assert stride.value == 1
    return stride


def drawn(stride: Stride, candidates: int, late_every: int, start: int = 0) -> list[int]:
    """Return the numbers of the frames that were candidates; one in `late_every` of them is late (0 = none)."""
    numbers, number = [], start
    for index in range(candidates):
        numbers.append(number)
        number = stride.next_after(number)
        stride.count(late_every > 0 and index % late_every == 0)
    return numbers


def test_a_few_late_frames_change_nothing() -> None:
    stride = started()
    assert drawn(stride, 600, 10) == list(range(600))


def test_many_late_frames_halve_the_rate_on_even_numbers() -> None:
    stride = started()
    drawn(stride, 40, 2, start=7)
    assert stride.value == 2
    later = drawn(stride, 20, 0, start=stride.next_after(47))
    assert all(number % 2 == 0 for number in later), "both cameras draw the same frames"


def test_it_tries_again_and_waits_longer_each_time() -> None:
    stride = started()
    waits = []
    for _ in range(4):
        while stride.value == 1:
            stride.count(True)
        wait = 0
        while stride.value == 2:
            stride.count(False)
            wait += 1
        waits.append(wait)
    assert waits == sorted(set(waits))
    assert waits[0] >= 60


def test_it_never_stops_drawing() -> None:
    stride = started()
    for _ in range(10_000):
        stride.count(True)
    assert stride.value == 4
