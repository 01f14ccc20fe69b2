"""What delay and lost segments on both cameras' links cost, in virtual time: no processes, no busy machine.

Frames take the time that the link of the fault suite gives them; of frames that arrive at once the core gets each
camera's newest, as from the bus. `test_links.py` asks the same of real processes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from bad_link import Link
from marker_streams import EPOCH_NS, Motion, Seen, watch

from rhot.messages import PointSet
from rhot.rig import Rig
from rhot_fusion.core import FusionCore

DELAY_S, JITTER_S = 0.020, 0.005
STALL_SHARE, STALL_S = 0.01, 0.2
BURST_S = 0.001
"""What arrives within this time is there when the reader looks."""
BYTES = 800
RATE_HZ = 60.0
CAMERAS = ("left", "right")


@dataclass(frozen=True, slots=True)
class Published:
    """A point set: when it came, when it was true (seconds), and how many points it measured."""

    at_s: float
    t_s: float
    measured: int


def over(links: dict[str, Link], frames: list[Seen]) -> list[Seen]:
    """Return frames as they arrive over links, without those that a newer one of the same camera replaces unread."""
    before = dict.fromkeys(links, 0.0)
    late: list[Seen] = []
    for one in frames:
        camera = one.frame.camera
        before[camera] = links[camera].due_s(one.arrival_s, BYTES, before[camera])
        late.append(Seen(before[camera], one.frame))
    late.sort(key=lambda one: (one.arrival_s, one.frame.t_ns))
    return [
        one
        for index, one in enumerate(late)
        if not any(
            other.frame.camera == one.frame.camera and other.arrival_s - one.arrival_s < BURST_S
            for other in late[index + 1 : index + 30]
        )
    ]


def published(rig: Rig, frames: list[Seen]) -> list[Published]:
    core = FusionCore(rig)
    found: list[Published] = []
    for one in frames:
        for _, points in core.feed(one.frame):
            assert isinstance(points, PointSet)
            measured = sum(point.state == "measured" for point in points.points.values())
            found.append(Published(one.arrival_s, (points.t_ns - EPOCH_NS) * 1e-9, measured))
    return [one for one in found if one.t_s > 1.0]


def coverage(times_s: list[float], duration_s: float) -> float:
    """Return the share of the frame times for which something is known that is no further than one frame away."""
    wanted = np.arange(1.5, duration_s - 1.0, 1.0 / RATE_HZ)
    return float(np.mean(np.abs(np.array(times_s) - wanted[:, None]).min(axis=1) <= 1.0 / RATE_HZ))


def p50_s(sets: list[Published]) -> float:
    return float(np.median([one.at_s - one.t_s for one in sets]))


@pytest.mark.parametrize(
    ("phase_s", "duration_s"),
    [
        pytest.param(0.007, 8.0, id="short"),
        pytest.param(0.0, 60.0, id="in step", marks=pytest.mark.faults),
        pytest.param(0.007, 60.0, id="out of step", marks=pytest.mark.faults),
    ],
)
def test_lossy_links_cost_their_delay_and_little_more(
    make_rig: Callable[..., Rig], phase_s: float, duration_s: float
) -> None:
    rig = make_rig(rate_hz=RATE_HZ)
    frames = watch(rig, Motion(), duration_s, rate_hz=RATE_HZ, phase_s=phase_s)
    plain = published(rig, over({"left": Link(), "right": Link()}, frames))
    links = {name: Link(DELAY_S, JITTER_S, STALL_SHARE, STALL_S, seed=index) for index, name in enumerate(CAMERAS)}
    arrived = over(links, frames)
    lossy = published(rig, arrived)
    assert min(link.stalls for link in links.values()) > 1
    assert p50_s(lossy) <= p50_s(plain) + DELAY_S + 0.003
    # Each camera is silent for an eighth of the time, so both are at once for a sixtieth: nothing can be known then.
    possible = coverage([(one.frame.t_ns - EPOCH_NS) * 1e-9 for one in arrived], duration_s)
    covered = coverage([one.t_s for one in lossy], duration_s)
    assert covered >= possible - 0.01
    assert covered >= 0.97 or possible < 0.98
    # No burst of old ones: they come in order, and one that is older than a tenth of a second is a rarity.
    assert [one.t_s for one in lossy] == sorted(one.t_s for one in lossy)
    assert sum(one.at_s - one.t_s > 0.1 for one in lossy) <= 0.01 * len(lossy)
