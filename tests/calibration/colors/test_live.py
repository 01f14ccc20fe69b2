from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from bus_watch import settled
from click.testing import CliRunner

from rhot.bus import Answer, Bus, Reply, Request
from rhot.errors import BusError, DeviceError
from rhot.rig import BusConfig
from rhot.rig.colors import load_colors
from rhot_calibration.colors.command import colors
from rhot_calibration.colors.learning import decoded, live_pictures


def coded(image: Any, suffix: str) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1])


async def previews(bus: Bus, images: dict[str, Any], asked: list[str]) -> None:
    """Answer for cameras as capture does, with PNG where it is asked for."""

    def answer(request: Request) -> Answer:
        camera = request.key.rsplit("/", 1)[1]
        asked.append(camera)
        if request.parameters.get("format") == "png":
            return Answer(coded(images[camera], ".png"), "image/png")
        return Answer(coded(images[camera], ".jpg"), "image/jpeg")

    for camera in images:
        bus.queryable(f"rhot/preview/{camera}", answer)
    await settled(bus)


async def test_pictures_come_over_the_bus_as_they_are(router: BusConfig, scene: Any, six_shapes: Any) -> None:
    images = {name: scene(six_shapes(seed), noise=2.0).image for seed, name in enumerate(("left", "right"))}
    async with await Bus.open(router) as bus:
        await previews(bus, images, [])
        pictures = await live_pictures(router, ["left", "right"])
        assert list(pictures) == ["left", "right"]
        for name, picture in pictures.items():
            assert np.array_equal(picture, images[name])
        with pytest.raises(BusError, match="camera top: no capture service answers"):
            await live_pictures(router, ["top"])


async def test_colours_are_learnt_live(
    router: BusConfig, scene: Any, six_shapes: Any, tmp_path: Path, write_rig: Callable[..., Path]
) -> None:
    drawn = {name: scene(six_shapes(seed), noise=2.0) for seed, name in enumerate(("left", "right"))}
    rig = write_rig({"left": "", "right": ""})
    connect = ("--rig", str(rig), "--connect", router.connect[0])
    asked: list[str] = []
    async with await Bus.open(router) as bus:
        await previews(bus, {name: each.image for name, each in drawn.items()}, asked)
        save = ["--live", "--save", str(tmp_path / "seen"), *connect]
        saved = await asyncio.to_thread(CliRunner().invoke, colors, save)
        assert saved.exit_code == 0, saved.exception
        assert np.array_equal(np.asarray(cv2.imread(str(tmp_path / "seen" / "right.png"))), drawn["right"].image)
        assert not (rig / "colors.json").exists()
        picks = [
            f"--pick={marker}={u:.0f},{v:.0f}@{camera}"
            for camera, each in drawn.items()
            for marker, (u, v, _) in each.truth.items()
        ]
        learnt = await asyncio.to_thread(CliRunner().invoke, colors, ["--live", *picks, *connect])
    assert learnt.exit_code == 0, learnt.exception
    assert len(load_colors(rig / "colors.json").markers) == 6
    assert sorted(asked) == ["left", "left", "right", "right"]


@pytest.mark.parametrize(
    ("replies", "error", "words"),
    [
        ([], BusError, "no capture service answers"),
        ([Reply("", b"", "", "no frame yet")], DeviceError, "camera left: no frame yet"),
        ([Reply("k", b"words", "text/plain")], DeviceError, "5 bytes of text/plain"),
        ([Reply("k", b"", "image/png")], DeviceError, "0 bytes of image/png"),
    ],
)
def test_what_is_no_picture_is_said(replies: list[Reply], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        decoded("left", replies)
