"""`rhot capture`."""

from __future__ import annotations

from pathlib import Path

import click

from rhot.cli.options import bus_options, rig_option, tool_bus
from rhot.clock import NodeClock, SystemClock
from rhot.errors import ConfigError, RhotError
from rhot.plugins import load_simulated
from rhot.rig import Rig, load_rig
from rhot_capture.sources import Source, open_source


def node_clock(rig: Rig, camera: str) -> NodeClock:
    """Return the clock of a camera's node: the machine's, or for a simulated camera one with a deliberate offset."""
    if rig.config.cameras[camera].source != "simulated":
        return SystemClock()
    clock: NodeClock = load_simulated("node_clock")(rig.config.sim, camera)
    return clock


@click.command()
@click.option("--camera", required=True, help="Name of the camera in rig.toml.")
@rig_option
@bus_options
def capture(camera: str, rig_path: Path, connect: tuple[str, ...], namespace: str | None) -> int:
    """Detect the markers in one camera's pictures, until Ctrl-C.

    Waits for `rhot start`, then publishes rhot/markers/CAMERA. To see a picture of the camera:

    rhot get --raw 'rhot/preview/CAMERA?overlay=markers' > picture.jpg
    """
    rig = load_rig(rig_path)
    if camera not in rig.config.cameras:
        raise ConfigError(f"no camera {camera} in {rig_path / 'rig.toml'}; it has {', '.join(rig.config.cameras)}")
    clock = node_clock(rig, camera)
    source = _made_ahead(camera, rig, clock)
    # Loaded after the source is made, because a simulated camera's renderer then loads its own modules meanwhile.
    import cv2  # noqa: PLC0415

    from rhot.service import run_service  # noqa: PLC0415
    from rhot_capture.service import CaptureService  # noqa: PLC0415

    # The budget is one core per camera; OpenCV's threads would use the cores of others and increase jitter.
    cv2.setNumThreads(1)
    bus = tool_bus(rig_path, connect, namespace)
    return run_service(CaptureService(camera, rig, clock, source), bus, node_clock=clock)


def _made_ahead(camera: str, rig: Rig, clock: NodeClock) -> Source | None:
    """Return the camera's source before it is needed; None where it cannot be had yet, as its session will report."""
    try:
        return open_source(camera, rig, clock)
    except RhotError:
        return None
