"""Collecting views of a board that somebody holds in front of running cameras.

Cameras are not in step, so a set of pictures counts as taken together only when the board stands still: then it does
not matter which camera looked first. A set is taken after a countdown during which it stayed still, when it is sharp
and differs from what each camera has seen before.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from itertools import zip_longest
from typing import Final

import numpy as np

from rhot_calibration.cameras.live.coverage import (
    WANTED_SHARED,
    CameraCoverage,
    camera_coverage,
    links,
    similar,
    unlinked,
)
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet

MAX_SPEED_PX_S: Final = 3.0
"""Corners of a board held still move no faster (RMS); cameras whose pictures are 30 ms apart then disagree by less
than 0.1 px. Between previews a fifth of a second apart it is 0.6 px."""
NOISE_PX: Final = 0.3
"""Corners of a still board seem to move by as much (RMS) at most, however soon the next picture."""
MAX_EDGE_PX: Final = 4.0
"""Wider edges are blurred; measured on sharp simulated pictures: 1.6 px."""
COUNTDOWN_S: Final = 0.75
COUNTS: Final = 3
FRESH_S: Final = 1.5
"""A view older than this says nothing about where the board is now."""


class SessionState(Enum):
    """What the session waits for."""

    SEARCHING = "no camera sees the whole board"
    MOVING = "hold it still; lean it on something"
    BLURRED = "the picture is blurred: focus the lens, or more light and a shorter exposure"
    SIMILAR = "taken already; move it somewhere else or tilt it differently"
    HOLDING = "hold still"
    ACCEPTED = "taken; move on"
    COMPLETE = "enough"


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a session stands.

    Attributes:
        state: what it waits for.
        count: what remains of the countdown (3, 2, 1) while holding, else 0.
        sets: sets taken.
        seeing: cameras that see the board now.
        cameras: what each camera has seen and still lacks.
        pairs: pictures that pairs of cameras share.
        missing: what to do next, sentences for people, the most urgent first.
    """

    state: SessionState
    count: int
    sets: int
    seeing: tuple[str, ...]
    cameras: Mapping[str, CameraCoverage]
    pairs: Mapping[tuple[str, str], int]
    missing: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class _Taken:
    """What follows from the sets taken so far."""

    cameras: Mapping[str, CameraCoverage]
    pairs: Mapping[tuple[str, str], int]
    missing: tuple[str, ...]


