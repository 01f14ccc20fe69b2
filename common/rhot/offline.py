"""The whole tracker over a recording, with the very cores that run live."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

from rhot.core import Output
from rhot.errors import ConfigError
from rhot.messages import HeadPose, MarkerFrame, Message, ObjectPose, PointSet
from rhot.plugins import load_plugin
from rhot.recording import Recording, TrackTiming, marker_track_frames
from rhot.rig import Rig


def core(name: str) -> Callable[..., Any]:
    """Return a service's core by its entry point.

    Raises:
        ConfigError: it is not installed here.
    """
    loaded: Callable[..., Any] = load_plugin("rhot.cores", name, "offline tracking", name)
    return loaded


class PlayedFeet(Protocol):
    """The feet of a recording; `rhot_feet.offline.RecordedFeet` is one."""

    @property
    def frame_count(self) -> int:
        """How many pictures there are."""
        ...

    @property
    def frames_done(self) -> int:
        """How many of them were looked at."""
        ...

    @property
    def end_ns(self) -> int:
        """Time of the last picture."""
        ...

    def until(self, t_ns: int) -> list[Output]:
        """Return the head's poses and the feet up to a time; times do not go back."""
        ...


def feet_of(rig: Rig, recording: Recording) -> PlayedFeet | None:
    """Return the feet of a recording, None where it has none.

    Raises:
        ConfigError: the rig has no feet, or a file is missing or cannot be used.
    """
    if recording.depth_camera is None:
        return None
    feet: PlayedFeet = core("feet")(rig, recording)
    return feet


class PlayedObjects(Protocol):
    """The objects beside a recording: `rhot_objects.offline.RecordedObjects`, or `MessagesBeside`."""

    def until(self, t_ns: int) -> list[Output]:
        """Return the poses of objects and head up to a time; times do not go back."""
        ...


class MessagesBeside:
    """Objects and head of a recording's messages, played beside its pictures.

    Args:
        messages: of the recording, in the order of their arrival.
    """

    def __init__(self, messages: Iterable[tuple[str, Message]]) -> None:
        found = [(key, message) for key, message in messages if isinstance(message, ObjectPose)]
        self._messages = deque(sorted(found, key=lambda output: output[1].t_ns))

    def __bool__(self) -> bool:
        """Whether there is anything to play."""
        return bool(self._messages)

    def until(self, t_ns: int) -> list[Output]:
        """Return the poses up to a time that were not returned yet."""
        outputs: list[Output] = []
        while self._messages and self._messages[0][1].t_ns <= t_ns:
            outputs.append(self._messages.popleft())
        return outputs


class OfflineTracker:
    """The cores of a rig, for one recording.

    Args:
        rig: the loaded rig.
        feet: of the recording.
        objects: of the recording; without them, objects of the rig whose source is `recorded` are played from the first
            frame on.
        smooth: whether `run` looks back over the whole recording.

    Raises:
        ConfigError: a core is not installed, or the rig's method keeps no paths to smooth.
    """

    def __init__(
        self, rig: Rig, feet: PlayedFeet | None = None, objects: PlayedObjects | None = None, *, smooth: bool = False
    ) -> None:
        if smooth:
            _require_paths(rig)
        # A rig of feet alone has no cameras to fuse.
        self._fusion: Any = core("fusion")(rig, record=smooth) if rig.config.cameras else None
        self._ik = core("ik")(rig)
        recorded = any(config.source == "recorded" for config in rig.config.objects.values())
        self._objects = core("objects")(rig) if objects is None and recorded else objects
        self._feet, self._smooth = feet, smooth

    @property
    def problems(self) -> dict[str, str]:
        """What the cores complain of now, by core: one sentence, empty = nothing."""
        return {"fusion": "" if self._fusion is None else self._fusion.problem, "ik": self._ik.problem}

    def run(self, frames: Iterable[MarkerFrame]) -> Iterator[tuple[str, Message]]:
        """Yield every message that a live rig would have published for these marker frames, in order.

        Smoothing yields all marker frames, then all points as the whole recording shows them, and the hands from those.
        """
        if self._smooth:
            return self._run_smoothly(frames)
        return track_with(self._fusion, self._ik, frames, self._objects, self._feet)

    def _run_smoothly(self, frames: Iterable[MarkerFrame]) -> Iterator[tuple[str, Message]]:
        fusion, ik = self._fusion, self._ik
        for frame in frames:
            yield f"rhot/markers/{frame.camera}", frame
            fusion.feed(frame)
        for known, points, hands in _smoothed_hands(ik, self._objects, fusion.smoothed()):
            yield from known
            yield from _walked(self._feet, ik, points.t_ns)
            yield "rhot/points", points
            for key, hand in hands:
                yield key, hand
                ik.feed(hand)
        yield from _walked(self._feet, ik)


