"""What `rhot calibrate objects --touch` does."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Final

import numpy as np
from rich.console import Console
from rich.table import Table

from rhot.errors import ConfigError, WireError
from rhot.geometry.rotations import quaternion_from_rotation, rotation_between
from rhot.messages import Control, HandPose, ObjectPose
from rhot.recording.mcap.reader import open_mcap
from rhot.report.html import figures_table
from rhot.rig import BusConfig, Rig
from rhot.rig.folder import registration_name, registration_path
from rhot.service.control import CONTROL_KEY
from rhot_calibration.objects.touch.checks import Judged, flesh_note, judged
from rhot_calibration.objects.touch.collector import TouchCollector
from rhot_calibration.objects.touch.faces import free_rotations
from rhot_calibration.objects.touch.fit import Touch
from rhot_calibration.objects.touch.live import collect_touches
from rhot_calibration.objects.touch.record import R_before, touched_registration
from rhot_calibration.objects.touch.streams import TouchTask, feed
from rhot_calibration.writing import write_found

# Touches from a recording of `rhot record`.


def touches_recorded(file: Path, task: TouchTask, collector: TouchCollector) -> None:
    """Fill a collector from an MCAP recording.

    A session that is started within the recording starts the touches over.

    Args:
        file: the recording.
        task: what was touched; its registration must be the one that held then.
        collector: filled until it is done or the recording ends.

    Raises:
        ConfigError: not a recording, or neither hand nor object is in it.
    """
    recording = open_mcap(file)
    for key in (task.hand_key, task.object_key):
        if key not in recording.keys:
            raise ConfigError(f"{file}: no {key} in it; record hand and object together while the object is touched")
    from_ns = 0
    for sample in recording.samples():
        if collector.done:
            return
        if sample.key not in (task.hand_key, task.object_key, CONTROL_KEY):
            continue
        try:
            message = sample.message()
        except WireError:
            continue
        if isinstance(message, Control) and message.action == "start":
            collector.start_over()
            from_ns = message.start_t_ns
        elif isinstance(message, HandPose | ObjectPose) and message.t_ns >= from_ns:
            feed(task, collector, sample.key, message)


_PATIENCE_S: Final = 15.0


def calibrate_by_touch(rig: Rig, task: TouchTask, source: BusConfig | Path, *, dry_run: bool) -> None:
    """Collect touches, work out the offset, show it and write it into the registration of its source.

    Args:
        rig: whose registration is changed.
        task: who touches what.
        source: a running rig, or a recording.
        dry_run: write nothing.

    Raises:
        RhotError: see `collect_touches`, `touches_recorded` and `judged`.
    """
    console = Console(soft_wrap=True, markup=False, highlight=False)
    collector = task.new_collector()
    if isinstance(source, Path):
        touches_recorded(source, task, collector)
    else:
        _collect_live(rig, task, source, collector)
    found = judged(task.shape, collector.touches, R_before(task))
    console.print(_touch_table(collector.touches, found))
    for line in report_lines(task, found):
        console.print(line)
    for note in notes(task, collector.touches, found):
        console.print(f"note: {note}", style="yellow")
    file = rig.path / registration_name(task.source)
    held, before = registration_path(rig.path, task.source), rig.registration_of(task.source)
    written = touched_registration(before, task, found, len(collector.touches))
    then = "`rhot objects` takes it at the next start (`rhot start`)."
    write_found(console, file, written, then, before=held, dry_run=dry_run)


def report_lines(task: TouchTask, found: Judged) -> tuple[str, ...]:
    """Return what was found, in lines for people."""
    fit = found.fit
    x, y, z = 1e3 * fit.p_device_object
    quaternion = ", ".join(f"{value:.4f}" for value in quaternion_from_rotation(fit.R_device_object))
    free = free_rotations(task.shape)
    rotation = f"rotation  ± {np.degrees(fit.rotation_sd_rad):.2f}° about its least certain axis"
    return (
        f"residual  {1e3 * fit.rms_m:.2f} mm RMS over {len(found.kept)} touches",
        f"position  {x:.1f}, {y:.1f}, {z:.1f} mm from the tracker, in its axes, ± {1e3 * fit.position_sd_m:.2f} mm",
        f"rotation  as it was: a {task.shape.kind} looks alike from everywhere" if len(free) == 3 else rotation,
        f"          quaternion x, y, z, w: {quaternion}",
    )


def notes(task: TouchTask, touches: list[Touch], found: Judged) -> list[str]:
    """Return what a person should know about a result."""
    notes = [
        f"touch {index + 1} ({touch.face}) contradicts the others and was left out"
        for index, touch in enumerate(touches)
        if index not in found.kept
    ]
    if len(free_rotations(task.shape)) == 1:
        notes.append("how the cylinder is turned about its own axis cannot be felt: that stayed as it was")
    notes += filter(None, [flesh_note(found.fit)])
    fixed = task.registration.T_device_object.get(task.object_id)
    if fixed is not None:
        moved_mm = 1e3 * float(np.linalg.norm(found.fit.p_device_object - fixed.position))
        turned = np.degrees(np.linalg.norm(rotation_between(R_before(task), found.fit.R_device_object)))
        notes.append(f"the offset before was {moved_mm:.1f} mm and {turned:.1f}° from this one")
    return notes


def _collect_live(rig: Rig, task: TouchTask, bus: BusConfig, collector: TouchCollector) -> None:
    console = Console(stderr=True, soft_wrap=True, markup=False, highlight=False)
    console.print(
        f"Touch {task.object_id} with the tip of the {task.side} {task.finger} finger, {len(task.plan)} times: "
        f"{', '.join(dict.fromkeys(task.plan))}. Press gently near a corner and hold still for a second; turn the "
        "object between faces so that the cameras see the fingertip. Enter takes a touch at once, b takes the last one "
        "back, Ctrl-C ends with those there are."
    )

    def taken(touch: Touch) -> None:
        console.bell()
        number, count = len(collector.touches), len(task.plan)
        console.print(f"touch {number} of {count} taken: {touch.face}; {collector.asked}", style="green")

    def hint(text: str) -> None:
        console.print(f"  … {text}")

    try:
        asyncio.run(
            collect_touches(bus, rig, task, collector, patience_s=_PATIENCE_S, taken=taken, hint=hint, keys=True)
        )
    except KeyboardInterrupt:
        if not collector.touches:
            raise
        console.print(f"ended with {len(collector.touches)} touches")


def _touch_table(touches: list[Touch], found: Judged) -> Table:
    table = figures_table("touch", "face", "off mm", names=2)
    table.add_column("")
    for row in touch_rows(touches, found):
        table.add_row(*row)
    return table


def touch_rows(touches: list[Touch], found: Judged) -> list[tuple[str, str, str, str]]:
    """Return number, face, distance from it in mm and a remark of each touch."""
    off = dict(zip(found.kept, found.fit.residual_m, strict=True))
    return [
        (
            f"{index + 1}",
            touch.face,
            f"{1e3 * off[index]:.1f}" if index in off else "",
            "" if index in off else "left out: contradicts the others",
        )
        for index, touch in enumerate(touches)
    ]
