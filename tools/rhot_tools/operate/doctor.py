"""`rhot doctor`: what is wrong with this machine, this rig folder and the running rig, and what to do."""

from __future__ import annotations

import asyncio
import datetime as dt
import os
import time
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
from rich.console import Console
from rich.markup import escape

from rhot.anatomy.markers import own_paints
from rhot.arrays import FloatArray
from rhot.bus import Bus
from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.errors import BusError, ConfigError, RhotError, WireError
from rhot.geometry.rotations import inverse
from rhot.messages import HandPose, ServiceStatus, decode
from rhot.object_mesh import configured_mesh
from rhot.operation.status import fetch_status
from rhot.quality import epipolar_limit_px, figure, figures_with_units, pair_epipolar_p95_px
from rhot.rig import BusConfig, CamerasFile, Rig, StageFile, load_rig, read_json_model
from rhot.rig.calibration import CalibrationFile
from rhot.rig.colors import load_colors
from rhot.rig.folder import (
    CAMERAS_FILE,
    HAND_FILE,
    REGISTRATION_FILE,
    RIG_FILE,
    STAGE_FILE,
    registration_name,
    registration_path,
)
from rhot.rig.sections import MeshConfig
from rhot.text import as_argument
from rhot_bridge.openxr_layer import chain
from rhot_tools.operate.findings import Finding, check_bus, is_local
from rhot_tools.operate.packages import check_machine, check_packages

# What `rhot doctor` finds out about the floor: is it known, and can it be where `stage.json` says.

_WORK_HEIGHTS_M: Final = (0.3, 2.2)
"""Where hands work: from the knees of who sits to the reach of who stands."""
_OVER_DESK_M: Final = (-0.05, 1.2)
"""Where a hand is over a desk at which somebody works."""
_UP_DIFFERS_DEG: Final = 3.0
_FLOOR_DIFFERS_M: Final = 0.05
"""Between two ways of finding the floor; a ruler and a room setup are good to a centimetre or two each."""


def check_stage(rig: Rig) -> Iterator[Finding]:
    """Look at a rig's `stage.json`: up, floor and cameras must fit each other."""
    again = f"rhot calibrate stage --live --board 9x6 --square-mm 25 --desk-mm 740 --rig {as_argument(rig.path)}"
    stage = rig.stage
    if stage is None:
        yield Finding("note", f"{STAGE_FILE} is missing: programs that want a floor get none", again)
        return
    T_stage_rig = inverse(stage.T_rig_stage.matrix)
    problems = [*_heights(rig, stage, T_stage_rig), *_against_registration(rig, stage)]
    yield from (Finding("warn", f"{STAGE_FILE}: {text}", again) for text in problems)
    if not problems:
        residual = "" if stage.residual_m is None else f", residual {1e3 * stage.residual_m:.1f} mm"
        yield Finding("ok", f"{STAGE_FILE}: of {stage.date or 'unknown date'}, by {stage.source}{residual}")


def _heights(rig: Rig, stage: StageFile, T_stage_rig: FloatArray) -> Iterator[str]:
    # Where a camera can be over the floor: not under a low table, not above a high ceiling.
    low, high = (0.3, 4.0)
    for name, camera in rig.cameras.items():
        height_m = _height(T_stage_rig, np.array(camera.T_rig_camera)[:3, 3])
        if not low <= height_m <= high:
            yield f"camera {name} would be {height_m:.2f} m over the floor; {low:g} to {high:g} m is possible"
        elif stage.desk_height_m is not None and height_m <= stage.desk_height_m:
            yield f"camera {name} would be {height_m:.2f} m over the floor, the desk {stage.desk_height_m:.2f} m"
    if rig.cameras:
        low, high = _WORK_HEIGHTS_M
        middle = np.mean(np.array(rig.config.fusion.volume_m), axis=0)
        height_m = _height(T_stage_rig, middle)
        if not low <= height_m <= high:
            yield (
                f"the middle of [fusion] volume_m would be {height_m:.2f} m over the floor; {low:g} to {high:g} m is "
                "where hands work"
            )


