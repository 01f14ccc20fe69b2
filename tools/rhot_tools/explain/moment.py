"""The part of a recording up to a time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, TypeVar

from rhot.errors import ConfigError, WireError
from rhot.messages import HandPose, MarkerFrame, Message, PointSet, ServiceStatus
from rhot.recording import Recording
from rhot.recording.mcap.reader import McapRecording
from rhot_tools.recordings.span import between, time_span

M = TypeVar("M", bound=Message)

_LATEST_ARRIVAL_NS: Final = 1_000_000_000
"""Messages may have been recorded up to this long after their `t_ns`."""


@dataclass(frozen=True, slots=True)
class Moment:
    """The part of a recording up to a time.

    Attributes:
        t_ns: the time, rig clock.
        since_s: seconds since the recording's first marker frame.
        frames: marker frames up to then, in order of arrival or time.
        published: the last message that the rig published by then, by key; empty for pictures and marker tracks.
        pictures: pictures up to then, if there are any.
    """

    t_ns: int
    since_s: float
    frames: list[MarkerFrame]
    published: dict[str, Message]
    pictures: Recording | None


def moment_of_mcap(recording: McapRecording, pictures: Recording | None, at: float, lead_s: float) -> Moment:
    """Return a moment of recorded messages.

    Args:
        recording: of `rhot record`.
        pictures: recorded with it.
        at: seconds since the first marker frame, or a `t_ns`.
        lead_s: seconds before that time to include.

    Raises:
        ConfigError: there are no marker frames, or none at that time.
    """
    begin = next(_messages(recording, MarkerFrame), None)
    if begin is None:
        raise ConfigError(f"{recording.path}: contains no valid rhot/markers; there is nothing to explain")
    _, first, first_log_ns = begin
    t_ns, delay_ns = _absolute(at, first.t_ns), first_log_ns - first.t_ns
    from_ns, to_ns = t_ns + delay_ns - round(lead_s * 1e9), t_ns + delay_ns + _LATEST_ARRIVAL_NS
    frames: list[MarkerFrame] = []
    published: dict[str, Message] = {}
    for key, message, _ in _messages(recording, Message, from_ns, to_ns):
        if message.t_ns > t_ns:
            continue
        if isinstance(message, MarkerFrame):
            frames.append(message)
        elif isinstance(message, PointSet | HandPose | ServiceStatus):
            published[key] = message
    if not frames or frames[-1].t_ns < t_ns - _LATEST_ARRIVAL_NS:
        length_s = (recording.end_ns - recording.start_ns) / 1e9
        raise ConfigError(
            f"{recording.path}: no marker frame within a second before --at {at:g}; the recording is {length_s:.3f} s "
            "long"
        )
    part = None if pictures is None else _up_to(pictures, t_ns, lead_s)
    return Moment(t_ns, (t_ns - first.t_ns) / 1e9, frames, published, part)


def moment_of_folder(
    recording: Recording, marker_frames: Callable[[Recording], Iterator[MarkerFrame]], at: float, lead_s: float
) -> Moment:
    """Return a moment of a recording folder.

    Args:
        recording: pictures, videos or marker tracks.
        marker_frames: detects the markers in it.
        at: seconds since the first frame, or a `t_ns`.
        lead_s: seconds before that time to include.

    Raises:
        ConfigError: there is no frame at that time.
    """
    first_ns, last_ns = time_span(recording)
    t_ns = _absolute(at, first_ns)
    if not first_ns <= t_ns <= last_ns + _LATEST_ARRIVAL_NS:
        raise ConfigError(
            f"{recording.path}: --at {at:g} is outside the recording, which is {(last_ns - first_ns) / 1e9:.3f} s long"
        )
    part = between(recording, t_ns - round(lead_s * 1e9), t_ns)
    frames = list(marker_frames(part))
    return Moment(t_ns, (t_ns - first_ns) / 1e9, frames, {}, None if recording.holds_markers else part)


def _up_to(pictures: Recording, t_ns: int, lead_s: float) -> Recording | None:
    try:
        return between(pictures, t_ns - round(lead_s * 1e9), t_ns)
    except ConfigError:
        # The pictures do not cover this time.
        return None


def _absolute(at: float, first_ns: int) -> int:
    # Times from here on are nanoseconds since 1970.
    return int(at) if at >= (10**15) else first_ns + round(at * 1e9)


def _messages(
    recording: McapRecording, model: type[M], from_ns: int | None = None, to_ns: int | None = None
) -> Iterator[tuple[str, M, int]]:
    for sample in recording.samples(from_ns, to_ns):
        try:
            message = sample.message()
        except WireError:
            continue
        if isinstance(message, model):
            yield sample.key, message, sample.log_ns
