"""The part of a recording up to a time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, TypeVar

import numpy as np

from rhot.arrays import FloatArray
from rhot.errors import ConfigError, WireError
from rhot.messages import HandPose, MarkerFrame, Message, PointSet, ServiceStatus
from rhot.recording import Recording
from rhot.recording.mcap.reader import McapRecording
from rhot_tools.recordings.beside import between, time_span

# Messages of the seconds before a time, and curves of their quality.

Line = tuple[FloatArray, FloatArray]


@dataclass(slots=True)
class Trace:
    """Messages of the stages up to a time.

    Attributes:
        t_ns: the time.
        frames: newest marker frame of each camera.
        points: newest points.
        hands: newest hand of each side.
        before: all hands and points by key and time.
    """

    t_ns: int
    frames: dict[str, MarkerFrame] = field(default_factory=dict)
    points: PointSet | None = None
    hands: dict[str, HandPose] = field(default_factory=dict)
    before: dict[tuple[str, int], HandPose | PointSet] = field(default_factory=dict)
    _residuals: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    _sigmas: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    _seen: dict[str, list[tuple[float, float]]] = field(default_factory=dict)

    @property
    def residuals_mm(self) -> Mapping[str, Line]:
        """Finger to time relative to `t_ns` (N,), seconds, negative, and residual of its marker (N,), millimetres."""
        return _lines(self._residuals)

    @property
    def sigmas_mm(self) -> Mapping[str, Line]:
        """Marker to relative time (N,), seconds, and standard deviation of its point (N,), millimetres."""
        return _lines(self._sigmas)

    @property
    def seen(self) -> Mapping[str, Line]:
        """Camera to relative time (N,), seconds, and number of markers detected (N,)."""
        return _lines(self._seen)

    def add(self, key: str, message: Message) -> None:
        """Add a message; messages must be in order of time."""
        at_s = (message.t_ns - self.t_ns) / 1e9
        if isinstance(message, MarkerFrame):
            self.frames[message.camera] = message
            self._seen.setdefault(message.camera, []).append((at_s, len(message.markers)))
        elif isinstance(message, PointSet):
            self.points = message
            self.before[key, message.t_ns] = message
            for name, point in message.points.items():
                self._sigmas.setdefault(name, []).append((at_s, 1e3 * point.sigma))
        elif isinstance(message, HandPose):
            self.hands[message.side] = message
            self.before[key, message.t_ns] = message
            for finger in message.fingers:
                miss_m = message.residual.get(finger, np.nan)
                self._residuals.setdefault(f"{message.side} {finger}", []).append((at_s, 1e3 * miss_m))


def trace_of(t_ns: int, messages: Iterable[tuple[str, Message]]) -> Trace:
    """Return the trace of messages up to a time."""
    trace = Trace(t_ns)
    for key, message in messages:
        trace.add(key, message)
    return trace


def difference_m(first: HandPose | PointSet, second: HandPose | PointSet) -> float:
    """Return the largest distance between joints or points that both have; NaN if there are none."""
    one, other = _positions(first), _positions(second)
    gaps = [
        float(np.linalg.norm(np.subtract(position, other[name]))) for name, position in one.items() if name in other
    ]
    return max(gaps, default=float("nan"))


def _positions(message: HandPose | PointSet) -> dict[str, tuple[float, float, float]]:
    parts = message.joints if isinstance(message, HandPose) else message.points
    return {name: part.position for name, part in parts.items()}


def _lines(pairs: Mapping[str, list[tuple[float, float]]]) -> dict[str, Line]:
    return {name: (values[:, 0], values[:, 1]) for name, values in ((n, np.array(p)) for n, p in pairs.items())}


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
    # No recording is three years long, so from here on times are nanoseconds, of whatever clock the pictures have.
    return int(at) if at >= 10**8 else first_ns + round(at * 1e9)


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
