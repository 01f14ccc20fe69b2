"""`rhot doctor`: what is wrong with this machine, this rig folder and the running rig, and what to do."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import click
from rich.console import Console
from rich.markup import escape

from rhot.bus import Bus
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.cli.status import fetch_status
from rhot.errors import BusError, RhotError
from rhot.messages import ServiceStatus
from rhot.rig import BusConfig, Rig, load_rig
from rhot.rig.folder import RIG_FILE

_MARK: Final = {"ok": "[green]ok  [/]", "note": "[blue]note[/]", "warn": "[yellow]warn[/]", "bad": "[red]BAD [/]"}
_ROLES: Final = {
    "capture": ("rhot_capture", "cv2"),
    "fusion": ("rhot_fusion", "cv2"),
    "ik": ("rhot_ik",),
    "objects": ("rhot_objects",),
}
_MAX_CLOCK_UNCERTAINTY_S: Final = 0.002


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of the report: how bad, what, and what to do about it."""

    level: Literal["ok", "note", "warn", "bad"]
    text: str
    remedy: str = ""


def check_machine() -> Iterator[Finding]:
    """Look at this machine: Python, roles that are installed, cores, disk."""
    version = ".".join(map(str, sys.version_info[:3]))
    yield Finding("ok", f"Python {version} on {platform.system()} {platform.machine()}, {os.cpu_count()} cores")
    for role, modules in _ROLES.items():
        missing = [module for module in modules if importlib.util.find_spec(module) is None]
        if missing:
            yield Finding("note", f"role {role}: {', '.join(missing)} not installed", f"pip install 'rhot[{role}]'")
        else:
            yield Finding("ok", f"role {role} can run here")
    free_gb = shutil.disk_usage(Path.cwd()).free / 1e9
    if free_gb < 1:
        yield Finding("warn", f"{free_gb:.1f} GB of disk free", "recordings need more")


def check_rig(path: Path) -> tuple[Rig | None, list[Finding]]:
    """Look at a rig folder: is it valid, is it calibrated."""
    if not (path / RIG_FILE).exists():
        return None, [Finding("note", f"no rig folder at {path}", f"rhot init {path}, or name one with --rig")]
    try:
        rig = load_rig(path)
    except RhotError as error:
        return None, [Finding("bad", str(error), "correct the file")]
    cameras = ", ".join(f"{name} ({camera.source})" for name, camera in rig.config.cameras.items())
    findings = [Finding("ok", f"{path / RIG_FILE}: cameras {cameras}; {len(rig.config.markers)} markers")]
    if rig.calibrated:
        findings.append(Finding("ok", "cameras.json: every camera is calibrated"))
    else:
        findings.append(
            Finding("warn", "cameras.json is missing: lenses and places are only nominal", "calibrate the cameras")
        )
    if rig.colors_path.exists():
        findings.append(Finding("ok", "colors.json is there"))
    else:
        findings.append(
            Finding(
                "bad",
                "colors.json is missing: no marker can be found in a picture",
                f"rhot calibrate colors PICTURE --pick thumb=U,V … --rig {path}",
            )
        )
    if not (path / "hand.json").exists():
        findings.append(
            Finding("note", f"hand.json is missing: an average hand of {1e3 * rig.hand.length_m:.0f} mm is assumed")
        )
    if rig.config.objects and not (path / "registration.json").exists():
        findings.append(
            Finding("warn", "registration.json is missing: objects are not in the cameras' frame", "register them")
        )
    for name, camera in rig.config.cameras.items():
        if camera.source == "v4l2":
            device = f"/dev/video{camera.device}" if isinstance(camera.device, int) else camera.device
            if not Path(device).exists():
                findings.append(Finding("note", f"camera {name}: {device} is not on this machine"))
        if camera.path and not rig.resolve(camera.path).exists():
            findings.append(Finding("bad", f"camera {name}: {rig.resolve(camera.path)} does not exist", "correct path"))
    return rig, findings


async def check_running(config: BusConfig, rig: Rig | None) -> list[Finding]:
    """Look at the running rig: router, services, clocks, errors."""
    where = ", ".join(config.connect)
    try:
        async with await Bus.open(config, timeout_s=1.0) as bus:
            alive, statuses = await fetch_status(bus)
    except BusError:
        return [Finding("note", f"no rig is running at {where}", "rhot up, or rhot sim for a demo")]
    findings = [Finding("ok", f"the router at {where} answers; {len(alive)} services are alive")]
    if rig is not None:
        wanted = [f"capture/{camera}" for camera in rig.config.cameras] + ["fusion/main", "ik/main"]
        findings += [
            Finding("bad", f"{name} is not running", "start it, or look at its log on its machine")
            for name in wanted
            if name not in alive
        ]
    for name in sorted(alive):
        status = statuses.get(name)
        if status is None:
            findings.append(Finding("warn", f"{name} is alive but does not answer", "it may have just started"))
        else:
            findings += _check_service(name, status)
    return findings


def _check_service(name: str, status: ServiceStatus) -> Iterator[Finding]:
    if status.problem:
        yield Finding("bad", f"{name}: {status.problem}")
    if status.last_error:
        yield Finding("warn", f"{name}: {status.last_error}")
    if status.clock_uncertainty_s is None:
        yield Finding("bad", f"{name} does not know rig time", "is fusion running, and does the network let it answer?")
    elif status.clock_uncertainty_s > _MAX_CLOCK_UNCERTAINTY_S:
        yield Finding(
            "warn",
            f"{name}: clock known to ± {1e3 * status.clock_uncertainty_s:.1f} ms only",
            "use a cable instead of WiFi; a hand at 1 m/s moves 1 mm a millisecond",
        )
    late, dropped = status.counts.get("dropped_late", 0), status.rates.get("frames")
    if late and status.uptime_s > 0 and late / status.uptime_s > 0.5:
        yield Finding("warn", f"{name}: {late} frames dropped for lateness", "lower rate_hz, or use a faster Pi")
    if dropped == 0.0 and status.state == "running":
        yield Finding("bad", f"{name} runs but gets no pictures", "look at the camera's cable and at its log")


@click.command()
@rig_option
@bus_options
def doctor(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Check this machine, the rig folder and the running rig; every finding says what to do.

    The exit code is 1 when something is BAD.
    """
    console = Console(highlight=False)
    rig, rig_findings = check_rig(rig_path)
    findings = [*check_machine(), *rig_findings]
    if not any(finding.level == "bad" and RIG_FILE in finding.text for finding in rig_findings):
        findings += asyncio.run(check_running(tool_bus(rig_path, connect, namespace), rig))
    for finding in findings:
        remedy = f"  [dim]→ {escape(finding.remedy)}[/]" if finding.remedy else ""
        console.print(f"{_MARK[finding.level]} {escape(finding.text)}{remedy}", soft_wrap=True)
    return 1 if any(finding.level == "bad" for finding in findings) else 0
