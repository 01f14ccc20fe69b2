"""A whole rig in one event loop, without rendering or tracking: what its services publish and answer, at full rate.

The hand is the simulated world's own with a small wrong step; pictures are discs where the cameras would see markers.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rhot.anatomy.skeleton import FINGERS, JOINTS
from rhot.arrays import FloatArray
from rhot.bus import Answer, Bus, Request
from rhot.errors import ConfigError
from rhot.messages import (
    HandPose,
    Joint,
    Marker,
    MarkerFrame,
    Message,
    ObjectPose,
    Point,
    PointSet,
    ServiceStatus,
    State,
    TruePose,
    Truth,
)
from rhot.object_mesh import object_shape
from rhot.rig import BusConfig, Rig, load_rig
from rhot.rig.colors import ColorsFile, RgbBoxColor
from rhot.service.clock_sync import serve_clock
from rhot.service.configuration import changed, config_answer, digest, parse_change
from rhot_capture.settings import CameraSettings
from rhot_sim.rig.calibration import true_cameras
from rhot_sim.world.paint import paints_of
from rhot_sim.world.world import World

RATE_HZ = 60.0
OFFSET_M = 0.002
SERVICES = ("fusion/main", "ik/main", "objects/main", "truth/main")
ERROR = "a stubbed error & <b>its markup</b>"


class StubRig:
    """The rig.

    Attributes:
        settings: of the cameras; `asked`: what previews were asked for; `newest`: what each camera sees. May be read
            from other threads.
        still: the world stands still, at `still_s`; both may be set while it runs.
        zero_ns: when the world began, rig clock.
    """

    def __init__(
        self,
        rig: Rig,
        endpoint: str,
        *,
        predicted: tuple[str, ...] = ("little",),
        still: bool = False,
        clock: bool = False,
    ) -> None:
        self.rig = rig
        self.world = World.from_rig(rig)
        self.cameras = true_cameras(rig)
        self.paints = paints_of(rig.config.markers)
        colors = ColorsFile(
            markers={name: RgbBoxColor(low=(0.0, 0.0, 0.0), high=paint[::-1]) for name, paint in self.paints.items()}
        )
        self.settings = {
            name: CameraSettings.from_config(camera, colors) for name, camera in rig.config.cameras.items()
        }
        self.asked: list[str] = []
        self.still = still
        self.still_s = 1.0
        self._has_clock = clock
        self.zero_ns = 0
        self._predicted = predicted
        self._busy = set(self.cameras)
        self._endpoint = endpoint
        self._places: deque[tuple[float, FloatArray]] = deque(maxlen=round(120 * RATE_HZ))
        self.newest: dict[str, MarkerFrame] = {}

    def play_from(self, t_s: float) -> None:
        """Let it be this moment of the world now; may be called from other threads."""
        self.zero_ns = time.time_ns() - round(1e9 * t_s)

    async def run(self) -> None:
        """Publish until cancelled."""
        async with (
            await Bus.open(BusConfig(mode="router", connect=(), listen=(self._endpoint,))),
            await Bus.open(BusConfig(connect=(self._endpoint,))) as bus,
        ):
            if self._has_clock:
                serve_clock(bus)
            for name in self.cameras:
                bus.queryable(f"rhot/preview/{name}", partial(self._preview, name), slow=True)
                bus.queryable(f"rhot/config/capture/{name}", partial(self._config, name), slow=True)
            services = (*SERVICES, *(f"capture/{name}" for name in self.cameras))
            for service in services:
                bus.alive(f"rhot/alive/{service}")
            keys: dict[str, type[Message]] = {
                "rhot/points": PointSet,
                "rhot/truth": Truth,
                **{f"rhot/hand/{side}": HandPose for side in self.world.hands},
                **{f"rhot/object/{name}": ObjectPose for name in self.world.objects},
                **{f"rhot/markers/{name}": MarkerFrame for name in self.cameras},
                **{f"rhot/status/{service}": ServiceStatus for service in services},
            }
            publishers = {key: bus.publisher(key, model) for key, model in keys.items()}
            begun = time.monotonic()
            self.play_from(0.0)
            ticks = 0
            while True:
                t_s = self.still_s if self.still else (time.time_ns() - self.zero_ns) * 1e-9
                for key, message in self.messages(t_s, time.time_ns(), ticks).items():
                    publishers[key].put(message)
                ticks += 1
                await asyncio.sleep(max(0.0, begun + ticks / RATE_HZ - time.monotonic()))

    def messages(self, t_s: float, t_ns: int, tick: int) -> dict[str, Message]:
        """Return what the services publish at a moment of the world."""
        truth = self.world.truth(t_s, t_ns)
        moving = [
            truth.points.values(),
            *([pose.position for pose in joints.values()] for joints in truth.hands.values()),
        ]
        moving.append([pose.position for pose in truth.objects.values()])
        self._places.append((time.monotonic(), np.array([place for group in moving for place in group])))
        found: dict[str, Message] = {"rhot/truth": truth}
        found["rhot/points"] = PointSet(
            t_ns=t_ns,
            frame="rig",
            points={
                name: Point(position=place, sigma=0.001, views=2, state=self._state(name))
                for name, place in truth.points.items()
            },
        )
        for side, model in self.world.hands.items():
            found[f"rhot/hand/{side}"] = HandPose(
                t_ns=t_ns,
                side=side,
                frame="rig",
                joints={
                    name: Joint(
                        position=(pose.position[0] + OFFSET_M, *pose.position[1:]),
                        orientation=pose.orientation,
                        radius=float(model.radii[JOINTS.index(name)]),
                    )
                    for name, pose in truth.hands[side].items()
                },
                angles={},
                residual=dict.fromkeys(FINGERS, 0.0011),
                fingers={finger: self._state(finger) for finger in FINGERS},
                state="measured",
            )
        found |= {f"rhot/object/{name}": _object(pose, t_ns, self.rig, name) for name, pose in truth.objects.items()}
        for name, camera in self.cameras.items():
            pixels = camera.project(np.array(list(truth.points.values())))
            markers = {
                marker: Marker(u=float(u), v=float(v), area=150.0, score=0.9)
                for marker, (u, v) in zip(truth.points, pixels, strict=True)
                if 0.0 <= u < camera.width and 0.0 <= v < camera.height
            }
            self.newest[name] = MarkerFrame(
                t_ns=t_ns, camera=name, width=camera.width, height=camera.height, markers=markers
            )
            found[f"rhot/markers/{name}"] = self.newest[name]
        if tick % round(RATE_HZ) == 0:
            found |= self._statuses(t_ns, tick)
        return found

    def trodden(self, since_s: float) -> FloatArray:
        """Return where joints, markers and objects have been since a moment of `time.monotonic`, (N, 3), metres."""
        return np.concatenate([places for at_s, places in list(self._places) if at_s >= since_s])

    def _state(self, name: str) -> State:
        return "predicted" if name in self._predicted else "measured"

    def _statuses(self, t_ns: int, tick: int) -> dict[str, Message]:
        statuses: dict[str, Message] = {}
        for index, name in enumerate((*SERVICES, *(f"capture/{camera}" for camera in self.cameras))):
            service, instance = name.split("/")
            statuses[f"rhot/status/{name}"] = ServiceStatus(
                t_ns=t_ns,
                service=service,
                instance=instance,
                state="running",
                rates={"output": RATE_HZ - index},
                counts={"missed": tick // 60 * (index % 2)},
                latency_s={"output_age": {"p50": 0.008 + 0.004 * index, "p99": 0.014 + 0.005 * index}},
                last_error=ERROR if service == "objects" else "",
                config_digest=digest(self.settings[instance]) if service == "capture" else "",
            )
        return statuses

    def _preview(self, camera: str, request: Request) -> Answer:
        self.asked.append(f"{camera} {dict(request.parameters)}")
        mask = request.parameters.get("mask")
        frame = self.newest[camera]
        picture = np.full((frame.height, frame.width, 3), 26, dtype=np.uint8)
        for name, marker in frame.markers.items():
            color = self.paints[name] if mask in (None, name) else (60, 60, 60)
            cv2.circle(picture, (round(marker.u), round(marker.v)), 12, color, -1, cv2.LINE_AA)
        return Answer(bytes(cv2.imencode(".jpg", picture)[1]), "image/jpeg")

    def _config(self, camera: str, request: Request) -> Answer:
        if request.payload:
            wanted = changed(self.settings[camera], parse_change(request.payload))
            if wanted.exposure_s > 1.0 / RATE_HZ:
                raise ConfigError(f"exposure_s: {wanted.exposure_s:g} s is longer than a frame at {RATE_HZ:g} Hz")
            self.settings[camera] = wanted
        elif camera in self._busy:
            # The first reading is answered too late for who asks, as a camera that is being opened answers.
            self._busy.discard(camera)
            time.sleep(1.0)
        return config_answer(self.settings[camera], request)


def _object(pose: TruePose, t_ns: int, rig: Rig, name: str) -> ObjectPose:
    shape = object_shape(rig, name)
    return ObjectPose(
        t_ns=t_ns, frame="rig", position=pose.position, orientation=pose.orientation, state="measured", shape=shape
    )


class StubThread:
    """A stub rig on a thread with an event loop of its own, so that a test may wait for a browser meanwhile."""

    def __init__(self, path: Path, endpoint: str, **options: Any) -> None:
        self.rig = StubRig(load_rig(path), endpoint, **options)
        self._loop = asyncio.new_event_loop()
        self._work = self._loop.create_task(self.rig.run())
        self._thread = threading.Thread(target=self._run, name="stub-rig")

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._work)
        except asyncio.CancelledError:
            pass
        finally:
            self._loop.run_until_complete(self._loop.shutdown_default_executor())
            self._loop.close()

    def __enter__(self) -> StubRig:
        self._thread.start()
        return self.rig

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._work.cancel)
        self._thread.join()
