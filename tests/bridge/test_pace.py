"""The rate cap, and who gives the beat."""

from __future__ import annotations

import pytest

from rhot_bridge.feed import HandPairing
from rhot_bridge.newest import Pace


def went(pace: Pace, now_ns: int, kind: str | None = None) -> bool:
    if pace.due(now_ns, kind):
        pace.sent(now_ns)
        return True
    return False


def sent(pace: Pace, rate_hz: float, seconds: float, kind: str = "hand", from_s: float = 0.0) -> list[float]:
    stamps = [from_s + number / rate_hz for number in range(round(seconds * rate_hz))]
    return [at_s for at_s in stamps if went(pace, 1_000_000_000 + round(at_s * 1e9), kind)]


@pytest.mark.parametrize(("rate_hz", "wanted_hz"), [(60.0, 60.0), (90.0, 90.0), (100.0, 90.0), (500.0, 90.0)])
def test_the_rate_is_the_cap_and_no_less(rate_hz: float, wanted_hz: float) -> None:
    assert len(sent(Pace(90.0, ("hand",)), rate_hz, 10.0)) == pytest.approx(10.0 * wanted_hz, abs=2)


def test_after_a_silence_no_burst_makes_up_for_it() -> None:
    pace = Pace(90.0, ("hand",))
    assert len(sent(pace, 1000.0, 0.1)) <= 11
    assert len(sent(pace, 1000.0, 0.1, from_s=5.0)) <= 11


def test_others_ride_along_while_the_hand_leads_and_lead_when_it_is_gone() -> None:
    pace = Pace(90.0, ("hand", "object"))
    assert went(pace, 1_000_000_000, "hand")
    assert not went(pace, 1_030_000_000, "object")
    assert went(pace, 1_040_000_000, "hand")
    assert went(pace, 1_200_000_000, "object")
    assert not went(pace, 1_300_000_000, "something else")
    assert went(pace, 1_300_000_000)


def test_hands_that_come_together_wait_for_each_other() -> None:
    pairing = HandPairing()
    assert pairing.add("left", 1)
    assert pairing.add("right", 1)
    assert not pairing.add("left", 2)
    assert pairing.add("right", 2)
    assert not pairing.add("left", 3)
    pairing.time_out()
    assert pairing.add("left", 4)
