"""Limits on the wall clock: the only failures that a busy machine may excuse."""

from __future__ import annotations

from collections.abc import Iterable

BUSY = 0.3
"""Processors that others keep busy beyond which wall-clock limits say nothing of the tracker: it takes most of two."""


class WallClockMissed(AssertionError):  # noqa: N818  # it names a verdict, not a fault
    """What was asked for came, but too late or too seldom."""


def in_time(took: float, limit: float, what: str, unit: str = "s") -> None:
    """Check that something took no longer than its limit, both in `unit`.

    Raises:
        WallClockMissed: it took longer.
    """
    if not took < limit:
        raise WallClockMissed(f"{what}: {took:.3g} {unit}, limit {limit:.3g} {unit}")


def figures_in_time(missed: Iterable[str]) -> None:
    """Check that none of the figures that hang on the machine's speed has missed its limit.

    Raises:
        WallClockMissed: some have; `missed` names them with their values.
    """
    if words := "; ".join(missed):
        raise WallClockMissed(words)


def excuse(error: BaseException, others: float) -> str:
    """Return why a failure is not judged, empty when it is.

    Args:
        error: what ended the test.
        others: processors that others kept busy meanwhile.
    """
    if isinstance(error, WallClockMissed) and others > BUSY:
        return f"not judged: others kept {others:.1f} processors busy meanwhile; {error}"
    return ""
