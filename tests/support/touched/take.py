"""What a rig publishes while the simulated finger touches its box: the truth with the noise of a tracked hand."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rhot.messages import HandPose, Joint, Message, State, encode, encoding_of
from rhot.recording.mcap.writer import McapWriter
from rhot.rig import RegistrationFile, Rig, RigidTransform, write_json_model
from rhot.rig.folder import registration_name
from rhot_objects.core import ObjectCore
from rhot_objects.pose import Registration
from rhot_sim.rig.folder import with_motion, write_simulated_rig
from rhot_sim.sources.objects import simulated_objects
from rhot_sim.world.world import World

START_NS = 1_700_000_000_000_000_000
RATE_HZ = 15
"""Of hands and objects: enough to see that both are still."""
NOISE_M = np.array([0.3e-3, 0.3e-3, 1.0e-3])
BIAS_M = np.array([0.0, -0.6e-3, -0.2e-3])
"""Of a fingertip that touches in `rhot sim --motion touch`, rig axes, measured against the truth; z is depth."""
WANDER_S = 1.0
"""Errors of a tracked fingertip change within about this time."""


def touch_rig(path: Path, seed: int = 1) -> Rig:
    """Return a simulated rig whose finger touches its box; the registration knows nothing of the tracker's place."""
    rig = with_motion(write_simulated_rig(path, seed=seed, calibrated=False), "touch")
    space = RigidTransform(position=(0.4, -1.1, 2.0), orientation=(0.5, -0.5, 0.5, 0.5))
    write_json_model(path / registration_name("simulated"), RegistrationFile(T_rig_tracker=space))
    return rig


def take(
    rig_path: Path, rig: Rig, seconds: float, *, seed: int = 1, hand: State = "measured", finger: State = "measured"
) -> Iterator[tuple[str, Message]]:
    """Yield keys and messages of a session, hand and object in turns."""
    world = World.from_rig(rig)
    space = RegistrationFile.model_validate_json((rig_path / registration_name("simulated")).read_text())
    registration = Registration.from_file(space)
    source, core = simulated_objects(rig, registration, frozenset({"cube"})), ObjectCore(registration)
    source.open(START_NS)
    rng = np.random.default_rng(seed)
    t_s = np.arange(0.0, seconds, 1.0 / RATE_HZ)
    tips = world.sample(t_s).joints["right"].position("index_tip")
    radius = float(world.hands["right"].radii[10])
    kept = np.exp(-1.0 / (RATE_HZ * WANDER_S))
    error = NOISE_M * rng.normal(size=3)
    for t, tip in zip(t_s, tips, strict=True):
        t_ns = START_NS + round(1e9 * t)
        error = kept * error + np.sqrt(1.0 - kept**2) * NOISE_M * rng.normal(size=3)
        x, y, z = (tip + BIAS_M + error).tolist()
        yield (
            "rhot/hand/right",
            HandPose(
                t_ns=t_ns,
                side="right",
                frame="rig",
                joints={"index_tip": Joint(position=(x, y, z), orientation=(0.0, 0.0, 0.0, 1.0), radius=radius)},
                angles={},
                residual={"index": 0.001},
                fingers={"index": finger},
                state=hand,
            ),
        )
        yield from core.feed(source.read(t_ns), t_ns)


def write_take(file: Path, messages: Iterator[tuple[str, Message]]) -> Path:
    """Write messages into an MCAP file."""
    with McapWriter(file, now_ns=START_NS) as writer:
        for key, message in messages:
            writer.write(key, encoding_of(type(message)), encode(message), message.t_ns, message.seq, message.t_ns)
    return file
