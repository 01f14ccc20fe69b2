"""What a soak tells: growth between its two ends, and nothing where there are no two ends."""

from __future__ import annotations

import math
import os
from dataclasses import replace

from rhot_bench.speed.process_costs import ForeignLoad, ProcessCost, process_cost
from rhot_bench.speed.soak import SoakSample, soak_rows

COST = ProcessCost(rss_mb=100.0, pss_mb=60.0, descriptors=12, threads=9, cpu_s=1.0)


def sample(minute: int, cost: ProcessCost, p99_ms: float = 10.0) -> SoakSample:
    return SoakSample(60.0 * minute, {"fusion": cost}, 3600, 5.0, p99_ms, 20.0, {"rhot/points": 0}, {}, 0.1)


def verdicts(samples: list[SoakSample]) -> dict[str, str]:
    return {row.name: row.verdict for row in soak_rows(samples) if row.verdict}


def test_a_rig_that_stays_as_it_is_meets_all_targets() -> None:
    assert set(verdicts([sample(minute, COST) for minute in range(1, 121)]).values()) == {"met"}


def test_growth_of_each_kind_is_found() -> None:
    def grown(minute: int) -> ProcessCost:
        return replace(COST, rss_mb=100.0 + 0.1 * minute, descriptors=12 + minute // 60, threads=9 + minute // 60)

    found = verdicts([sample(minute, grown(minute), 10.0 + 0.05 * minute) for minute in range(1, 121)])
    assert {name for name, verdict in found.items() if verdict == "missed"} == {
        "fusion, growth of memory (RSS)",
        "fusion, descriptors more",
        "fusion, threads more",
        "age of the hand, p99, last",
    }


def test_one_sample_is_compared_with_nothing() -> None:
    found = verdicts([sample(1, COST)])
    assert found.pop("rhot/points, lost on the way") == "met"
    assert set(found.values()) == {"not measured"}


def test_a_process_tells_what_it_holds_until_it_ends() -> None:
    cost = process_cost(os.getpid())
    assert cost is not None
    assert cost.rss_mb > cost.pss_mb > 1.0
    assert cost.descriptors >= 3
    assert cost.threads >= 1
    assert process_cost(2**22 + 1) is None


def test_the_first_look_at_the_load_has_nothing_to_compare_with() -> None:
    load = ForeignLoad()
    assert math.isnan(load.since_last(0.0))
    assert load.since_last(0.0) >= 0.0
