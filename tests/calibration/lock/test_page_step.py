"""What the page says of cameras before anything is calibrated."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from bus_watch import PATIENCE_S, settled, until

from rhot.bus import Answer, Bus, Request
from rhot.bus.query import json_answer
from rhot.calibration_step import StepContext
from rhot.errors import ConfigError
from rhot.rig import BusConfig
from rhot.rig.colors import ColorsFile
from rhot.rig.folder import load_config
from rhot_calibration.lock import page_step as lock_step
from rhot_calibration.lock.page_step import CameraLook, LockStep, look_remarks
from rhot_calibration.picture_light import PictureLight
from rhot_capture.service import KeptOptics
from rhot_capture.settings import CameraSettings

GOOD = CameraLook("", 0.004, 4.0, (1.6, 1.6), PictureLight(200.0, 0.0))


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (CameraLook("", 0.004, 4.0, (1.6, 1.6), PictureLight(40.0, 0.0)), "right: the picture is dark"),
        (CameraLook("", 0.004, 4.0, (1.6, 1.6), PictureLight(255.0, 0.1)), "right: 10 % of the picture is overexposed"),
        (CameraLook("", 0.004, 4.0, (1.6, 2.4), PictureLight(200.0, 0.0)), "set differently"),
        (CameraLook("nobody answers"), "right: nobody answers"),
    ],
)
def test_what_is_wrong_is_said(other: CameraLook, words: str) -> None:
    remarks = look_remarks({"left": GOOD, "right": other})
    assert [words in remark.text for remark in remarks] == [True]
    assert remarks[0].tone != "good"


def test_good_cameras_are_good() -> None:
    assert [remark.tone for remark in look_remarks({"left": GOOD, "right": GOOD})] == ["good"]


def test_light_is_measured() -> None:
    image = np.full((100, 100, 3), 20, np.uint8)
    image[:10, :, 0] = 255
    light = PictureLight.of(image)
    assert light.bright == 255.0
    assert light.clipped == pytest.approx(0.1)


async def test_a_capture_service_that_is_not_there_is_named(router: BusConfig, write_rig: Callable[..., Path]) -> None:
    step = LockStep(StepContext(write_rig({"left": ""}), router))
    following = asyncio.create_task(step.follow())
    await until(lambda: step.view().remarks)
    following.cancel()
    assert "rhot capture --camera left" in step.view().remarks[0].text
    assert not step.view().done


_OPTICS = {"exposure_s": 0.004, "gain": 4.0, "white_balance": [1.5, 1.6]}


@pytest.mark.parametrize(
    ("settings", "kept"),
    [
        (b"[" * 100_000, b"{}"),
        (b"[]", b"{}"),
        (json.dumps(_OPTICS | {"white_balance": ["a", "b"]}).encode(), b"{}"),
        (json.dumps(_OPTICS).encode(), b"[]"),
    ],
)
async def test_answers_that_are_none_are_told_and_end_nothing(
    router: BusConfig, write_rig: Callable[..., Path], settings: bytes, kept: bytes
) -> None:
    picture = bytes(cv2.imencode(".png", np.full((48, 64, 3), 90, np.uint8))[1])
    step = LockStep(StepContext(write_rig({"left": ""}), router))
    async with await Bus.open(router) as stranger:
        for key, payload in (("config/capture", settings), ("preview", picture), ("keep/capture", kept)):
            answer = Answer(payload, "application/json")
            stranger.queryable(f"rhot/{key}/left", lambda _, answer=answer: answer)  # type: ignore[misc]
        await settled(stranger)
        following = asyncio.create_task(step.follow())
        await until(lambda: step.view().remarks)
        assert not following.done()
        following.cancel()
    assert "its settings are not understood" in step.view().remarks[0].text


class StubCamera:
    """What a capture service answers, with its optics kept in a rig folder of its own."""

    def __init__(self, bus: Bus, rig: Path, name: str) -> None:
        config = load_config(rig).cameras[name]
        self.settings = CameraSettings.from_config(config, ColorsFile(markers={}))
        self.kept = KeptOptics(rig, name)
        picture = np.full((60, 80, 3), 90, np.uint8)
        jpeg = bytes(cv2.imencode(".jpg", picture)[1])
        bus.queryable(f"rhot/preview/{name}", lambda _: Answer(jpeg, "image/jpeg"))
        bus.queryable(f"rhot/config/capture/{name}", lambda _: json_answer(self.settings.model_dump(mode="json")))
        bus.queryable(f"rhot/keep/capture/{name}", self._answer_keep, slow=True)
        self.held: threading.Event | None = None

    def _answer_keep(self, request: Request) -> Answer:
        state = self._kept(request)
        held, self.held = self.held, None
        if held is not None:
            held.wait(PATIENCE_S)
        return state

    def _kept(self, request: Request) -> Answer:
        if request.parameters.get("do") == "save":
            self.kept.save(self.settings)
        elif request.parameters.get("do") == "undo":
            self.settings = self.settings.model_copy(update=self.kept.undo().model_dump())
        return json_answer(self.kept.state(self.settings).model_dump(mode="json"))


async def test_what_the_sliders_set_is_saved_and_undone(router: BusConfig, write_rig: Callable[..., Path]) -> None:
    rig = write_rig({"left": "", "right": ""})
    step = LockStep(StepContext(rig, router))
    async with await Bus.open(router) as bus:
        cameras = {name: StubCamera(bus, rig, name) for name in ("left", "right")}
        following = asyncio.create_task(step.follow())
        await until(lambda: step.view().done)
        assert step.view().enabled == frozenset()
        for camera in cameras.values():
            camera.settings = camera.settings.model_copy(update={"gain": 6.5})
        await until(lambda: "left, right: set otherwise than rig.toml" in step.view().remarks[0].text)
        assert step.view().enabled == {"save"}
        await step.press("save", {})
        assert [camera.gain for camera in load_config(rig).cameras.values()] == [6.5, 6.5]
        assert step.view().enabled == {"undo"}
        await step.press("undo", {})
        assert [camera.gain for camera in load_config(rig).cameras.values()] == [4.0, 4.0]
        assert [camera.settings.gain for camera in cameras.values()] == [4.0, 4.0]

        following.cancel()
        cameras["right"].settings = cameras["right"].settings.model_copy(update={"gain": 9.0})
        await step.press("undo", {})  # what was saved before comes back
        (rig / "rig.toml").write_text("not TOML")
        with pytest.raises(ConfigError, match=r"left: .*not TOML.*right: .*not TOML"):
            await step.press("undo", {})


async def test_a_look_from_before_a_press_is_not_shown_after_it(
    router: BusConfig, write_rig: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lock_step, "_ANSWER_S", PATIENCE_S)
    rig = write_rig({"left": ""})
    step = LockStep(StepContext(rig, router))
    async with await Bus.open(router) as bus:
        camera = StubCamera(bus, rig, "left")
        camera.settings = camera.settings.model_copy(update={"gain": 6.5})
        following = asyncio.create_task(step.follow())
        await until(lambda: step.view().enabled == {"save"})
        held = camera.held = threading.Event()
        await until(lambda: camera.held is None)
        await step.press("save", {})
        assert step.view().enabled == {"undo"}
        again = camera.held = threading.Event()
        held.set()
        await until(lambda: camera.held is None)
        assert step.view().enabled == {"undo"}, "the button that was just pressed does not come back"
        again.set()
        following.cancel()


async def test_another_step_does_not_let_the_cameras_look_gone(
    router: BusConfig, write_rig: Callable[..., Path]
) -> None:
    rig = write_rig({"left": ""})
    step = LockStep(StepContext(rig, router))
    async with await Bus.open(router) as bus:
        StubCamera(bus, rig, "left")
        following = asyncio.create_task(step.follow())
        await until(lambda: step.view().done)
    await until(lambda: not step.view().done)
    following.cancel()
    await asyncio.gather(following, return_exceptions=True)
    assert step.view().done, "the rig was restarted as the step was left"
