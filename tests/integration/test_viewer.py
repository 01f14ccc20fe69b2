"""The web page as a person uses it: in a real browser, beside a rig whose services are stubbed."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from browser import CHROMIUM, Browser, open_browser, wait_until
from numpy.typing import NDArray
from stub_rig import StubRig, StubThread

from rhot.rig import load_rig
from rhot.rig.colors import load_colors
from rhot.sim.run import free_endpoint
from rhot_viewer.scene.cameras import PicturePlane
from rhot_viewer.scene.viewpoint import Viewpoint, overview, through

pytestmark = [
    pytest.mark.integration,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine (Debian: apt install chromium)"),
]

FloatArray = NDArray[np.float64]

SIZE = (820, 460)
KEYS = {"ArrowRight": 39, "End": 35}
CHANGED = 24
"""Grey levels by which a pixel must differ to have changed: far more than a translucent edge that is drawn anew."""


@pytest.fixture
def stub(simulated_rig: tuple[Path, str], tmp_path: Path) -> Iterator[tuple[StubRig, str]]:
    """A stubbed rig, and where its router listens."""
    endpoint = free_endpoint("tcp/127.0.0.1:0")
    with StubThread(simulated_rig[0], endpoint) as rig:
        yield rig, endpoint


class Viewer:
    """The viewer as a process that can be started again on its port."""

    def __init__(self, rig: Path, endpoint: str, port: int, log: Path) -> None:
        self.url = f"http://127.0.0.1:{port}"
        self._log = log
        self._command = ["viewer", "--rig", str(rig), "--connect", endpoint, "--port", str(port)]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        with self._log.open("wb") as output:
            process = subprocess.Popen([sys.executable, "-m", "rhot", *self._command], stdout=output, stderr=output)
        self._process = process
        wait_until(lambda: "connected and waits" in self._log.read_text() or process.poll() is not None, "the viewer")

    def stop(self) -> None:
        """Ctrl-C."""
        assert self._process is not None
        self._process.send_signal(signal.SIGINT)
        assert self._process.wait(timeout=2.0) == 130, self._log.read_text()
        assert "Traceback" not in self._log.read_text()

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


@pytest.fixture
def viewer(stub: tuple[StubRig, str], free_port: int, tmp_path: Path) -> Iterator[Viewer]:
    """A running viewer."""
    rig, endpoint = stub
    made = Viewer(rig.rig.path, endpoint, free_port, tmp_path / "viewer.log")
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


def on_screen(view: Viewpoint, points: FloatArray, width: float, height: float) -> FloatArray:
    """Where points (N, 3) of the scene stand in a canvas, (N, 2) pixels."""
    forward = view.look_at - view.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, view.up)
    right /= np.linalg.norm(right)
    seen = (points - view.position) @ np.stack([right, np.cross(forward, right), forward], axis=1)
    scale = 0.5 * height / np.tan(0.5 * view.fov_rad)
    pixels: FloatArray = seen[:, :2] / seen[:, 2:] * scale + 0.5 * np.array([width, height])
    return pixels


def canvas_size(browser: Browser) -> tuple[float, float]:
    width, height = browser.evaluate(
        "(() => {const box = [...document.querySelectorAll('canvas')].map(c => c.getBoundingClientRect())"
        ".sort((a, b) => b.width - a.width)[0]; return [box.width, box.height]})()"
    )
    return width, height


def press(browser: Browser, slider: str, key: str) -> None:
    """Press a key on the visible slider with this label."""
    assert browser.evaluate(
        f"""(() => {{
            const label = [...document.querySelectorAll('label')].find(
                e => e.textContent.trim() === {slider!r} && e.getClientRects().length);
            let box = label;
            while (!box.querySelector('[role=slider]')) box = box.parentElement;
            const thumb = box.querySelector('[role=slider]');
            thumb.scrollIntoView({{block: 'center'}});
            thumb.focus();
            return document.activeElement === thumb;
        }})()"""
    )
    for kind in ("keyDown", "keyUp"):
        browser.command("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=KEYS[key])


def text_shows(browser: Browser, text: str) -> None:
    browser.wait_for(f"document.body?.innerText.includes({text!r})")


def test_a_person_looks_turns_a_slider_and_asks_for_a_mask(stub: tuple[StubRig, str], viewer: Viewer) -> None:
    rig, _ = stub
    with open_browser(f"{viewer.url}/?fixedDpr=0.5", *SIZE) as browser:
        text_shows(browser, "Right hand")
        text_shows(browser, "little predicted")
        text_shows(browser, "capture/left")
        text_shows(browser, "a stubbed error & <b>its markup</b>")
        only_what_moves_changes(browser, rig)

        browser.click_text("Cameras", "[role=tab]")
        wait_until(lambda: rig.settings["left"].tolerances["thumb"] == 1.0, "the first value")
        browser.wait_for("document.querySelector('[role=slider]:not([data-disabled])') !== null")
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
        camera = load_rig(rig.rig.path).cameras["left"]
        width, height = canvas_size(browser)
        plane = PicturePlane.of(camera)
        seen = rig.newest["left"].markers["base"]
        place = (
            plane.center
            + plane.right * (seen.u - 0.5 * (camera.width - 1))
            + (plane.down * (seen.v - 0.5 * (camera.height - 1)))
        )
        ((x, y),) = on_screen(through(plane, width / height), place[None], width, height)

        def asked_for_mask() -> bool:
            if any("'mask': 'base'" in question for question in rig.asked):
                return True
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
    choose(browser, "Lock the cameras", "Colours")
    browser.click_text("take pictures")
    text_shows(browser, "Not clicked yet")
    choose(browser, "thumb", "base")
    browser.click(*base)
    browser.wait_for("[...document.querySelectorAll('td')].some(e => e.textContent === '1 of 1')")
    before = rig.rig.colors_path.read_bytes()
    browser.click_text("try")
    wait_until(lambda: list(load_colors(rig.rig.colors_path).markers) == ["base"], "the tried colour")
    browser.click_text("undo")
    wait_until(lambda: rig.rig.colors_path.read_bytes() == before, "the former colours")


def choose(browser: Browser, now: str, wanted: str) -> None:
    """Choose in the visible list that stands at some text."""
    x, y = browser.wait_for(
        f"""(() => {{
            const hit = [...document.querySelectorAll('input')].find(
                e => e.value === {now!r} && e.getClientRects().length);
            if (!hit) return null;
            hit.scrollIntoView({{block: "center"}});
            const box = hit.getBoundingClientRect();
            return [box.x + box.width / 2, box.y + box.height / 2];
        }})()"""
    )
    browser.click(x, y)
    browser.click_text(wanted, "[role=option]")


def only_what_moves_changes(browser: Browser, rig: StubRig) -> None:
    """Two screenshots differ where the hand, its trail and the cameras' pictures are, and nowhere else."""
    width, height = canvas_size(browser)
    view = overview(rig.rig)
    corners = np.concatenate([PicturePlane.of(camera).corners for camera in rig.rig.cameras.values()])
    shape = (int(height), int(width))
    pictures = box(on_screen(view, corners, width, height), 12.0, shape)
    pictures[:170, :330] = True  # the browser's own notice that it draws without a graphics card

    def settled() -> bool:
        first = picture(browser)
        changed = np.zeros(first.shape[:2], dtype=bool)
        for _ in range(3):
            changed |= np.abs(picture(browser) - first).max(axis=2) > CHANGED
        changed = changed[: shape[0], : shape[1]]
        hand = box(on_screen(view, rig.trodden(), width, height), 55.0, shape)
        inside, outside = int(changed[hand].sum()), int((changed & ~(hand | pictures)).sum())
        return inside > 150 and outside <= 20

    # Light and pictures come one after the other while the page loads.
    wait_until(settled, "only the hand moves", 30.0)


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
        _, said = await asyncio.wait_for(process.communicate(), 20.0)
    assert process.returncode == 1
    assert f"port {free_port}" in said.decode()
    assert "--port" in said.decode()
    assert "Traceback" not in said.decode()
