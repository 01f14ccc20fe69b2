"""Collecting board views from running capture services, with a display that says what is missing."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.live import Live

from rhot.atomic_file import write_atomic
from rhot.bus import CONNECT_S, Bus
from rhot.errors import BusError, ConfigError
from rhot.recording.picture_file import decode_picture
from rhot.rig import BusConfig
from rhot.service.stop import install_stop
from rhot_calibration.cameras.board.detect import detect_board
from rhot_calibration.cameras.live.display import preview_of, session_display, state_line
from rhot_calibration.cameras.live.session import Session, label
from rhot_calibration.cameras.solve.views import Board, BoardView, ViewSet
from rhot_calibration.writing import keyboard

_ROUND_S: Final = 0.2
_ANSWER_S: Final = 1.0
_ALL_THERE_S: Final = 10.0

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class _Look:
    """One camera's answer: its picture as it came, its size, and where the board is in it."""

    payload: bytes
    lossless: bool
    size: tuple[int, int]
    view: BoardView | None


async def collect(
    config: BusConfig, cameras: Sequence[str], board: Board, out: Path, console: Console, *, enough: int | None
) -> ViewSet:
    """Collect views until there are enough or somebody ends it with Ctrl-C, and return what there is.

    The pictures taken are kept as a recording, `<out>/<camera>/NNNNNN.png`.

    Args:
        config: how the rig's router is reached.
        cameras: their names, in the order of `rig.toml`.
        board: what is shown.
        out: folder of the recording; it must not hold pictures of these cameras yet.
        console: takes the display, or plain lines where it is no terminal.
        enough: this many sets are enough; None = as many as good coverage needs.

    Raises:
        BusError: there is no router, or a camera does not answer at all.
        ConfigError: `out` holds pictures already or cannot be written to.
    """
    prepare_folder(out, cameras)
    stop = install_stop()
    async with await Bus.open(config, timeout_s=CONNECT_S) as bus:
        collector = Collector(bus, cameras, board, out)
        session = await collector.begin(stop.requested, enough)
        if session is None:
            return ViewSet(board, {}, {}, {})
        await _follow(collector, session, console, stop.requested)
        return session.view_set


async def _follow(collector: Collector, session: Session, console: Console, ended: asyncio.Event) -> None:
    def pressed(key: str) -> None:
        if key == "u":
            undone = session.undo()
            if undone is not None:
                collector.discard(undone)
        elif key == "q":
            ended.set()

    shown = Live(console=console, auto_refresh=False) if console.is_terminal else contextlib.nullcontext()
    with shown as display, keyboard(pressed) as keys:
        async for taken in rounds(collector, session, ended):
            if isinstance(display, Live):
                display.update(session_display(session.progress, collector.silent, keys=keys), refresh=True)
            elif taken is not None:
                console.print(
                    f"{taken + 1} taken: {', '.join(session.progress.seeing)}; {state_line(session.progress)}"
                )


async def rounds(collector: Collector, session: Session, ended: asyncio.Event) -> AsyncIterator[int | None]:
    """Look through all cameras five times a second until there is enough or it is ended.

    Yields:
        After each look the number of a set that was taken with it, else None.
    """
    while not (session.complete or ended.is_set()):
        begun = time.monotonic()
        yield await collector.round(session)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(max(0.0, _ROUND_S - (time.monotonic() - begun))):
                await ended.wait()


