"""The way from an empty folder to calibrated tracking, by clicks alone: `python docs/calibrate_by_clicks.py`.

Does on a simulated rig what `docs/use.md` tells a newcomer, with a headless Chromium in place of the newcomer: locks,
points at paints, shows a chessboard, measures the hand; takes a wrong turn now and then and waits until the page says
what to do. Ends with the hand tracked, and prints how long each step took. With `--images` it also takes the pictures
of the documentation. Needs Chromium (Debian: `apt install chromium`) and `pip install 'rhot[dev]'`.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import click

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent / "tests" / "support"))

from make_screenshots import draw_seldom, page_of, put_notice_away, save  # noqa: E402
from page.actions import choose, chosen, look_through, place_of_pixel, press_until, text_shows  # noqa: E402
from page.browser import CHROMIUM, Browser, open_browser, wait_until  # noqa: E402

from rhot.rig import load_rig  # noqa: E402
from rhot.rig.folder import RIG_FILE  # noqa: E402
from rhot_sim.rendering.coverage import MarkerCoverage  # noqa: E402
from rhot_sim.rig.calibration import true_cameras  # noqa: E402
from rhot_sim.running.processes import free_endpoint  # noqa: E402
from rhot_sim.world.world import World  # noqa: E402
from rhot_viewer.scene.viewpoint import PicturePlane  # noqa: E402

WINDOW = (1280, 800)
STEP_S = 600.0
PRESS_S = 60.0
"""What a press has not brought about by now was pressed beside, where the page has just moved."""
ENOUGH = 30
"""Pictures of the board after which the calibration is ended by hand, where the page still asks for more."""


class Newcomer:
    """Somebody who follows the documentation."""

    def __init__(self, browser: Browser, rig_path: Path, images: bool) -> None:
        self.browser = browser
        self.rig_path = rig_path
        self.images = images
        self.begun_s = time.monotonic()

    def go(self) -> None:
        """Follow the documentation."""
        text_shows(self.browser, "Calibrate", STEP_S)
        put_notice_away(self.browser)
        for step in (self.lock, self.colors, self.cameras, self.hand, self.look):
            step()

    def done(self, what: str, picture: str = "") -> None:
        """Tell what is done, and take its picture."""
        click.echo(f"{time.monotonic() - self.begun_s:6.0f} s  {what}")
        if self.images and picture:
            save(self.browser, picture)

    def cameras_see(self, what: str) -> None:
        """Put something before the simulated cameras and wait for the session that shows it."""
        before = self.session()
        choose(self.browser, "cameras see", what)
        wait_until(lambda: self.session() not in ("", before), f"a session with {what}", STEP_S)

    def session(self) -> str:
        """Return the session that the page speaks of; empty when it speaks of none."""
        found = re.search(r"Session (\S+) runs", self.text())
        return found[1] if found else ""

    def lock(self) -> None:
        """Step 1."""
        self.browser.click_text("Calibrate", "[role=tab]")
        text_shows(self.browser, "Lock the cameras", STEP_S)
        self.cameras_see("a hand held still")
        text_shows(self.browser, "all cameras run and are well exposed", STEP_S)
        self.done("cameras locked")

    def colors(self) -> None:
        """Step 2, with one paint clicked for two markers."""
        choose(self.browser, "step", "Colours")
        press_until(self.browser, "take pictures", "Not clicked yet", PRESS_S)
        rig = load_rig(self.rig_path)
        world = World.from_rig(rig)
        for name, camera in true_cameras(rig).items():
            look_through(self.browser, name)
            plane = PicturePlane.of(rig.cameras[name])
            places = {
                marker: place_of_pixel(self.browser, plane, view.u, view.v)
                for marker, view in MarkerCoverage(camera, world).at(0.0).items()
            }
            for number, marker in enumerate(rig.config.markers):
                # The page goes on to the next marker by itself, sooner or later.
                wait_until(
                    lambda marker=marker: chosen(self.browser, "marker") == marker, f"the turn of {marker}", STEP_S
                )
                if number == 1 and name == next(iter(rig.cameras)):
                    self.one_paint_for_two_markers(marker, places[next(iter(rig.config.markers))])
                self.browser.click(*places[marker])
        text_shows(self.browser, "Every marker is clicked; try the colours", STEP_S)
        self.done("colours learnt", "calibrate-colours")
        press_until(self.browser, "try", "The running cameras use the new colours", PRESS_S)
        press_until(self.browser, "save", "markers have a colour, saved", PRESS_S)
        self.done("colours saved")

    def one_paint_for_two_markers(self, marker: str, place: tuple[float, float]) -> None:
        """Click where another marker was clicked already, read what the page says, take the click back."""
        self.browser.click(*place)
        text_shows(self.browser, "found the same patch of colour", STEP_S)
        self.done("one paint for two markers is refused")
        self.browser.click_text("undo last click")
        self.turn_of(marker)

    def turn_of(self, marker: str) -> None:
        """Wait until a marker is the one to click."""
        wait_until(lambda: chosen(self.browser, "marker") == marker, f"the turn of {marker}", STEP_S)

    def cameras(self) -> None:
        """Step 3; the board is forgotten at first."""
        choose(self.browser, "step", "Cameras")
        press_until(self.browser, "start taking pictures", "No camera finds the board", again_s=STEP_S)
        self.done("no board is noticed")
        self.cameras_see("a chessboard")
        pictured = False
        while not self.shows("The cameras are solved"):
            taken = re.search(r"(\d+) taken:", self.text())
            if taken and int(taken[1]) >= ENOUGH // 2 and not pictured:
                pictured = True
                self.done("half of the board's places", "calibrate-cameras")
            if taken and int(taken[1]) >= ENOUGH:
                press_until(self.browser, "finish and solve", "The cameras are solved", PRESS_S)
            time.sleep(0.5)
        self.done("cameras solved")
        press_until(self.browser, "try", "The rig tracks with the new cameras now", PRESS_S)
        self.cameras_see("a hand that moves and grasps")
        press_until(self.browser, "save", "calibrated 2", PRESS_S)
        self.done("cameras saved")

    def hand(self) -> None:
        """Step 4."""
        choose(self.browser, "step", "Hand")
        press_until(self.browser, "measure by movements", "Measured. Look at the figures", PRESS_S)
        press_until(self.browser, "try", "The rig tracks with the new hand now", PRESS_S)
        press_until(self.browser, "save", "mm long, saved", PRESS_S)
        self.done("hand saved")

    def look(self) -> None:
        """Is there a hand?"""
        self.browser.click_text("Live", "[role=tab]")
        text_shows(self.browser, "measured, all fingers", STEP_S)
        self.done(f"tracked: {re.search('measured, all fingers.*', self.text())[0]}")  # type: ignore[index]

    def text(self) -> str:
        """Return all that the page says."""
        return str(self.browser.evaluate("document.body.innerText"))

    def shows(self, text: str) -> bool:
        """Tell whether the page says something."""
        return text in self.text()


@click.command()
@click.option("--rate", "rate_hz", default=30.0, show_default=True, help="Frames per second of each simulated camera.")
@click.option("--images", is_flag=True, help="Write pictures of the steps to docs/images.")
def main(rate_hz: float, images: bool) -> None:
    """Go the whole way; the exit code is 1 where the page does not lead to the end or reported an error."""
    if CHROMIUM is None:
        raise click.ClickException("no Chromium on this machine; Debian: apt install chromium")
    with tempfile.TemporaryDirectory(prefix="rhot-newcomer-") as folder:
        rig_path = Path(folder) / "myrig"
        rhot = [sys.executable, "-u", "-m", "rhot"]
        subprocess.run([*rhot, "init", str(rig_path), "--sim", "--uncalibrated"], check=True)
        rig_file = rig_path / RIG_FILE
        rig_file.write_text(rig_file.read_text().replace("rate_hz = 30\n", f"rate_hz = {rate_hz:g}\n"))
        command = [*rhot, "sim", "--rig", str(rig_path), "--listen", free_endpoint("tcp/127.0.0.1:0")]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as simulation:
            try:
                url = page_of(simulation)
                with open_browser("about:blank", *WINDOW) as browser:
                    draw_seldom(browser, url)
                    newcomer = Newcomer(browser, rig_path, images)
                    newcomer.go()
                    errors = browser.errors
            finally:
                simulation.send_signal(signal.SIGINT)
    if errors:
        raise click.ClickException("the page reported: " + "; ".join(errors))


if __name__ == "__main__":
    main()