def _against_registration(rig: Rig, stage: StageFile) -> Iterator[str]:
    """Compare with the registered tracking system's space, which has a floor of its own."""
    file = registration_path(rig.path, "steamvr")
    if file is None:
        return
    T_tracker_stage = inverse(rig.registration_of("steamvr").T_rig_tracker.matrix) @ stage.T_rig_stage.matrix
    tilt_deg = float(np.degrees(np.arccos(np.clip(T_tracker_stage[1, 1], -1.0, 1.0))))
    floor_m = float(T_tracker_stage[1, 3])
    if tilt_deg > _UP_DIFFERS_DEG or abs(floor_m) > _FLOOR_DIFFERS_M:
        yield (
            f"{file.name} has the floor {100 * abs(floor_m):.0f} cm {'lower' if floor_m > 0 else 'higher'} and "
            f"{tilt_deg:.1f}° tilted against it; one of the two is old or wrong"
        )


async def check_hands(bus: Bus, rig: Rig) -> list[Finding]:
    """Look at what is tracked now: hands must be at heights where hands are."""
    if rig.stage is None:
        return []
    T_stage_rig = inverse(rig.stage.T_rig_stage.matrix)
    findings = []
    for reply in await bus.get("rhot/hand/*", timeout_s=1.0):
        try:
            hand = decode(reply.payload, HandPose) if not reply.error else None
        except WireError:
            continue  # whoever publishes it is told elsewhere
        wrist = None if hand is None else hand.joints.get("wrist")
        if hand is not None and wrist is not None:
            findings.append(_hand_finding(hand, _height(T_stage_rig, np.array(wrist.position)), rig.stage))
    return findings


def _hand_finding(hand: HandPose, height_m: float, stage: StageFile) -> Finding:
    desk_m = stage.desk_height_m
    low, high = _WORK_HEIGHTS_M if desk_m is None else (desk_m + _OVER_DESK_M[0], desk_m + _OVER_DESK_M[1])
    if low <= height_m <= high:
        return Finding("ok", f"the {hand.side} hand is {height_m:.2f} m over the floor")
    return Finding(
        "warn",
        f"the {hand.side} hand would be {height_m:.2f} m over the floor; {low:.2f} to {high:.2f} m is plausible",
        "is the desk's height right, and has nobody moved the cameras? rhot calibrate stage finds the floor again",
    )


def _height(T_stage_rig: FloatArray, point: FloatArray) -> float:
    return float(T_stage_rig[1, :3] @ point + T_stage_rig[1, 3])


_MARK: Final = {"ok": "[green]ok  [/]", "note": "[blue]note[/]", "warn": "[yellow]warn[/]", "bad": "[red]BAD [/]"}
_DISTANCES: Final = ("50 cm", "75 cm", "100 cm")
"""At which `rhot calibrate cameras` states the error to expect."""
_CLEARLY_OBLONG_M: Final = 0.008
"""From this difference of its sides on, the corners of a patch fit only the two orders that are half a turn apart."""
_MAX_CONFUSION: Final = 0.05
"""Of a paint that may be taken for another one; `rhot calibrate colors` warns from there on."""
_NO_PICTURES_S: Final = 4.0
"""A camera without pictures for as long is at fault; a busy machine may leave a second without any."""
_MAX_CLOCK_UNCERTAINTY_S: Final = 0.002


def check_rig(path: Path) -> tuple[Rig | None, list[Finding]]:
    """Look at a rig folder: is it valid, is it calibrated."""
    if not (path / RIG_FILE).exists():
        return None, [
            Finding("note", f"no rig folder at {path}", f"rhot init {as_argument(path)}, or name one with --rig")
        ]
    try:
        rig = load_rig(path)
    except RhotError as error:
        return None, [Finding("bad", str(error), "correct the file")]
    return rig, [
        Finding("ok", f"{path / RIG_FILE}: {_tracked(rig)}"),
        # Without cameras there is nothing to calibrate, and the rig frame is the tracking system's own space.
        *(_check_hands(rig) if rig.config.cameras else ()),
        *check_stage(rig),
        *_check_sources(rig),
        *check_bus(rig),
        *_check_openxr(rig),
    ]


def _check_openxr(rig: Rig) -> Iterator[Finding]:
    """Look at the way to OpenXR programs, where the rig names a bridge to them."""
    if any(bridge.target == "openxr" for bridge in rig.config.bridges.values()):
        for step in chain():
            yield Finding("ok" if step.holds else "warn", f"OpenXR: {step.found}", "" if step.holds else step.remedy)


