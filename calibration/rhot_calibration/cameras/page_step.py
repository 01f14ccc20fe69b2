"""The page's step that calibrates the cameras, over the functions of `rhot calibrate cameras --live`."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from datetime import datetime
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from rhot.bus import CONNECT_S, Bus
from rhot.calibration_step import Button, Field, Figures, Remark, StepContext, StepView, Tone, typed_metres
from rhot.errors import ConfigError
from rhot.recording.picture_file import decode_picture
from rhot.rig import CamerasFile, load_rig
from rhot.rig.folder import CAMERAS_FILE
from rhot_calibration.cameras.board.grid import parse_board
from rhot_calibration.cameras.calibration import Calibrated, calibrate_rig, cameras_file, refuse_other_board
from rhot_calibration.cameras.live.coverage import WANTED_FILL, WANTED_SHARED, WANTED_TILTED, WANTED_VIEWS
from rhot_calibration.cameras.live.display import state_line
from rhot_calibration.cameras.live.live import Collector, prepare_folder, rounds
from rhot_calibration.cameras.live.session import Progress, Session, SessionState
from rhot_calibration.cameras.pictures import PictureReading
from rhot_calibration.cameras.solve.views import Board, ViewSet
from rhot_calibration.page_step import PageStep, trial_buttons

# What the page shows of a camera calibration: maps of the pictures, bars, and the figures of the result.

_SIZE: Final = (320, 240)
_COVERED: Final = (70, 160, 60)
_SHARE: Final = 0.45


def coverage_jpeg(area: NDArray[np.bool_], picture: bytes | None) -> bytes:
    """Return a camera's picture with the parts of it tinted in which a board has been, as JPEG.

    Args:
        area: as of `CameraCoverage.area`.
        picture: the newest, coded; None = there is none.
    """
    empty = (30, 30, 30)
    canvas = np.full((_SIZE[1], _SIZE[0], 3), empty, np.uint8)
    seen = None if picture is None else decode_picture(picture)
    if seen is not None:
        canvas = np.asarray(cv2.resize(seen, _SIZE, interpolation=cv2.INTER_AREA), np.uint8)
    covered = np.asarray(cv2.resize(area.astype(np.uint8), _SIZE, interpolation=cv2.INTER_NEAREST)) > 0
    canvas[covered] = ((1.0 - _SHARE) * canvas[covered] + _SHARE * np.array(_COVERED)).astype(np.uint8)
    return bytes(cv2.imencode(".jpg", canvas)[1])


def share_of(progress: Progress | None) -> float:
    """Return how much of what is asked for is there: of all cameras, and of the pictures that tie them, 0 to 1."""
    if progress is None:
        return 0.0
    parts = [coverage.share for coverage in progress.cameras.values()]
    parts += [min(1.0, shared / WANTED_SHARED) for shared in progress.pairs.values()] if len(parts) == 2 else []
    return sum(parts) / len(parts)


def coverage_table(progress: Progress) -> Figures:
    """Return what each camera has seen, and what is asked for."""
    rows = []
    for name, coverage in progress.cameras.items():
        tilted = " ".join(
            f"{arrow}{min(count, WANTED_TILTED)}" for arrow, count in zip("←→↑↓", coverage.tilted.values(), strict=True)
        )
        rows.append(
            (
                name,
                f"{coverage.views} of {WANTED_VIEWS}",
                f"{100 * coverage.area_share:.0f} %",
                f"{100 * float(coverage.fills.max(initial=0.0)):.0f} of {100 * WANTED_FILL:.0f} %",
                f"{tilted} of {WANTED_TILTED}",
            )
        )
    shared = ", ".join(f"{a}–{b} {count}" for (a, b), count in progress.pairs.items())
    title = f"Pictures taken: {progress.sets}; seen by two cameras: {shared or '-'}"
    return Figures(title, ("camera", "views", "area", "nearest", "tilted"), tuple(rows))


def result_tables(found: Calibrated) -> tuple[Figures, ...]:
    """Return how good a calibration is."""
    cameras = tuple(
        (name, str(figures.pictures), f"{figures.rms_px:.2f}", f"{found.models[name].K[0, 0]:.1f}")
        for name, figures in found.cameras.items()
    )
    pairs = tuple(
        (
            f"{first}, {second}",
            f"{figures.baseline_mm:.1f} ± {figures.baseline_sd_mm:.1f}",
            f"{figures.epipolar_p95_px:.2f}",
            "-" if (first, second) not in found.held_out_px else f"{found.held_out_px[first, second]:.2f}",
        )
        for (first, second), figures in found.pairs.items()
    )
    errors = tuple(
        (f"{100 * error.distance_m:.0f} cm", f"{error.calibration_mm:.2f}", f"{error.total_mm:.2f}")
        for error in found.errors
    )
    return (
        Figures("Error to expect in space", ("at", "calibration mm", "with marker noise mm"), errors),
        Figures("Pairs", ("cameras", "baseline mm", "epipolar p95 px", "held out px"), pairs),
        Figures("Lenses", ("camera", "pictures", "RMS px", "focal px"), cameras),
    )


_GOOD: Final = (SessionState.HOLDING, SessionState.ACCEPTED, SessionState.COMPLETE)
_ADVICE: Final = 4
_SILENT_S: Final = 2.0
_NO_BOARD_S: Final = 8.0
"""So long without a board, the page says what may be the matter."""


class CameraStep(PageStep[CamerasFile]):
    """Collects views of a board and solves for all cameras."""

    about = (
        "Print a board (`rhot calibrate board`), glue it to something flat and measure one square. Start, then hold "
        "the board still before the cameras, at one place after the other: near and far, in all parts of the pictures, "
        "tilted to all sides. A picture is taken when it stands still for a moment. When nothing is missing, or when "
        "you finish, the cameras are solved. Try the result, then save."
    )
    buttons = (
        Button("start", "start taking pictures", "Press again to start over."),
        Button("back", "discard last picture"),
        Button("solve", "finish and solve", "Use the pictures taken so far."),
        *trial_buttons(CAMERAS_FILE, "cameras"),
    )

    def __init__(self, context: StepContext) -> None:
        super().__init__(context, context.rig_path / CAMERAS_FILE, CamerasFile)
        rig = load_rig(context.rig_path)
        self._cameras = tuple(rig.config.cameras)
        sim = rig.config.sim
        self.fields = (
            Field("board", "board", f"{sim.board_columns}x{sim.board_rows}", (), "Inner corners along and across."),
            Field("square_mm", "square, mm", f"{1e3 * sim.board_square_m:g}", (), "Side of a square, measured."),
            Field(
                "baseline_mm",
                "lenses, mm",
                "",
                (),
                "Distance of the first two cameras' lenses by a ruler, for checking the result; optional.",
            ),
        )
        self._ended = asyncio.Event()
        self._session: Session | None = None
        self._collector: Collector | None = None
        self._tables: tuple[Figures, ...] = ()
        self._warnings: tuple[Remark, ...] = ()
        self._searching_since = 0.0
        self._silent_since: dict[str, float] = {}

    def view(self) -> StepView:
        """Return coverage, figures and what is missing."""
        progress = None if self._session is None else self._session.progress
        taken = progress is not None and bool(progress.sets)
        if self._collector is not None:
            own = {"solve", "back"} if taken else {"solve"}
        else:
            own = set() if self._doing else {"start", "solve"} if taken else {"start"}
        return self._view(
            self._standing(
                ("not calibrated: fields of view and positions are those of rig.toml", False),
                "new cameras on trial",
                lambda stored: (f"calibrated {stored.date}", set(self._cameras) <= set(stored.cameras)),
            ),
            actions=own,
            share=share_of(progress),
            remarks=self._remarks(progress),
            tables=(*self._tables, *(() if progress is None else (coverage_table(progress),))),
            pictures={} if progress is None else self._pictures(progress),
            # The page need not ask for the very pictures that are looked at here.
            held={} if self._collector is None else self._jpegs(self._collector.newest),
        )

    def _jpegs(self, pictures: Mapping[str, bytes]) -> dict[str, bytes]:
        """Return the JPEG pictures in the rig's order: they came in the order in which the cameras answered."""
        return {name: pictures[name] for name in self._cameras if pictures.get(name, b"").startswith(b"\xff\xd8")}

    def _remarks(self, progress: Progress | None) -> tuple[Remark, ...]:
        said: list[Remark] = []
        if self._collector is not None:
            said += [Remark(f"{name}: {why}", "wrong") for name, why in self._silent(self._collector.silent)]
            if progress is not None:
                said += self._advice(progress)
        elif self._kept.on_trial:
            said.append(
                Remark(
                    "The rig tracks with the new cameras now: move a hand and look at the tab Live. Save or undo.",
                    "good",
                )
            )
        elif self._found is not None:
            said.append(Remark("The cameras are solved. Look at the figures, then try them.", "good"))
        return (*said, *self._warnings)

    def _silent(self, silent: Mapping[str, str]) -> list[tuple[str, str]]:
        """Return the cameras that have been silent for a while, and why: one picture may well come late."""
        now_s = asyncio.get_running_loop().time()
        self._silent_since = {name: self._silent_since.get(name, now_s) for name in silent}
        return [(name, why) for name, why in silent.items() if now_s - self._silent_since[name] > _SILENT_S]

    def _advice(self, progress: Progress) -> list[Remark]:
        tone: Tone = "good" if progress.state in _GOOD else "warning"
        said = [Remark(f"{progress.sets} taken: {state_line(progress)}", tone)]
        now_s = asyncio.get_running_loop().time()
        if progress.state is not SessionState.SEARCHING:
            self._searching_since = now_s
        elif now_s - self._searching_since > _NO_BOARD_S:
            said.append(
                Remark(
                    "No camera finds the board. Is it wholly in the picture, evenly lit, sharp, with a white rim? Are "
                    "the counts those of the inner corners (where four squares meet)?",
                    "wrong",
                )
            )
        return said + [Remark(sentence) for sentence in progress.missing[:_ADVICE]]

    def _pictures(self, progress: Progress) -> dict[str, bytes]:
        newest = {} if self._collector is None else self._collector.newest
        return {
            f"{name}: green = the board has been there": coverage_jpeg(coverage.area, newest.get(name))
            for name, coverage in progress.cameras.items()
        }

    async def press(self, button: str, values: Mapping[str, str]) -> None:
        """Start, discard the last picture, solve, try, save or undo.

        Raises:
            RhotError: it cannot be done.
        """
        if button == "start" and not self._doing:
            await self._collect(_board(values))
            if self._session is not None:
                await self._solve(values)
        elif button == "back" and self._session is not None and self._collector is not None:
            undone = self._session.undo()
            if undone is not None:
                self._collector.discard(undone)
        elif button == "solve" and self._collector is not None:
            self._ended.set()  # whoever pressed start goes on from here
        elif button == "solve":
            await self._solve(values)
        else:
            await super().press(button, values)

    async def _collect(self, board: Board) -> None:
        folder = self._context.rig_path / f"calibration-{datetime.now().astimezone():%Y%m%d-%H%M%S}"
        self._session, self._found, self._tables, self._warnings = None, None, (), ()
        self._ended.clear()
        with self._busy("waiting for the cameras"):
            try:
                async with await Bus.open(self._context.bus, timeout_s=CONNECT_S) as bus:
                    prepare_folder(folder, self._cameras)
                    self._collector = Collector(bus, self._cameras, board, folder)
                    self._session = await self._collector.begin(self._ended, None)
                    if self._session is None:
                        return
                    self._doing = "taking pictures"
                    self._searching_since = asyncio.get_running_loop().time()
                    async for _ in rounds(self._collector, self._session, self._ended):
                        pass
            finally:
                self._collector = None

    async def _solve(self, values: Mapping[str, str]) -> None:
        if self._session is None:
            raise ConfigError("no pictures yet: start taking some first")
        views = self._session.view_set
        baseline_m = _metres("lens distance", values["baseline_mm"]) if values["baseline_mm"].strip() else None
        self._found, self._tables, self._warnings = None, (), ()
        with self._busy("solving"):
            found = await asyncio.to_thread(self._solved, views, baseline_m)
        self._found = cameras_file(found, views)
        self._tables = result_tables(found)
        self._warnings = (
            *(Remark(f"left out {label}: {why}") for label, why in found.left_out.items()),
            *(Remark(text, "warning") for text in found.warnings),
        )

    def _solved(self, views: ViewSet, baseline_m: float | None) -> Calibrated:
        refuse_other_board(PictureReading(views))

        def report(step: str) -> None:
            self._doing = f"solving: {step}"

        return calibrate_rig(load_rig(self._context.rig_path), views, baseline_m, report)


def _board(values: Mapping[str, str]) -> Board:
    return parse_board(values["board"], _metres("square", values["square_mm"]))


def _metres(what: str, text: str) -> float:
    """Return a length that was typed in millimetres.

    Raises:
        ConfigError: not a positive number.
    """
    found = typed_metres(what, text, "25")
    if not 0.0 < found < 10.0:
        raise ConfigError(f"{what} {1e3 * found:g} mm: must be more than 0 and less than 10000 mm")
    return found
