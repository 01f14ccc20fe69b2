"""The page's step for the cameras: collecting from previews, solving, trying, and its wrong turns."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import AsyncIterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from boards.pictures import board_picture
from boards.views import BOARD, SimulatedViews, simulated_views
from bus_watch import until

from rhot.bus import Answer, Bus, Request
from rhot.calibration_step import StepContext
from rhot.errors import BusError, CalibrationError, ConfigError
from rhot.rig import BusConfig, load_rig
from rhot_calibration.cameras import page_step
from rhot_calibration.cameras.live.session import Session
from rhot_calibration.cameras.page_step import CameraStep

VALUES = {"board": "9x6", "square_mm": "25", "baseline_mm": ""}


def taken(rig: Path) -> int:
    """How many cameras have kept the first picture."""
    return len(list(rig.glob("calibration-*/*/000000.png")))


def said(step: CameraStep) -> str:
    return " ".join(remark.text for remark in step.view().remarks)


class Views:
    """Stands for the taking of pictures: simulated views of a board, one set after the other."""

    newest: dict[str, bytes] = {}
    silent: dict[str, str] = {}

    def __init__(self, simulated: SimulatedViews) -> None:
        self.simulated = simulated
        self.all_shown = False

    def __call__(self, *_: object) -> Views:
        return self

    async def begin(self, *_: object) -> Session:
        return Session(BOARD, self.simulated.views.sizes)

    async def rounds(self, _: Views, session: Session, ended: asyncio.Event) -> AsyncIterator[None]:
        views = self.simulated.views.views
        t_s = 0.0
        for number in sorted({number for _, number in views}):
            seen = {camera: view for (camera, at), view in views.items() if at == number}
            for _round in range(8):
                t_s += 0.2
                session.feed(seen, t_s)
            yield None
        self.all_shown = True
        await ended.wait()


async def solved(
    router: BusConfig, rig: Path, monkeypatch: pytest.MonkeyPatch, values: dict[str, str], places: int
) -> CameraStep:
    """A step that has been led to its solution."""
    views = Views(simulated_views(3, places=places))
    monkeypatch.setattr(page_step, "Collector", views)
    monkeypatch.setattr(page_step, "rounds", views.rounds)
    step = CameraStep(StepContext(rig, router))
    started = asyncio.create_task(step.press("start", values))
    await until(lambda: views.all_shown)
    await step.press("solve", values)
    await started
    return step


async def test_a_solution_is_shown_tried_and_undone(
    router: BusConfig, rig_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = await solved(router, rig_folder, monkeypatch, VALUES, 20)
    assert "The cameras are solved" in said(step)
    errors, pairs, *_ = step.view().tables
    assert errors.title == "Error to expect in space"
    assert 0.0 < float(errors.rows[0][1]) < 5.0
    assert float(pairs.rows[0][1].split()[0]) == pytest.approx(75.0, abs=3.0)
    assert not load_rig(rig_folder).calibrated
    await step.press("try", VALUES)
    assert load_rig(rig_folder).calibrated
    assert not step.view().done
    await step.press("undo", VALUES)
    assert not load_rig(rig_folder).calibrated
    await step.press("try", VALUES)
    await step.press("save", VALUES)
    assert step.view().done


async def test_what_cannot_be_right_is_refused_in_words(
    router: BusConfig, rig_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(CalibrationError, match="found in 4 pictures only, 5 are the least"):
        await solved(router, rig_folder, monkeypatch, VALUES, 4)
    for values, words in (
        (VALUES | {"board": "nine"}, "board 'nine' is not understood"),
        (VALUES | {"square_mm": "an inch"}, "square 'an inch': not a number"),
        (VALUES | {"square_mm": "-25"}, "more than 0"),
    ):
        with pytest.raises((CalibrationError, ConfigError), match=words):
            await CameraStep(StepContext(rig_folder, router)).press("start", values)


async def test_pictures_are_taken_live_and_wrong_turns_are_answered(
    router: BusConfig, rig_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = CameraStep(StepContext(rig_folder, router))
    monkeypatch.setattr(page_step, "_NO_BOARD_S", 0.3)
    board, _ = board_picture(BOARD)
    asked = {"left": 0, "right": 0}
    board_from = sys.maxsize

    def answer(request: Request, camera: str) -> Answer:
        asked[camera] += 1
        number = asked[camera]
        picture = board.copy() if number >= board_from else np.full_like(board, 90)
        picture[0, :3] = number % 250, number % 241, number // 250  # no two pictures are the same
        suffix = ".png" if request.parameters.get("format") == "png" else ".jpg"
        return Answer(bytes(cv2.imencode(suffix, picture)[1]), "image/png")

    async with await Bus.open(router) as bus:
        for camera in ("left", "right"):
            bus.queryable(f"rhot/preview/{camera}", partial(answer, camera=camera))
        started = asyncio.create_task(step.press("start", VALUES))
        await until(lambda: "No camera finds the board" in said(step))
        assert list(step.view().held) == ["left", "right"], "the page need not ask for these pictures itself"
        # From the same pair on in both cameras: one of them may have been asked for its half of the present one.
        board_from = max(asked.values()) + 1
        await until(lambda: "1 taken" in said(step))
        assert step.view().share > 0.1
        assert taken(rig_folder) == 2
        await step.press("back", VALUES)
        assert taken(rig_folder) == 0
        await step.press("solve", VALUES)
        with pytest.raises(CalibrationError):
            await started
    assert step.view().enabled == {"start"}


async def test_a_rig_that_is_not_there_is_named(rig_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_step, "CONNECT_S", 0.1)
    step = CameraStep(StepContext(rig_folder, BusConfig(connect=("tcp/127.0.0.1:1",))))
    with pytest.raises(BusError, match="no Zenoh router answers"):
        await step.press("start", VALUES)
    assert step.view().enabled == {"start"}
