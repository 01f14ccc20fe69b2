"""The first tab: is there a hand, who is alive, what went wrong."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import viser

from rhot.messages import FootPose, ServiceStatus
from rhot.rig.folder import CAMERAS_FILE, COLORS_FILE
from rhot_viewer.browser.overview import Problems, feet_html, hands_html, problems_html, services_html
from rhot_viewer.browser.rig_scene import RigScene
from rhot_viewer.rig.inbox import Inbox

STATUS_AGE_S = 5.0
FOOT_AGE_S = 1.0
_HANDS = ("capture", "fusion", "ik")
_NO_HAND = "No marker is seen. Is the hand in the pictures? Do the masks in the tab Pictures show its colours?"
_FEET = ("feet",)
_NO_FOOT = "No foot is seen. Are the feet in the picture (tab Pictures), with their markers upwards?"


class LivePanel:
    """Hand, services, problems."""

    title = "Live"

    def __init__(
        self,
        scene: RigScene,
        inbox: Inbox,
        problems: Problems,
        router: str,
        rates_hz: Mapping[str, float],
        *,
        has_feet: bool,
        rig_path: Path,
    ) -> None:
        """Prepare the tab.

        Args:
            scene: what is shown.
            inbox: what services say.
            problems: what went wrong.
            router: where the bus is, for people.
            rates_hz: frames per second of each camera as configured; empty in a rig that tracks feet alone.
            has_feet: whether the rig tracks feet.
            rig_path: folder of the rig, for what is not calibrated yet.
        """
        self._scene = scene
        self._inbox = inbox
        self._problems = problems
        self._router = router
        self._rates_hz = rates_hz
        self._has_feet = has_feet
        self._rig_path = rig_path

    def build(self, gui: viser.GuiApi) -> None:
        """Add three tables."""
        self._hands = gui.add_html("")
        with gui.add_folder("Services"):
            self._services = gui.add_html("")
        with gui.add_folder("Newest problems"):
            self._trouble = gui.add_html("")

    def update(self) -> None:
        """Write them again; what has not changed is not sent."""
        statuses = self._inbox.all_newest("rhot/status/", ServiceStatus, STATUS_AGE_S)
        feet = self._inbox.all_newest("rhot/foot/", FootPose, FOOT_AGE_S) if self._has_feet else {}
        told = [feet_html(feet, self._waiting_for(statuses, _FEET, _NO_FOOT))] if self._has_feet else []
        if self._rates_hz:
            told.append(hands_html(self._scene.seen.hands, self._waiting_for(statuses, _HANDS, _NO_HAND)))
        self._hands.content = "".join(told)
        self._services.content = services_html(self._inbox.alive, statuses)
        self._trouble.content = problems_html(self._problems.newest)

    def _waiting_for(self, statuses: dict[str, ServiceStatus], needed: tuple[str, ...], else_: str) -> str:
        """Return why nothing is tracked: the first cause on the way from the router to the hand, and the next step."""
        if not self._inbox.alive:
            return f"No service is there. Looking for the rig's router at {self._router}; `rhot up` starts it."
        causes = (self._not_running(needed), self._not_working(statuses), self._not_calibrated(else_))
        return next(filter(None, causes), else_)

    def _not_running(self, needed: tuple[str, ...]) -> str:
        alive = self._inbox.alive
        cameras = [name for name in self._rates_hz if f"capture/{name}" not in alive] if "capture" in needed else []
        if cameras:
            return f"No pictures: start `rhot capture --camera {cameras[0]}` on the machine of camera {cameras[0]}."
        missing = [kind for kind in needed if not any(n.startswith(f"{kind}/") for n in alive)]
        return f"Not running: {', '.join(missing)}; `rhot up` starts them." if missing else ""

    def _not_working(self, statuses: dict[str, ServiceStatus]) -> str:
        failed = [status.last_error for _, status in sorted(statuses.items()) if _has_failed(status)]
        if any(failed):
            return next(filter(None, failed))
        if all(status.state == "waiting" for name, status in statuses.items() if not name.startswith("viewer/")):
            return "Every service waits; `rhot start` starts the rig."
        slow = [
            f"{camera} {rate:.0f} of {wanted:.0f}"
            for camera, wanted in self._rates_hz.items()
            if (status := statuses.get(f"capture/{camera}"))
            and (rate := status.rates.get("frames", wanted)) < wanted / 2
        ]
        return f"Pictures a second are too few: {', '.join(slow)}. Is that machine overloaded?" if slow else ""

    def _not_calibrated(self, else_: str) -> str:
        if not self._rates_hz:
            return ""
        if not (self._rig_path / COLORS_FILE).exists():
            return "The colours of the paints are not known yet: tab *Calibrate*, step *Colours*."
        if not (self._rig_path / CAMERAS_FILE).exists():
            return f"{else_} The cameras are not calibrated yet: tab *Calibrate*, step *Cameras*."
        return ""


def _has_failed(status: ServiceStatus) -> bool:
    """Return whether a service waits although a session runs: its device cannot be used."""
    return status.state == "waiting" and bool(status.session)