def _tracked(rig: Rig) -> str:
    """Return what a rig looks at, and with what."""
    config = rig.config
    parts = []
    if config.cameras:
        cameras = ", ".join(f"{name} ({camera.source})" for name, camera in config.cameras.items())
        parts.append(f"cameras {cameras}; {len(config.markers)} markers")
    if config.feet is not None:
        parts.append(f"feet {', '.join(config.feet.feet)} (depth camera: {config.feet.camera.source})")
    return "; ".join(parts)


def _check_hands(rig: Rig) -> Iterator[Finding]:
    """Look at everything that hands are tracked with."""
    yield from _check_views(rig)
    yield from _check_hand_tracking(rig)
    yield from _check_patches(rig)
    yield from _check_registrations(rig)


def _check_hand_tracking(rig: Rig) -> Iterator[Finding]:
    """Tell whether cameras, colours and hand are calibrated."""
    path = rig.path
    if rig.calibrated:
        yield _check_cameras(rig)
    else:
        yield Finding(
            "warn",
            "cameras.json is missing: lenses and positions are only nominal",
            f"rhot calibrate cameras RECORDING --rig {as_argument(path)} --board 9x6 --square-mm 25  (RECORDING: a "
            "folder with a folder of pictures for each camera), or the page's tab Calibrate",
        )
    yield _check_colors(rig)
    if (path / HAND_FILE).exists():
        yield Finding("ok", _summary(HAND_FILE, rig.hand))
    else:
        yield Finding(
            "note",
            f"hand.json is missing: an average hand of {1e3 * rig.hand.length_m:.0f} mm is assumed",
            f"rhot calibrate hand RECORDING --rig {as_argument(path)}",
        )


def _check_patches(rig: Rig) -> Iterator[Finding]:
    """Tell which patches are so nearly square that they do not show which way the hand points."""
    for name, marker in rig.config.markers.items():
        if marker.size_m is not None and abs(marker.size_m[0] - marker.size_m[1]) < _CLEARLY_OBLONG_M:
            across, along = (f"{1e3 * side:g}" for side in marker.size_m)
            yield Finding(
                "warn",
                f"marker {name}: a patch of {across} x {along} mm is nearly square; while few fingertips are seen, the "
                "hand may point sideways",
                f"paint it {1e3 * _CLEARLY_OBLONG_M:g} mm or more longer than wide, and measure size_m again",
            )


def _check_views(rig: Rig) -> Iterator[Finding]:
    """Tell whether there are two cameras, and not the same one twice."""
    cameras = rig.config.cameras
    if len(cameras) == 1:
        yield Finding(
            "bad",
            f"the rig has one camera, {next(iter(cameras))}: depth needs two that see the hand from different places",
            "add [cameras.NAME] to rig.toml",
        )
    seen: dict[tuple[str, str], str] = {}
    for name, camera in cameras.items():
        if camera.source != "v4l2":
            # Cameras of a Pi are numbered on each Pi; a recording may serve two.
            continue
        other = seen.setdefault((camera.source, os.path.realpath(camera.video_path)), name)
        if other != name:
            yield Finding(
                "warn",
                f"cameras {other} and {name} have the same device, {camera.device}: right only on two machines",
                'name each camera\'s own, such as  device = "/dev/v4l/by-id/usb-…-video-index0"',
            )


def _check_colors(rig: Rig) -> Finding:
    """Tell whether every paint has a colour."""
    remedy = (
        f"the page's tab Calibrate (`rhot up --rig {as_argument(rig.path)}`), or  rhot calibrate colors left.png "
        f"--pick thumb=281,215 … --rig {as_argument(rig.path)}  with a picture of the camera, and the pixel of each "
        "paint in it (from the left, from the top; any image viewer shows them)"
    )
    if not rig.colors_path.exists():
        return Finding("bad", "colors.json is missing: no marker can be found in a picture", remedy)
    try:
        colors = load_colors(rig.colors_path)
    except RhotError as error:
        return Finding("bad", str(error), remedy)
    without = [name for name in own_paints(rig.config.markers) if name not in colors.markers]
    if without:
        return Finding("warn", f"colors.json has no colour for {', '.join(without)}: not found in any picture", remedy)
    confused = [(share, name, other) for name, other, share in _confused(colors.quality) if share > _MAX_CONFUSION]
    if confused:
        share, name, other = max(confused)
        return Finding(
            "warn",
            f"colors.json: {100 * share:.0f} % of {name} would be taken for {other}; {100 * _MAX_CONFUSION:.0f} % are "
            "the most",
            f"paint one of the two in another colour (`rhot evaluate paints`), then {remedy}",
        )
    return Finding("ok", _summary(rig.colors_path.name, colors))


