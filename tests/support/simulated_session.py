"""What a simulated rig says for a while, without processes and pictures: blobs through fusion and ik, and the truth."""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import numpy as np

from rhot.arrays import FloatArray
from rhot.messages import Control, MarkerFrame, Message, ServiceStatus
from rhot.offline import core, track_with
from rhot.rig import Rig
from rhot_bench.hands.accuracy import START_NS
from rhot_bench.speed.simulated import world_of
from rhot_bench.tracking.two_hands import named_frames
from rhot_objects.assemble import plan_sources
from rhot_objects.offline import PlayedObjects
from rhot_sim.world.world import World
from rhot_tools.rig.heard import Heard

CLOCK_S = 0.0004
"""What each camera says its clock may be off."""
LATE_S = {"left": 0.0003, "right": -0.0002}
"""And what it is."""
AGE_S, DETECT_S, SENDING_S = 0.012, 0.003, 0.002
_TRUTH_HZ = 60.0


def simulated_session(rig: Rig, seconds: float, seed: int = 1) -> Heard:
    """Return what was heard of a simulated rig from its start on."""
    world, rng, heard = world_of(rig), np.random.default_rng(seed), Heard()
    frames = [_timed(frame, rng.normal(0.0, 2e-4, 2)) for frame in named_frames(rig, world, seconds, seed)]
    objects = PlayedObjects(plan_sources(rig), START_NS)
    tracked = track_with(core("fusion")(rig), core("ik")(rig), frames, objects)
    heard.note("rhot/control", Control(t_ns=START_NS, action="start", start_t_ns=START_NS))
    for name in rig.config.cameras:
        status = ServiceStatus(
            t_ns=START_NS, service="capture", instance=name, state="running", clock_uncertainty_s=CLOCK_S
        )
        heard.note(f"rhot/status/capture/{name}", status)
    truth = _truth(world, seconds)
    for key, message in heapq.merge(tracked, truth, key=lambda each: each[1].t_ns):
        arrived_ns = None
        if isinstance(message, MarkerFrame):
            true_ns = message.t_ns - round(1e9 * LATE_S[message.camera])
            arrived_ns = true_ns + round(1e9 * (sum(message.timing.values()) + SENDING_S + rng.normal(0.0, 2e-4)))
        heard.note(key, message, arrived_ns)
    return heard


def _timed(frame: MarkerFrame, more_s: FloatArray) -> MarkerFrame:
    late_ns = round(1e9 * LATE_S[frame.camera])
    markers = {
        name: marker.model_copy(update={"t_ns": (marker.t_ns or frame.t_ns) + late_ns})
        for name, marker in frame.markers.items()
    }
    timing = {"age": AGE_S + abs(float(more_s[0])), "detect": DETECT_S + abs(float(more_s[1]))}
    return frame.model_copy(update={"t_ns": frame.t_ns + late_ns, "markers": markers, "timing": timing})


def _truth(world: World, seconds: float) -> Iterator[tuple[str, Message]]:
    for number in range(round(seconds * _TRUTH_HZ)):
        t_s = number / _TRUTH_HZ
        yield "rhot/truth", world.truth(t_s, START_NS + round(1e9 * t_s))
