"""Take the documentation's pictures of the page Grasp: `python docs/make_grasp_pictures.py`.

A desktop window and both eyes of an emulated headset look at the simulated world's hand, as a graphics card would draw
it: the browser is told that it has one. The rig's services are stubbed, so that the processor has time to draw. Needs
Chromium (Debian: `apt install chromium`), `make web` and `pip install 'rhot[dev]'`.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from typing import Final

import click

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent / "tests" / "support"))

from make_screenshots import save  # noqa: E402
from page.browser import CHROMIUM, Browser, open_browser, wait_until  # noqa: E402
from page.viewer_process import ViewerProcess  # noqa: E402
from stub_rig import StubThread  # noqa: E402

from rhot_sim.rig.folder import write_simulated_rig  # noqa: E402
from rhot_sim.running.processes import free_endpoint  # noqa: E402

EMULATOR: Final = DOCS.parent / "web" / "node_modules" / "iwer" / "build" / "iwer.min.js"
DESKTOP: Final = (1280, 800)
HEADSET: Final = (1000, 560)
UNMASKED_RENDERER: Final = 0x9246
CARD: Final = (
    "const asked = WebGL2RenderingContext.prototype.getParameter;"
    "WebGL2RenderingContext.prototype.getParameter = function (name) {"
    f" return name === {UNMASKED_RENDERER} ? 'a graphics card' : asked.call(this, name); }};"
)
WORN: Final = (
    "window.device = new IWER.XRDevice(IWER.metaQuest3, {stereoEnabled: true});"
    "device.installRuntime({forceInstall: true}); device.stereoEnabled = true;"
)
HEAD: Final = "device.position.set(0.06, 1.12, 0.14); device.quaternion.set(-0.36, 0.0, 0.0, 0.933);"
CARRYING_S: Final = 8.9
"""When the scripted hand of the simulated world has lifted its object."""
UNSEEN: Final = ("ring", "little")


@click.command()
def main() -> None:
    """Take both pictures; the exit code is 1 where that is not possible or the page reported an error."""
    if CHROMIUM is None or not EMULATOR.exists():
        raise click.ClickException("needs Chromium (Debian: apt install chromium) and the built page (make web)")
    with tempfile.TemporaryDirectory(prefix="rhot-docs-") as place:
        endpoint = free_endpoint("tcp/127.0.0.1:0")
        rig = write_simulated_rig(Path(place) / "rig", endpoint=endpoint)
        port = int(free_endpoint("tcp/127.0.0.1:0").rpartition(":")[2])
        arguments = ["--xr", "--rig", str(rig.path), "--other-page", "http://localhost:1"]
        viewer = ViewerProcess(arguments, port, Path(place) / "grasp.log")
        with StubThread(rig.path, endpoint, predicted=UNSEEN, clock=True) as stub:
            stub.still, stub.still_s = True, CARRYING_S
            viewer.start()
            try:
                errors = [*desktop(viewer.url), *headset(viewer.url)]
            finally:
                viewer.kill()
    if errors:
        raise click.ClickException("the page reported: " + "; ".join(errors))


def desktop(url: str) -> list[str]:
    """Take the picture of a desktop."""
    with open_browser("about:blank", *DESKTOP) as browser:
        drawn_by_a_card(browser, url)
        some_frames(browser)
        # How late this browser is that only says it has a graphics card is no figure of the page.
        browser.evaluate("document.getElementById('state').hidden = true")
        save(browser, "grasp")
        return list(browser.errors)


def headset(url: str) -> list[str]:
    """Look down at the same scene with both eyes."""
    with open_browser("about:blank", *HEADSET) as browser:
        browser.command("Page.addScriptToEvaluateOnNewDocument", source=EMULATOR.read_text() + WORN)
        drawn_by_a_card(browser, url)
        browser.click_text("Enter with the headset")
        browser.wait_for("rhot.headset.on")
        browser.evaluate(HEAD)
        some_frames(browser)
        save(browser, "grasp-headset")
        return list(browser.errors)


def drawn_by_a_card(browser: Browser, url: str) -> None:
    """Open the page in a browser that says it has a graphics card."""
    browser.command("Page.addScriptToEvaluateOnNewDocument", source=CARD)
    browser.navigate(url)
    browser.wait_for("rhot.frames > 5 && rhot.drawn.right")


def some_frames(browser: Browser) -> None:
    """Wait for pictures that show the newest poses."""
    frames = browser.evaluate("rhot.frames")
    wait_until(lambda: browser.evaluate("rhot.frames") > frames + 6, "some frames")
    time.sleep(1.0)
    # On a busy machine the poses may just have been too old, and the hand not drawn.
    browser.wait_for("rhot.drawn.right")


if __name__ == "__main__":
    main()