def track(rig: Rig, frames: Iterable[MarkerFrame], feet: PlayedFeet | None = None) -> Iterator[tuple[str, Message]]:
    """Yield every message that a live rig would have published; see `OfflineTracker`."""
    yield from OfflineTracker(rig, feet).run(frames)


def track_smoothly(rig: Rig, frames: Iterable[MarkerFrame]) -> Iterator[tuple[str, Message]]:
    """Yield the messages of a recording that is looked back over; see `OfflineTracker`."""
    yield from OfflineTracker(rig, smooth=True).run(frames)


def _require_paths(rig: Rig) -> None:
    if not rig.config.cameras:
        raise ConfigError("--smooth looks back at the paths of hands, and this rig has no cameras; leave it out")
    method = rig.config.fusion.method
    if method != "filter":
        raise ConfigError(
            f'{rig.path / "rig.toml"}: --smooth looks back at the paths of [fusion] method = "filter", '
            f'it is "{method}"; set it to "filter" or leave --smooth out'
        )


def _played(objects: Any, ik: Any, t_ns: int) -> Iterator[tuple[str, Message]]:
    """Yield what is known of objects up to a time, when inverse kinematics has heard of it."""
    for key, pose in () if objects is None else objects.until(t_ns):
        if isinstance(pose, ObjectPose) and not isinstance(pose, HeadPose):
            ik.feed_object(pose)
        yield key, pose


def _walked(feet: PlayedFeet | None, ik: Any, t_ns: int | None = None) -> Iterator[tuple[str, Message]]:
    """Yield head, feet and the bodies that follow from them, up to a time or to the end."""
    if feet is not None:
        for key, pose in feet.until(feet.end_ns if t_ns is None else t_ns):
            yield key, pose
            yield from ik.feed(pose)


def track_with(
    fusion: Any, ik: Any, frames: Iterable[MarkerFrame], objects: Any = None, feet: PlayedFeet | None = None
) -> Iterator[tuple[str, Message]]:
    """Yield what cores make of marker frames, recorded objects and feet, as `track` does."""
    for frame in frames:
        yield from _played(objects, ik, frame.t_ns)
        yield from _walked(feet, ik, frame.t_ns)
        yield f"rhot/markers/{frame.camera}", frame
        for points_key, points in fusion.feed(frame):
            yield points_key, points
            yield from ik.feed(points)
    yield from _walked(feet, ik)


def _smoothed_hands(
    ik: Any, objects: Any, every: Iterable[PointSet]
) -> Iterator[tuple[list[Output], PointSet, list[Output]]]:
    """Yield for each set of points the objects' messages up to its time, the points, and their smoothed hands."""
    waiting: deque[list[Output]] = deque()
    for newest in every:
        waiting.append(list(_played(objects, ik, newest.t_ns)))
        for points, hands in ik.feed_smoothed(newest):
            yield waiting.popleft(), points, hands
    for points, hands in ik.finish():
        yield waiting.popleft(), points, hands


def rig_timing(rig: Rig) -> dict[str, TrackTiming]:
    """Return read-out and exposure of each camera as `rig.toml` states them, for recordings that do not."""
    return {
        name: TrackTiming(exposure_s=camera.exposure_s, readout_s=camera.readout_s)
        for name, camera in rig.config.cameras.items()
    }


def marker_frames(rig: Rig, recording: Recording) -> Iterator[MarkerFrame]:
    """Return the marker frames of a recording: read from its tracks, or found in its pictures."""
    if not recording.cameras:
        return iter(())
    recording.require_times()
    if recording.holds_markers:
        return iter(marker_track_frames(rig, recording))
    frames: Iterator[MarkerFrame] = core("capture")(rig, recording)
    return frames
