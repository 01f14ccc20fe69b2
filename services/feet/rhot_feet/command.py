"""`rhot feet`."""

from __future__ import annotations

from pathlib import Path

import click
import cv2

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.rig import load_rig
from rhot.service import run_service
from rhot_feet.service import FeetService


@click.command()
@rig_option
@bus_options
def feet(rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Track the feet with a depth camera on the head and sensors on the ankles, until Ctrl-C.

    Reads rhot/head and publishes rhot/foot/left and rhot/foot/right. If a camera or a sensor is unplugged, the service
    tries to reopen it every two seconds and continues with the others.
    """
    # One core is the budget; OpenCV's own threads would take it from the others and jitter more.
    cv2.setNumThreads(1)
    return run_service(FeetService(load_rig(rig_path)), tool_bus(rig_path, connect, namespace))
