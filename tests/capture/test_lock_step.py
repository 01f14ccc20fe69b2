"""What the page says of cameras before anything is calibrated."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rhot.calibration_step import Room
from rhot.rig import BusConfig
from rhot_capture.lock_step import CameraLook, LockStep, look_remarks, picture_light

GOOD = CameraLook("", 0.004, 4.0, (1.6, 1.6), 200.0, 0.0)


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (CameraLook("", 0.004, 4.0, (1.6, 1.6), 40.0, 0.0), "right: the picture is dark"),
        (CameraLook("", 0.004, 4.0, (1.6, 1.6), 255.0, 0.1), "right: 10 % of the picture is overexposed"),
        (CameraLook("", 0.004, 4.0, (1.6, 2.4), 200.0, 0.0), "set differently"),
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
    bright, clipped = picture_light(image)
    assert bright == 255.0
    assert clipped == pytest.approx(0.1)


async def test_a_capture_service_that_is_not_there_is_named(router: BusConfig, write_rig: Callable[..., Path]) -> None:
    step = LockStep(Room(write_rig({"left": ""}), router))
    following = asyncio.create_task(step.follow())
    async with asyncio.timeout(20.0):
        while not step.view().remarks:
            await asyncio.sleep(0.02)
    following.cancel()
    assert "rhot capture --camera left" in step.view().remarks[0].text
    assert not step.view().done
