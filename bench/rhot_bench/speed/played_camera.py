"""A camera that is played: the simulated world's markers, projected when they are due, so that hours cost little.

It is a service like capture, with a clock of its own that may be off and drift, but it draws and searches no pictures.
Run one with `python -m rhot_bench.speed.played_camera --camera NAME --rig RIG`.
"""

from __future__ import annotations

import asyncio
import logging
import sys
import time
from pathlib import Path
from typing import Final

import click
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rhot.bus import Publisher
from rhot.cli.group import MainGroup
from rhot.cli.options import Finite, bus_options, rig_option, tool_bus
from rhot.clock import SkewedClock
from rhot.errors import ConfigError
from rhot.messages import Control, Marker, MarkerFrame
from rhot.rig import Rig, load_rig, write_json_model
from rhot.rig.template import rig_template
from rhot.service import Node
from rhot.service.runner import run_service
from rhot_sim.rig.calibration import simulated_rig_calibration, true_cameras
from rhot_sim.world.world import World

NOISE_PX: Final = 0.1
"""Of a marker's centre, each axis; what the simulated cameras' detection is worth (`rhot evaluate tracking`)."""
_PHASE_S: Final = 0.007
"""Each further camera is so much behind; no two cameras are in step."""


class PlayedSettings(BaseModel):
    """What a played camera plays.

    Attributes:
        rate_hz: frames a second.
        clock_offset_s: of its clock against this machine's.
        drift_ppm: of its clock.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    rate_hz: float = Field(default=60.0, gt=0.0, le=240.0)
    clock_offset_s: float = 0.0
    drift_ppm: float = 0.0


class PlayedCamera:
    """Publishes `rhot/markers/<camera>` as capture does; see `rhot.service.Service` for the seam."""

    name = "capture"
    owns_clock = False

    def __init__(self, camera: str, rig: Rig, settings: PlayedSettings) -> None:
        """Prepare it.

        Raises:
            ConfigError: no such camera.
        """
        if camera not in rig.config.cameras:
            raise ConfigError(f"no camera {camera} in {rig.path / 'rig.toml'}; it has {', '.join(rig.config.cameras)}")
        self.instance = camera
        self.clock = SkewedClock(round(settings.clock_offset_s * 1e9), settings.drift_ppm)
        self._settings = settings
        self._world = World.from_rig(rig)
        self._camera = true_cameras(rig)[camera]
        self._phase_s = _PHASE_S * list(rig.config.cameras).index(camera)
        self._rng = np.random.default_rng(list(rig.config.cameras).index(camera))
        self._publisher: Publisher[MarkerFrame] | None = None
        self._late = 0

    @property
    def config(self) -> PlayedSettings:
        """What it plays."""
        return self._settings

    def reconfigure(self, config: BaseModel) -> None:
        """Refuse: start another one.

        Raises:
            ConfigError: always.
        """
        raise ConfigError("a played camera keeps its settings; start it again with others")

    def attach(self, node: Node) -> None:
        """Declare the markers, and show how far off rig time is: both clocks are this machine's, so that is known."""
        self._publisher = node.bus.publisher(f"rhot/markers/{self.instance}", MarkerFrame)
        node.status.include(lambda: {"dropped_late": self._late})
        node.status.watch(lambda: (self._clock_figures(node), ""))

    def _clock_figures(self, node: Node) -> dict[str, float]:
        if not node.clock.ready:
            return {}
        now_ns = time.time_ns()
        return {"clock_error_s": (node.clock.to_rig_ns(self.clock.from_true_ns(now_ns)) - now_ns) / 1e9}

    async def run(self, node: Node, start: Control) -> None:
        """Publish a frame whenever one is due; one that was missed is not sent late."""
        if self._publisher is None:
            raise RuntimeError("run before attach")
        loop = asyncio.get_running_loop()
        period_s = 1.0 / self._settings.rate_hz
        due_s = loop.time() + period_s - (loop.time() - self._phase_s) % period_s
        number = 0
        while True:
            await asyncio.sleep(due_s - loop.time())
            true_ns = time.time_ns()
            self._publisher.put(self._frame(true_ns, node.clock.to_rig_ns(self.clock.from_true_ns(true_ns)), number))
            node.status.tick("output")
            behind = max(0, int((loop.time() - due_s) / period_s))
            self._late += behind
            number += 1 + behind
            due_s += (1 + behind) * period_s

    def _frame(self, true_ns: int, t_ns: int, number: int) -> MarkerFrame:
        # The world starts over after 11 days, so that its time keeps its precision.
        truth = self._world.sample(np.array([(true_ns % (10**15)) * 1e-9])).markers
        uv = self._camera.project(np.array([centre[0] for centre in truth.values()]))
        inside = self._camera.contains(uv)
        uv += self._rng.normal(0.0, NOISE_PX, uv.shape)
        return MarkerFrame(
            t_ns=t_ns,
            camera=self.instance,
            width=self._camera.width,
            height=self._camera.height,
            markers={
                name: Marker(u=float(u), v=float(v), area=200.0, score=0.9)
                for name, (u, v), seen in zip(truth, uv, inside, strict=True)
                if seen
            },
            frame=number,
        )


def write_played_rig(folder: Path, endpoint: str, rate_hz: float = 60.0) -> Rig:
    """Write the folder of a rig for two played cameras, `left` and `right`, and return it loaded."""
    folder.mkdir(parents=True, exist_ok=True)
    text = rig_template(
        folder=str(folder),
        name="played",
        connect=(endpoint,),
        listen=(endpoint,),
        source="simulated",
        rate_hz=rate_hz,
        exposure_s=min(0.006, 0.9 / rate_hz),
        readout_s=min(0.012, 0.9 / rate_hz),
        seed=1,
    )
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    write_json_model(folder / "cameras.json", simulated_rig_calibration(load_rig(folder).config.cameras, 1).found)
    return load_rig(folder)


@click.command()
@click.option("--camera", required=True)
@click.option("--offset", "clock_offset_s", type=Finite(), default=0.0, help="Of its clock, seconds.")
@click.option("--drift", "drift_ppm", type=Finite(), default=0.0, help="Of its clock, parts per million.")
@rig_option
@bus_options
def play(
    camera: str,
    clock_offset_s: float,
    drift_ppm: float,
    rig_path: Path,
    connect: tuple[str, ...],
    namespace: str | None,
) -> int:
    """Play one camera until Ctrl-C."""
    rig = load_rig(rig_path)
    rate_hz = rig.config.cameras[camera].rate_hz if camera in rig.config.cameras else 60.0
    settings = PlayedSettings(rate_hz=rate_hz, clock_offset_s=clock_offset_s, drift_ppm=drift_ppm)
    played = PlayedCamera(camera, rig, settings)
    return run_service(played, tool_bus(rig_path, connect, namespace), node_clock=played.clock)


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s: %(message)s")
    MainGroup("played", lazy={}, commands={"camera": play}).main(["camera", *sys.argv[1:]])
