"""The web page as a person uses it: in a real browser, beside a rig whose services are stubbed."""

from __future__ import annotations

import asyncio
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from page.actions import canvas_size, choose, on_screen, place_of_pixel, press_until, text_shows
from page.browser import CHROMIUM, Browser, open_browser, wait_until
from page.viewer_process import ViewerProcess
from stub_rig import StubRig, StubThread

from rhot.arrays import FloatArray
from rhot.rig import load_rig
from rhot.rig.colors import load_colors
from rhot_sim.running.processes import free_endpoint
from rhot_viewer.scene.viewpoint import PicturePlane, overview

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: apt install chromium)"),
]


SIZE = (820, 460)
KEYS = {"ArrowRight": 39, "End": 35}
CLICK_AGAIN_S = 5.0
TRAIL_S = 6.0
"""Trails last two seconds, and a busy browser shows them later."""
CHANGED = 24
"""Grey levels by which a pixel must differ to have changed: far more than a translucent edge that is redrawn."""


@pytest.fixture
def stub(simulated_rig: tuple[Path, str], tmp_path: Path) -> Iterator[tuple[StubRig, str]]:
    """A stubbed rig, and where its router listens."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    with StubThread(simulated_rig[0], endpoint) as rig:
        yield rig, endpoint


@pytest.fixture
def viewer(stub: tuple[StubRig, str], free_port: int, tmp_path: Path) -> Iterator[ViewerProcess]:
    """A running viewer."""
    rig, endpoint = stub
    made = ViewerProcess(["--rig", str(rig.rig.path), "--connect", endpoint], free_port, tmp_path / "viewer.log")
    try:
        made.start()
        yield made
    finally:
        made.kill()


def picture(browser: Browser) -> NDArray[np.int16]:
    """What the window shows, (height, width, 3), grey levels."""
    decoded = cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(decoded, dtype=np.int16)


def press(browser: Browser, slider: str, key: str) -> None:
    """Press a key on the visible slider with this label, as soon as it can be moved."""
    browser.wait_for(
        f"""(() => {{
            const label = [...document.querySelectorAll('label')].find(
                e => e.textContent.trim() === {slider!r} && e.getClientRects().length);
            if (!label) return false;
            let box = label;
            while (!box.querySelector('[role=slider]')) box = box.parentElement;
            const thumb = box.querySelector('[role=slider]');
            if (thumb.matches('[data-disabled]')) return false;
            thumb.scrollIntoView({{block: 'center'}});
            thumb.focus();
            return document.activeElement === thumb;
        }})()"""
    )
    for kind in ("keyDown", "keyUp"):
        browser.command("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=KEYS[key])


def test_a_person_looks_turns_a_slider_and_asks_for_a_mask(stub: tuple[StubRig, str], viewer: ViewerProcess) -> None:
    rig, _ = stub
    with open_browser(f"{viewer.url}/?fixedDpr=0.5", *SIZE) as browser:
        text_shows(browser, "Right hand")
        text_shows(browser, "little predicted")
        text_shows(browser, "capture/left")
        text_shows(browser, "a stubbed error & <b>its markup</b>")
        only_what_moves_changes(browser, rig)

        browser.click_text("Cameras", "[role=tab]")
        wait_until(lambda: rig.settings["left"].tolerances["thumb"] == 1.0, "the first value")
        press(browser, "thumb", "ArrowRight")
        wait_until(lambda: rig.settings["left"].tolerances["thumb"] == pytest.approx(1.05), "the slider's new value")
        assert rig.settings["right"].tolerances["thumb"] == 1.0
        assert rig.settings["left"].tolerances["index"] == 1.0
        before_s = rig.settings["left"].exposure_s
        press(browser, "exposure ms", "End")
        text_shows(browser, "is longer than a frame at 60 Hz")
        assert rig.settings["left"].exposure_s == before_s
        browser.wait_for(
            f"[...document.querySelectorAll('[role=slider]')].some(e => e.ariaValueNow == {1e3 * before_s:g})"
        )

        rig.still = True
        browser.click_text("Pictures", "[role=tab]")
        browser.click_text("look through left")
        plane = PicturePlane.of(load_rig(rig.rig.path).cameras["left"])
        seen = rig.newest["left"].markers["base"]
        x, y = place_of_pixel(browser, plane, seen.u, seen.v)
        clicked_at = -np.inf

        def asked_for_mask() -> bool:
            nonlocal clicked_at
            if any("'mask': 'base'" in question for question in rig.asked):
                return True
            # The view may not have arrived at the camera yet. Clicks that pile up would come when they are not meant.
            if time.monotonic() - clicked_at > CLICK_AGAIN_S:
                clicked_at = time.monotonic()
                browser.click(x, y)
            return False

        wait_until(asked_for_mask, "the mask of the marker that was clicked")
        browser.wait_for("[...document.querySelectorAll('input')].some(e => e.value === 'base')")
        a_colour_is_set_by_a_click(browser, rig, (x, y))
        assert browser.errors == []

        viewer.stop()
        rig.asked.clear()
        viewer.start()
        # Pictures are asked for only while a browser is connected: it has come back by itself.
        wait_until(lambda: rig.asked, "the browser's return")
        viewer.stop()


def a_colour_is_set_by_a_click(browser: Browser, rig: StubRig, base: tuple[float, float]) -> None:
    """The calibration's colour step, with the view through a camera in which the base marker stands at a pixel."""
    browser.click_text("Calibrate", "[role=tab]")
    browser.wait_for("document.body.innerText.includes('all cameras run') || document.body.innerText.includes('dark')")
    choose(browser, "step", "Colours")
    press_until(browser, "take pictures", "Not clicked yet")
    choose(browser, "marker", "base")
    browser.click(*base)
    browser.wait_for("[...document.querySelectorAll('td')].some(e => e.textContent === '1 of 1')")
    before = rig.rig.colors_path.read_bytes()
    browser.click_text("try")
    wait_until(lambda: list(load_colors(rig.rig.colors_path).markers) == ["base"], "the tried colour")
    text_shows(browser, "Save or undo")
    browser.click_text("undo")
    wait_until(lambda: rig.rig.colors_path.read_bytes() == before, "the former colours")


