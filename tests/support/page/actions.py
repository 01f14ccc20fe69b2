"""What a person does with the page: choose in lists, look through a camera and point at a pixel of its picture."""

from __future__ import annotations

import json

import cv2
import numpy as np
from numpy.typing import NDArray
from page.browser import Browser, wait_until

from rhot.arrays import FloatArray
from rhot_viewer.scene.viewpoint import PicturePlane, Viewpoint, through

_MISSED_S = 10.0
"""A list that has not opened by now was missed."""
_ALIKE = 1.0
"""Grey levels by which two pictures of a scene that stands still may differ on average."""

_LIST = """(() => {
    const label = [...document.querySelectorAll('label')].find(
        e => e.textContent.trim() === %s && e.getClientRects().length);
    if (!label) return null;
    let box = label;
    while (!box.querySelector('input')) box = box.parentElement;
    const hit = box.querySelector('input');
    hit.scrollIntoView({block: "center"});
    const place = hit.getBoundingClientRect();
    return {x: place.x + place.width / 2, y: place.y + place.height / 2, value: hit.value};
})()"""


def text_shows(browser: Browser, text: str, timeout_s: float = 120.0) -> None:
    """Wait until the page shows a text; where it does not, say what it shows and what the browser complained of."""
    try:
        browser.wait_for(f"document.body?.innerText.includes({json.dumps(text)})", timeout_s)
    except AssertionError as error:
        shown = browser.evaluate("document.body?.innerText")
        raise AssertionError(f"{error}; it shows {shown!r}; errors: {browser.errors}") from error


def chosen(browser: Browser, label: str) -> str:
    """Return what the visible list with this label stands at."""
    return str(browser.wait_for(_LIST % json.dumps(label))["value"])


def choose(browser: Browser, label: str, wanted: str) -> None:
    """Choose in the visible list with this label; again where the page has moved under the pointer."""

    def is_chosen() -> bool:
        if chosen(browser, label) == wanted:
            return True
        place = browser.wait_for(_LIST % json.dumps(label))
        browser.click(place["x"], place["y"])
        try:
            browser.click_text(wanted, "[role=option]", _MISSED_S)
            return wait_until(lambda: chosen(browser, label) == wanted, wanted, _MISSED_S) is True
        except AssertionError:
            return False

    wait_until(is_chosen, f"{label}: {wanted}")


def canvas_size(browser: Browser) -> tuple[float, float]:
    """Return width and height of the scene, pixels of the window."""
    width, height = browser.evaluate(
        "(() => {const box = [...document.querySelectorAll('canvas')].map(c => c.getBoundingClientRect())"
        ".sort((a, b) => b.width - a.width)[0]; return [box.width, box.height]})()"
    )
    return width, height


def on_screen(view: Viewpoint, points: FloatArray, width: float, height: float) -> FloatArray:
    """Return where points (N, 3) of the scene stand in a canvas, (N, 2) pixels."""
    forward = view.look_at - view.position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, view.up)
    right /= np.linalg.norm(right)
    seen = (points - view.position) @ np.stack([right, np.cross(forward, right), forward], axis=1)
    scale = 0.5 * height / np.tan(0.5 * view.fov_rad)
    pixels: FloatArray = seen[:, :2] / seen[:, 2:] * scale + 0.5 * np.array([width, height])
    return pixels


def place_of_pixel(browser: Browser, plane: PicturePlane, u: float, v: float) -> tuple[float, float]:
    """Return where in the window a camera's raw pixel stands for who looks through that camera."""
    width, height = canvas_size(browser)
    point = (
        plane.center + plane.right * (u - 0.5 * (plane.width_px - 1)) + plane.down * (v - 0.5 * (plane.height_px - 1))
    )
    ((x, y),) = on_screen(through(plane, width / height), point[None], width, height)
    return float(x), float(y)


def look_through(browser: Browser, camera: str) -> None:
    """Stand where a camera stands, and wait until the view has arrived there and stands still."""
    width, height = canvas_size(browser)

    def seen() -> NDArray[np.int16]:
        picture = cv2.imdecode(np.frombuffer(browser.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        if picture is None:
            raise AssertionError("the screenshot is no picture")
        return np.asarray(picture[: int(height), : int(width)], np.int16)

    def alike(first: NDArray[np.int16], second: NDArray[np.int16]) -> bool:
        return float(np.abs(first - second).mean()) < _ALIKE

    last = before = seen()
    browser.click_text(f"look through {camera}")

    def arrived() -> bool:
        nonlocal last
        previous, last = last, seen()
        return alike(previous, last) and not alike(last, before)

    wait_until(arrived, f"the view through {camera}")


def press_until(browser: Browser, button: str, shows: str, again_s: float = 20.0) -> None:
    """Press a button until the page shows a text: what is asked of a busy machine may not be answered in time."""
    while True:
        browser.click_text(button)
        try:
            text_shows(browser, shows, again_s)
        except AssertionError:
            continue
        return
