"""Take the documentation's pictures of the web page: `python docs/make_screenshots.py [--rate HZ]`.

Runs `rhot sim` with its page, opens it in a headless Chromium as a person would, and writes JPEGs to `docs/images/`;
`calibrate_by_clicks.py --images` takes those of the calibration. Needs Chromium (Debian: `apt install chromium`) and
`pip install 'rhot[dev]'`. A browser without a graphics card draws on the processor, beside the simulator; with fewer
frames a second of each camera both fit on two cores.
"""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import click

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent / "tests" / "support"))

from page.browser import CHROMIUM, Browser, open_browser, wait_until  # noqa: E402

IMAGES = DOCS / "images"
DESKTOP = (1280, 800)
TABLET = (1024, 768)
SIM_S = 900
UP_S = 60.0
SETTLE_S = 3.0
"""A picture has no event that says that all of it is drawn: light, textures and pictures come one after the other."""
LOAD_S = 12.0
"""The scene brightens slowly after it has been loaded."""
CHARTS_S = 45.0
JPEG_QUALITY = 80
"""Text stays clean; 60 to 150 kB a picture, where a PNG of a camera's noise takes 480."""
SELDOM = "window.requestAnimationFrame = draw => setTimeout(() => draw(performance.now()), 200);"
"""Drawing without a graphics card takes all that it gets, and what is drawn comes late."""
ALL_WELL = "document.body.innerText.includes('all fingers') && !document.body.innerText.includes('no status')"
NOTICE = "[class*=Notification-closeButton]"


@click.command()
@click.option("--rate", "rate_hz", default=10.0, show_default=True, help="Frames per second of each simulated camera.")
@click.option("--hands", default="right", show_default=True, help="As of `rhot sim`.")
def main(rate_hz: float, hands: str) -> None:
    """Take all pictures; the exit code is 1 where that is not possible or the page reported an error."""
    if CHROMIUM is None:
        raise click.ClickException("no Chromium on this machine; Debian: apt install chromium")
    IMAGES.mkdir(exist_ok=True)
    command = [sys.executable, "-u", "-m", "rhot", "sim", "--hands", hands, "--rate", str(rate_hz)]
    with subprocess.Popen([*command, "--duration", str(SIM_S)], stdout=subprocess.PIPE, text=True) as simulation:
        try:
            url = page_of(simulation)
            with open_browser("about:blank", *DESKTOP) as browser:
                draw_seldom(browser, url)
                take_desktop(browser)
                errors = list(browser.errors)
            with open_browser("about:blank", *TABLET) as browser:
                draw_seldom(browser, url)
                ready(browser)
                browser.wait_for(ALL_WELL, UP_S)
                save(browser, "tablet")
                errors += browser.errors
        finally:
            simulation.send_signal(signal.SIGINT)
    if errors:
        raise click.ClickException("the page reported: " + "; ".join(errors))


def page_of(simulation: subprocess.Popen[str]) -> str:
    """Return the address of the page for working on the rig as soon as somebody answers there."""
    if simulation.stdout is None:
        raise RuntimeError("the simulation's output is not read")
    for line in simulation.stdout:
        found = re.search(r"The page .*is at http://localhost:(\d+)", line)
        if found:
            wait_until(partial(_answers, int(found.group(1))), "the page", UP_S)
            return f"http://127.0.0.1:{found.group(1)}"
    raise RuntimeError("the simulation ended without a page")


def draw_seldom(browser: Browser, url: str) -> None:
    """Open the page so that it draws five times a second."""
    browser.command("Page.addScriptToEvaluateOnNewDocument", source=SELDOM)
    browser.navigate(f"{url}/?fixedDpr=1")


def _answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def ready(browser: Browser) -> None:
    """Wait for a page with a hand, and put away the browser's notice."""
    browser.wait_for("document.body?.innerText.includes('measured')", UP_S)
    put_notice_away(browser)
    time.sleep(LOAD_S)


def put_notice_away(browser: Browser) -> None:
    """Close what the browser says of having no graphics card."""
    browser.wait_for(f"document.querySelector({NOTICE!r}) !== null", UP_S)
    browser.evaluate(f"document.querySelectorAll({NOTICE!r}).forEach(button => button.click())")


def take_desktop(browser: Browser) -> None:
    """Take every tab."""
    ready(browser)
    browser.click_text("View", "[role=tab]")
    browser.click_text("hand")
    save(browser, "hand")
    browser.click_text("Pictures", "[role=tab]")
    save(browser, "pictures")
    browser.click_text("look through left")
    save(browser, "look-through")
    browser.click_text("Cameras", "[role=tab]")
    browser.click_text("View", "[role=tab]")
    browser.click_text("whole rig")
    browser.click_text("Cameras", "[role=tab]")
    save(browser, "cameras")
    browser.click_text("Timeline", "[role=tab]")
    time.sleep(CHARTS_S)
    save(browser, "timeline")
    browser.click_text("View", "[role=tab]")
    browser.click_text("hand")
    # Last, and not first: by now the scene is as bright as it gets.
    browser.click_text("Live", "[role=tab]")
    time.sleep(SETTLE_S)
    browser.wait_for(ALL_WELL, UP_S)
    save(browser, "live")


def save(browser: Browser, name: str) -> None:
    """Write what the window shows now."""
    time.sleep(SETTLE_S)
    file = IMAGES / f"{name}.jpg"
    file.write_bytes(browser.screenshot(JPEG_QUALITY))
    click.echo(file.relative_to(DOCS.parent))


if __name__ == "__main__":
    main()
