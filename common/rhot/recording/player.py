"""Putting recorded samples out again at the pace at which they arrived, quicker, slower, or one moment at a time."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Final

from rhot.operation.priority import wake_first
from rhot.recording.mcap.reader import RecordedSample

LATE_NS: Final = 2_000_000
"""A sample that leaves later than this after its time counts as late."""
GIVE_UP_NS: Final = 500_000_000
"""A replay that is this late goes on from where it is."""

_OWNERS: Final = {
    "markers": "capture",
    "points": "fusion",
    "hand": "ik",
    "body": "ik",
    "object": "objects",
    "head": "objects",
    "foot": "feet",
    "truth": "truth",
}
"""Second chunk of a key to the kind of service that publishes it."""

_LONGEST_WAIT_S: Final = 1.0
REPLAY_SERVICE: Final = "replay"


@dataclass(slots=True)
class PlayFigures:
    """How a replay goes; written by the playing thread, read by others.

    Attributes:
        waits_s: how long the next sample is still away, seconds.
        sent: samples put out.
        late: those that left more than 2 ms after their time.
        worst_late_ns: the latest.
        fell_behind: how often the replay was half a second late and went on from there.
        log_ns: arrival time, in the recording, of the sample sent last.
    """

    waits_s: float = 0.0
    sent: int = 0
    late: int = 0
    worst_late_ns: int = 0
    fell_behind: int = 0
    log_ns: int = 0


def play(
    samples: Iterable[RecordedSample],
    put: Callable[[RecordedSample], None],
    *,
    rate: float,
    stopping: threading.Event,
    figures: PlayFigures,
) -> None:
    """Put samples out in their order, spaced as they arrived divided by `rate`, until the end or until stopped.

    A thread of its own runs this: the event loop wakes to the millisecond only.
    """
    wake_first()
    begun_ns = first_ns = None
    for sample in samples:
        if begun_ns is None or first_ns is None:
            begun_ns, first_ns = time.monotonic_ns(), sample.log_ns
        due_ns = begun_ns + round((sample.log_ns - first_ns) / rate)
        if not _wait_until(due_ns, stopping, figures):
            return
        late_ns = time.monotonic_ns() - due_ns
        put(sample)
        figures.sent += 1
        figures.log_ns = sample.log_ns
        figures.late += late_ns > LATE_NS
        figures.worst_late_ns = max(figures.worst_late_ns, late_ns)
        if late_ns > GIVE_UP_NS:
            # The machine slept, or a reader blocked: samples sent in a heap would only be late for longer.
            begun_ns += late_ns
            figures.fell_behind += 1


def _wait_until(due_ns: int, stopping: threading.Event, figures: PlayFigures) -> bool:
    """Wait until a monotonic time; return False, at once, when stopped meanwhile."""
    while (wait_ns := due_ns - time.monotonic_ns()) > 0:
        figures.waits_s = wait_ns / 1e9
        # In steps: a thread cannot wait for more than three hundred years, and what is left is shown.
        if stopping.wait(min(figures.waits_s, _LONGEST_WAIT_S)):
            return False
    figures.waits_s = 0.0
    return not stopping.is_set()


def moments(samples: Iterable[RecordedSample]) -> Iterator[list[RecordedSample]]:
    """Yield samples in groups of neighbours with the same capture time: the steps of a stepwise replay."""
    for _, group in itertools.groupby(samples, key=lambda sample: sample.t_ns):
        yield list(group)


def conflicts(keys: Iterable[str], alive: Iterable[str]) -> list[tuple[str, str]]:
    """Return which keys a living service owns, with that service.

    Args:
        keys: keys that are about to be published, such as `rhot/markers/left`.
        alive: living services as `service/instance`.
    """
    services = sorted(alive)
    found = []
    for key in keys:
        owner = next((service for service in services if _owns(service, key)), None)
        if owner is not None:
            found.append((key, owner))
    return found


def _owns(service: str, key: str) -> bool:
    kind, _, instance = service.partition("/")
    parts = key.split("/")
    topic = parts[1] if len(parts) > 1 else ""
    # A recorded start or stop would command whoever listens; two replays of the same rig would mix.
    if topic == "control" or kind == REPLAY_SERVICE:
        return True
    if topic in ("status", "config"):
        return parts[2:4] == [kind, instance]
    if topic == "markers":
        return service == f"capture/{'/'.join(parts[2:])}"
    return _OWNERS.get(topic) == kind