class Session:
    """Decides which rounds of previews become sets of views.

    Args:
        board: what is shown.
        sizes: camera to (width, height), pixels, in the order of `rig.toml`.
        enough: complete after so many sets; None = when every camera has seen enough and all are linked.
    """

    def __init__(self, board: Board, sizes: Mapping[str, tuple[int, int]], enough: int | None = None) -> None:
        self.board = board
        self.sizes = dict(sizes)
        self._enough = enough
        self._sets: list[dict[str, BoardView]] = []
        self._latest: dict[str, tuple[float, BoardView]] = {}
        self._now_s = -math.inf
        self._held_from_s: float | None = None
        self._state = SessionState.SEARCHING
        self._taken = self._summary()

    def feed(self, views: Mapping[str, BoardView], t_s: float) -> dict[str, BoardView] | None:
        """Take one round of previews; return the views of a set when one was taken with it, else None.

        Args:
            views: where the cameras see the board; those that do not see it, or did not answer, are absent.
            t_s: when, seconds on any steady clock.
        """
        before = {camera: seen for camera, seen in self._latest.items() if t_s - seen[0] <= FRESH_S}
        self._latest = before | {camera: (t_s, view) for camera, view in views.items()}
        self._now_s = t_s
        # A camera that sees the board for the first time cannot tell yet whether it stands still.
        steady = {camera: view for camera, view in views.items() if camera in before}
        self._state = self._judged(before, steady)
        if self._state is not SessionState.HOLDING:
            self._held_from_s = None
            return None
        if self._held_from_s is None:
            self._held_from_s = t_s
        held_s = t_s - self._held_from_s
        # A slow camera may miss a round: a set without it would tie nothing to it.
        awaited = self._latest.keys() - steady.keys()
        if held_s < COUNTDOWN_S or (awaited and held_s < COUNTDOWN_S + FRESH_S):
            return None
        self._sets.append(steady)
        self._taken = self._summary()
        self._held_from_s = None
        self._state = SessionState.COMPLETE if self.complete else SessionState.ACCEPTED
        return steady

    def _judged(self, before: Mapping[str, tuple[float, BoardView]], views: Mapping[str, BoardView]) -> SessionState:
        if not self._seeing:
            return SessionState.SEARCHING
        if not views or any(self._moves(before[camera], view) for camera, view in views.items()):
            return SessionState.MOVING
        if not any(self._is_new(camera, view) for camera, view in views.items()):
            return SessionState.ACCEPTED if self._state is SessionState.ACCEPTED else SessionState.SIMILAR
        return (
            SessionState.BLURRED
            if any(view.sharpness > MAX_EDGE_PX for view in views.values())
            else SessionState.HOLDING
        )

    @property
    def _seeing(self) -> tuple[str, ...]:
        """Cameras that saw the board in the last round."""
        return tuple(name for name in self.sizes if name in self._latest and self._latest[name][0] == self._now_s)

    def _moves(self, before: tuple[float, BoardView], view: BoardView) -> bool:
        return _moved_px(before[1], view) > max(NOISE_PX, MAX_SPEED_PX_S * (self._now_s - before[0]))

    def _is_new(self, camera: str, view: BoardView) -> bool:
        width = self.sizes[camera][0]
        return not any(camera in taken and similar(taken[camera], view, width) for taken in self._sets)

    def undo(self) -> int | None:
        """Forget the set taken last and return its number; None when there is none."""
        if not self._sets:
            return None
        self._sets.pop()
        self._taken = self._summary()
        self._held_from_s, self._state = None, SessionState.MOVING
        return len(self._sets)

    @property
    def complete(self) -> bool:
        """Whether nothing is missing."""
        return not self._taken.missing if self._enough is None else len(self._sets) >= self._enough

    @property
    def holding(self) -> bool:
        """Whether the countdown runs: a picture asked for now may be kept."""
        return self._held_from_s is not None

    @property
    def view_set(self) -> ViewSet:
        """All views taken, numbered from 0."""
        views = {(camera, number): view for number, taken in enumerate(self._sets) for camera, view in taken.items()}
        labels = {(camera, number): label(camera, number) for camera, number in views}
        return ViewSet(self.board, dict(self.sizes), views, labels)

    @property
    def progress(self) -> Progress:
        """Where the session stands."""
        count = 0
        if self._held_from_s is not None:
            left = 1.0 - (self._now_s - self._held_from_s) / COUNTDOWN_S
            count = max(1, math.ceil(COUNTS * left))
        taken = self._taken
        return Progress(self._state, count, len(self._sets), self._seeing, taken.cameras, taken.pairs, taken.missing)

    def _summary(self) -> _Taken:
        views = self.view_set
        cameras = camera_coverage(views)
        return _Taken(cameras, links(views), _advice(views, cameras))


def label(camera: str, number: int) -> str:
    """Return the name of a taken picture within its recording."""
    return f"{camera}/{number:06d}.png"


def _advice(taken: ViewSet, cameras: Mapping[str, CameraCoverage]) -> tuple[str, ...]:
    """Return what to do next: of each camera in turn, that which lacks most first, then what ties cameras together."""
    needy = sorted(cameras, key=lambda name: cameras[name].share)
    turns = zip_longest(*(cameras[name].missing for name in needy))
    said = [f"{name}: {sentence}" for turn in turns for name, sentence in zip(needy, turn, strict=True) if sentence]
    groups = unlinked(taken)
    if len(groups) > 1:
        names = " | ".join(", ".join(group) for group in groups)
        said.append(f"show the board to cameras of different groups at once, {WANTED_SHARED} times: {names}")
    return tuple(said)


def _moved_px(first: BoardView, second: BoardView) -> float:
    """Return the RMS distance of corresponding corners, pixels; infinite where none correspond."""
    _, ours, theirs = np.intersect1d(first.ids, second.ids, assume_unique=True, return_indices=True)
    if ours.size == 0:
        return math.inf
    offsets = first.corners[ours] - second.corners[theirs]
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))