def _confused(quality: Any) -> Iterator[tuple[str, str, float]]:
    """Yield marker, most similar other one and the share that is confused, as the colours' calibration found them."""
    for name, each in quality.items() if isinstance(quality, dict) else ():
        share = figure(quality, name, "confusion")
        if share is not None and isinstance(each, dict):
            yield str(name), str(each.get("nearest", "another")), share


def _check_registrations(rig: Rig) -> Iterator[Finding]:
    """Tell for each source of objects where its space lies."""
    objects = {config.source: name for name, config in reversed(rig.config.objects.items())}
    if not objects and (rig.path / REGISTRATION_FILE).exists():
        yield Finding("ok", _summary(REGISTRATION_FILE, rig.registration))
    told = set()
    for source, name in sorted(objects.items()):
        file = registration_path(rig.path, source)
        if file is None:
            yield Finding(
                "warn",
                f"{registration_name(source)} is missing: objects are not in the cameras' frame",
                f"rhot calibrate objects --live --object {name} --marker NAME --rig {as_argument(rig.path)}",
            )
        elif file not in told:
            told.add(file)
            yield Finding("ok", _summary(file.name, rig.registration_of(source)))


def _check_sources(rig: Rig) -> Iterator[Finding]:
    """Look for the files and devices that cameras and objects need on this machine."""
    for name, camera in rig.config.cameras.items():
        if camera.source == "v4l2":
            device = camera.video_path
            if not Path(device).exists():
                there = sorted(map(str, Path("/dev/v4l/by-id").glob("*-video-index0")))
                yield Finding(
                    "note",
                    f"camera {name}: {device} is not on this machine",
                    f"here are {', '.join(there)}" if there else "plug it in, or start its capture where it is",
                )
        if camera.path and not rig.resolve(camera.path).exists():
            yield Finding("bad", f"camera {name}: {rig.resolve(camera.path)} does not exist", "correct path")
    for name, thing in rig.config.objects.items():
        if isinstance(thing.shape, MeshConfig):
            try:
                x, y, z = configured_mesh(rig, thing.shape).shape.size
            except ConfigError as error:
                yield Finding("bad", f"object {name}: {error}", "correct the file or its shape in rig.toml")
            else:
                told = " x ".join(f"{1e3 * edge:.0f}" for edge in (x, y, z))
                yield Finding("ok", f"object {name}: {thing.shape.file}, {told} mm; measure it: is that its size?")


def _check_cameras(rig: Rig) -> Finding:
    """Say when and how well the cameras were calibrated."""
    file = read_json_model(rig.path / CAMERAS_FILE, CamerasFile)
    text = _summary(CAMERAS_FILE, file)
    for name in rig.cameras:
        rms_px = figure(file.quality, "cameras", name, "rms_px")
        if rms_px is not None:
            text += f"; {name} RMS {rms_px:.2f} px"
    for first, second in combinations(rig.cameras, 2):
        p95_px = pair_epipolar_p95_px(file.quality, first, second)
        if p95_px is not None:
            text += f"; {first}-{second} epipolar p95 {p95_px:.2f} px"
    for distance in _DISTANCES:
        error_mm = figure(file.quality, "expected_error_mm", distance, "with_marker_noise")
        if error_mm is not None:
            text += f"; {error_mm:.1f} mm expected at {distance}"
    remedy = f"rhot evaluate calibration --live 30 --rig {as_argument(rig.path)} shows whether they have moved since"
    return Finding("ok", text, remedy)


def _summary(name: str, file: CalibrationFile) -> str:
    """Return the date, age and figures of a calibration file."""
    text = f"{name}: "
    try:
        days = (dt.datetime.now(dt.UTC).date() - dt.date.fromisoformat(file.date)).days
        text += f"of {file.date}, {days} days old" if days > 0 else f"of {file.date}"
    except ValueError:
        text += "of unknown date"
    for figure_name, value in figures_with_units(file.quality).items():
        label, _, unit = figure_name.rpartition("_")
        text += f", {label.replace('_', ' ')} {value:.3g} {unit}"
    return text