def only_what_moves_changes(browser: Browser, rig: StubRig) -> None:
    """Two screenshots differ where the hand, its trail and the cameras' pictures are, and nowhere else."""
    width, height = canvas_size(browser)
    browser.click_text("View", "[role=tab]")
    browser.click_text("whole rig")
    browser.click_text("Live", "[role=tab]")
    view = overview(rig.rig)
    corners = np.concatenate([PicturePlane.of(camera).corners for camera in rig.rig.cameras.values()])
    shape = (int(height), int(width))
    pictures = box(on_screen(view, corners, width, height), 12.0, shape)
    pictures[:170, :330] = True  # the browser's own notice that it draws without a graphics card

    def settled() -> bool:
        begun_s = time.monotonic()
        first = picture(browser)
        changed = np.zeros(first.shape[:2], dtype=bool)
        for _ in range(3):
            changed |= np.abs(picture(browser) - first).max(axis=2) > CHANGED
        changed = changed[: shape[0], : shape[1]]
        hand = box(on_screen(view, rig.trodden(begun_s - TRAIL_S), width, height), 55.0, shape)
        inside, outside = int(changed[hand].sum()), int((changed & ~(hand | pictures)).sum())
        return inside > 150 and outside <= 20

    # Light and pictures come one after the other while the page loads.
    wait_until(settled, "only the hand moves")


def box(pixels: FloatArray, margin: float, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """The upright rectangle around some pixels, as a mask."""
    (left, top), (right, bottom) = pixels.min(axis=0) - margin, pixels.max(axis=0) + margin
    mask = np.zeros(shape, dtype=bool)
    mask[max(0, int(top)) : max(0, int(bottom)), max(0, int(left)) : max(0, int(right))] = True
    return mask


async def test_a_taken_port_is_named(free_port: int, simulated_rig: tuple[Path, str]) -> None:
    listener = await asyncio.start_server(lambda reader, writer: None, "127.0.0.1", free_port)
    async with listener:
        process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "rhot", "viewer", "--rig", str(simulated_rig[0]), "--port", str(free_port)),
            stderr=asyncio.subprocess.PIPE,
        )
        _, said = await asyncio.wait_for(process.communicate(), 120.0)
    assert process.returncode == 1
    assert f"port {free_port}" in said.decode()
    assert "--port" in said.decode()
    assert "Traceback" not in said.decode()
