"""Tracking a recording again: from its pictures, or from its messages of markers and objects."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from rhot.errors import ConfigError
from rhot.messages import MarkerFrame, Message, ObjectPose
from rhot.offline import MessagesBeside, OfflineTracker, PlayedFeet, PlayedObjects, feet_of, marker_frames, rig_timing
from rhot.recording import load_recording
from rhot.recording.attached import attached_rig, messages_beside
from rhot.recording.messages import RecordedMessages
from rhot.rig import Rig, load_rig
from rhot.take.reading import take_of
from rhot.take.take import Take

_PASSED_ON: Final = ("rhot/space/", "rhot/event", "rhot/truth")
"""Keys of a recording that tracking does not make anew."""


@dataclass(frozen=True, slots=True)
class Retracked:
    """A recording that can be tracked.

    Attributes:
        rig: that it is tracked with.
        frames: its marker frames, in the order of their arrival; found in its pictures while they are read.
        count: how many frames and pictures of feet there are.
        feet, objects: of the recording; None where it has none.
        passed_on: messages that stay as they are.
        beside: files that objects were read from.
        lost: what could not be read of its messages, as sentences.
    """

    rig: Rig
    frames: Iterable[MarkerFrame]
    count: int
    feet: PlayedFeet | None
    objects: PlayedObjects | None
    passed_on: list[tuple[str, Message]]
    beside: list[Path]
    lost: list[str]

    def tracker(self, *, smooth: bool) -> OfflineTracker:
        """Return a fresh tracker for it.

        Raises:
            ConfigError: a core is not installed, or the rig's method keeps no paths to smooth.
        """
        return OfflineTracker(self.rig, self.feet, self.objects, smooth=smooth)


def open_recorded(path: Path, rig: Rig | Path | None, stack: ExitStack) -> Retracked:
    """Open a recording to track it again.

    Args:
        path: folder of pictures, videos or marker tracks; or messages: MCAP, or JSON Lines.
        rig: to track with, or its folder; None = the one that the recording carries.
        stack: holds the unpacked rig of a recording.

    Raises:
        ConfigError: it cannot be used, holds no marker frames, or carries no rig and none was named.
    """
    loaded = load_rig(rig) if isinstance(rig, Path) else rig
    if path.is_dir():
        beside = messages_beside(path)
        sources = [RecordedMessages(file) for file in beside]
        if loaded is None:
            loaded = _carried(sources, path, stack)
        recording = load_recording(path, rig_timing(loaded))
        feet = feet_of(loaded, recording)
        objects = MessagesBeside(chain.from_iterable(sources))
        count = sum(len(np.unique(track.frames)) for track in recording.cameras.values())
        return Retracked(
            rig=loaded,
            frames=marker_frames(loaded, recording),
            count=count + (0 if feet is None else feet.frame_count),
            feet=feet,
            objects=objects or None,
            passed_on=[],
            beside=beside if objects else [],
            lost=[text for source in sources for text in source.lost],
        )
    source = RecordedMessages(path)
    if loaded is None:
        loaded = _carried([source], path, stack)
    frames: list[MarkerFrame] = []
    things: list[tuple[str, Message]] = []
    passed_on: list[tuple[str, Message]] = []
    for key, message in source:
        if isinstance(message, MarkerFrame):
            frames.append(message)
        elif isinstance(message, ObjectPose):
            things.append((key, message))
        elif key.startswith(_PASSED_ON):
            passed_on.append((key, message))
    if not frames:
        raise ConfigError(f"{path}: holds no marker frames (rhot/markers/…), so there is nothing to track again")
    strangers = sorted({frame.camera for frame in frames} - set(loaded.config.cameras))
    if strangers:
        raise ConfigError(
            f"{path}: camera {strangers[0]} is none of the rig's ({', '.join(loaded.config.cameras)}); name the "
            "rig that it was recorded with"
        )
    played = MessagesBeside(things) or None
    return Retracked(loaded, frames, len(frames), None, played, passed_on, [], source.lost)


def _carried(sources: Iterable[RecordedMessages], path: Path, stack: ExitStack) -> Rig:
    for source in sources:
        if source.attachments:
            return stack.enter_context(attached_rig(source.attachments, source.path))
    raise ConfigError(f"{path}: carries no rig; name the one that it was recorded with")


def track(rig: str | Path | Rig | None, source: str | Path, *, smooth: bool = False) -> Take:
    """Track a recording again, with the very cores that run live, and return the result as arrays.

    Args:
        rig: to track with, or its folder; None = the one that the recording carries.
        source: folder of pictures, videos or marker tracks; or recorded messages: MCAP, or JSON Lines.
        smooth: also use later frames, for the most accurate paths.

    Raises:
        ConfigError: the rig or the recording cannot be used.
    """
    with ExitStack() as stack:
        recorded = open_recorded(Path(source), Path(rig) if isinstance(rig, str) else rig, stack)
        return take_of(_messages(recorded, smooth), recorded.rig)


def _messages(recorded: Retracked, smooth: bool) -> Iterator[tuple[str, Message]]:
    yield from recorded.passed_on
    yield from recorded.tracker(smooth=smooth).run(recorded.frames)