async def _settled_status(bus: Bus) -> tuple[set[str], dict[str, ServiceStatus]]:
    """Return who is alive and the last status of each; cameras without pictures get a few seconds to send one."""
    alive, statuses = await fetch_status(bus)
    until = time.monotonic() + _NO_PICTURES_S
    while (idle := [name for name, status in statuses.items() if _is_idle(status)]) and time.monotonic() < until:
        await asyncio.sleep(0.5)
        _, latest = await fetch_status(bus)
        statuses |= {name: latest[name] for name in idle if name in latest}
    return alive, statuses


def _is_idle(status: ServiceStatus) -> bool:
    return status.state == "running" and status.rates.get("frames") == 0.0


async def check_running(config: BusConfig, rig: Rig | None) -> list[Finding]:
    """Look at the running rig: router, services, clocks, errors."""
    where = ", ".join(config.connect)
    try:
        async with await Bus.open(config, timeout_s=1.0) as bus:
            alive, statuses = await _settled_status(bus)
            hands = [] if rig is None else await check_hands(bus, rig)
    except BusError:
        remedy = f"rhot up --rig {as_argument(rig.path)}, or rhot sim for a demo" if rig else "rhot sim for a demo"
        if not all(map(is_local, config.connect)):
            remedy = "start it on that machine (`rhot up`); if it runs, is the address right, and its firewall open?"
        elif rig is not None and rig.config.cameras:
            remedy += (
                "; if this machine only has a camera, bring its certificate from the PC (`rhot keys make` there, `rhot "
                "keys install` here)"
            )
        return [Finding("note", f"no rig is running at {where}", remedy)]
    findings = [Finding("ok", f"the router at {where} answers; {len(alive)} services are alive")]
    if rig is not None:
        wanted = [f"capture/{camera}" for camera in rig.config.cameras]
        wanted += [*(["fusion/main"] if wanted else []), "ik/main", *(["feet/main"] if rig.config.feet else [])]
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
            if rig is not None and rig.calibrated:
                findings += _check_drift(name, status, rig)
    return [*findings, *hands]


def _check_drift(name: str, status: ServiceStatus, rig: Rig) -> Iterator[Finding]:
    """Tell from what fusion has learnt whether the cameras have moved since they were calibrated."""
    correction_px = status.figures.get("epipolar_correction_px")
    if correction_px is None or not status.figures.get("epipolar_px"):
        return  # no marker was seen by two cameras yet
    quality = read_json_model(rig.path / CAMERAS_FILE, CamerasFile).quality
    pairs = combinations(rig.cameras, 2)
    limit_px = max(epipolar_limit_px(pair_epipolar_p95_px(quality, *pair)) for pair in pairs)
    if correction_px > limit_px:
        yield Finding(
            "warn",
            f"{name}: the cameras have moved since calibration ({correction_px:.1f} px, {limit_px:.1f} px is the "
            "limit); points are corrected for it, but depth may be wrong: calibrate again",
            f"rhot calibrate cameras RECORDING --rig {as_argument(rig.path)} --board 9x6 --square-mm 25; "
            f"rhot evaluate calibration --live 30 --rig {as_argument(rig.path)} says more",
        )
    else:
        yield Finding("ok", f"{name}: the cameras stand as calibrated, to {correction_px:.1f} px")


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
    late = status.counts.get("dropped_late", 0)
    if late and status.uptime_s > 0 and late / status.uptime_s > 0.5:
        yield Finding("warn", f"{name}: {late} frames dropped for lateness", "lower rate_hz, or use a faster Pi")
    if _is_idle(status):
        yield Finding("bad", f"{name} runs but gets no pictures", "look at the camera's cable and at its log")


@click.command()
@rig_option
@bus_options
def doctor(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Check this machine, the rig folder and the running rig; every finding includes a remedy.

    The exit code is 1 when something is BAD.
    """
    console = Console(highlight=False)
    rig, rig_findings = check_rig(rig_path)
    findings = [*check_machine(), *check_packages(rig), *rig_findings]
    if not any(finding.level == "bad" and RIG_FILE in finding.text for finding in rig_findings):
        findings += asyncio.run(check_running(tool_bus(rig_path, connect, namespace), rig))
    for finding in findings:
        remedy = f"  [dim]→ {escape(finding.remedy)}[/]" if finding.remedy else ""
        console.print(f"{_MARK[finding.level]} {escape(finding.text)}{remedy}", soft_wrap=True)
    return 1 if any(finding.level == "bad" for finding in findings) else 0