class Collector:
    """Asks all cameras at once, and keeps the pictures of the sets taken.

    Attributes:
        silent: cameras that do not answer, and why.
        newest: camera to the last picture that it answered with, as it came.
    """

    def __init__(self, bus: Bus, cameras: Sequence[str], board: Board, out: Path) -> None:
        self._bus = bus
        self._cameras = tuple(cameras)
        self._board = board
        self._out = out
        self.newest: dict[str, bytes] = {}
        self.silent: dict[str, str] = {}

    async def begin(self, ended: asyncio.Event, enough: int | None) -> Session | None:
        """Wait until every camera has answered and return the session; None when it was ended before."""
        deadline = time.monotonic() + _ALL_THERE_S
        sizes: dict[str, tuple[int, int]] = {}
        while not ended.is_set():
            looks = await self._looks(lossless=False)
            sizes |= {name: look.size for name, look in looks.items()}
            if len(sizes) == len(self._cameras):
                return Session(self._board, {name: sizes[name] for name in self._cameras}, enough)
            if time.monotonic() > deadline:
                missing = "; ".join(f"{name}: {why}" for name, why in self.silent.items() if name not in sizes)
                raise BusError(
                    f"no picture within {_ALL_THERE_S:.0f} s from {missing}. Start `rhot capture --camera NAME` where "
                    "that camera is, and `rhot start`; `rhot status` shows who is there"
                )
            await asyncio.sleep(_ROUND_S)
        return None

    async def round(self, session: Session) -> int | None:
        """Look once through all cameras; return the number of a set that was taken with it, else None."""
        looks = await self._looks(lossless=session.holding)
        views = {name: look.view for name, look in looks.items() if look.view is not None}
        number = session.progress.sets
        taken = session.feed(views, time.monotonic())
        if taken is None:
            return None
        pictures = {label(name, number): looks[name] for name in taken}
        await asyncio.to_thread(self._keep, pictures)
        return number

    async def _looks(self, *, lossless: bool) -> dict[str, _Look]:
        answers = await asyncio.gather(*(self._look(name, lossless) for name in self._cameras))
        return {name: look for name, look in zip(self._cameras, answers, strict=True) if look is not None}

    async def _look(self, name: str, lossless: bool) -> _Look | None:
        payload, reason = await preview_of(self._bus, name, "png" if lossless else "jpeg", _ANSWER_S)
        if payload is None:
            self.silent[name] = reason
            return None
        if self.newest.get(name) == payload:
            # A camera that has stopped would look like a board held perfectly still.
            self.silent[name] = "its picture does not change"
            return None
        self.newest[name] = payload
        look = await asyncio.to_thread(_examined, payload, lossless, self._board)
        if look is None:
            self.silent[name] = "its answer is not a picture"
            return None
        self.silent.pop(name, None)
        return look

    def _keep(self, pictures: dict[str, _Look]) -> None:
        for name, look in pictures.items():
            data = look.payload if look.lossless else bytes(cv2.imencode(".png", _decoded(look.payload))[1])
            write_atomic(self._out / name, data)

    def discard(self, number: int) -> None:
        """Remove the pictures of a set that was undone."""
        for name in self._cameras:
            (self._out / label(name, number)).unlink(missing_ok=True)


def _decoded(payload: bytes) -> Image:
    picture = decode_picture(payload)
    return np.empty((0, 0, 3), np.uint8) if picture is None else np.asarray(picture, np.uint8)


def _examined(payload: bytes, lossless: bool, board: Board) -> _Look | None:
    picture = _decoded(payload)
    if picture.size == 0:
        return None
    gray = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    size = (picture.shape[1], picture.shape[0])
    # A thorough search where there is no whole board takes half a second, a first glance 30 ms.
    plain = not board.is_charuco
    if plain and not cv2.findChessboardCorners(gray, (board.columns, board.rows), flags=0)[0]:
        return _Look(payload, lossless, size, None)
    return _Look(payload, lossless, size, detect_board(gray, board))


def prepare_folder(out: Path, cameras: Sequence[str]) -> None:
    """Make the folder of a recording.

    Raises:
        ConfigError: it holds pictures of these cameras already or cannot be written to.
    """
    for name in cameras:
        folder = out / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            held = next(folder.glob("*.png"), None)
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be made: {error}") from error
        if held is not None:
            raise ConfigError(f"{held}: pictures are here already; name another folder, or remove them")
