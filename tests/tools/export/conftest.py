"""A recording in which both hands take four known poses above a known floor, with object, head, feet and legs."""

from __future__ import annotations

from pathlib import Path

import pytest
from bridged.poses import POSES, T_RIG_STAGE, angles, hand_message, object_message, stage_message
from exported.person import BEGIN_NS, RATE_HZ, SECONDS_A_POSE, body_message, foot_message, head_message

from rhot.anatomy.skeleton import FINGERS
from rhot.messages import FingerAngles, Message, Side

SIDES: tuple[Side, ...] = ("left", "right")


@pytest.fixture(scope="session")
def poses_recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """JSON Lines: each pose for half a second at 60 Hz; the feet come at 100 Hz, a little later."""
    messages: list[tuple[str, Message]] = [("rhot/space/stage", stage_message(BEGIN_NS))]
    frames = round(SECONDS_A_POSE * RATE_HZ)
    for number in range(frames * len(POSES)):
        pose, t_ns = POSES[number // frames], BEGIN_NS + round(number / RATE_HZ * 1e9)
        names = ("mcp_flexion", "mcp_abduction", "pip_flexion", "dip_flexion")
        fingers = {
            finger: FingerAngles(**dict(zip(names, row, strict=True)))
            for finger, row in zip(FINGERS, angles(pose).tolist(), strict=True)
        }
        for side in SIDES:
            hand = hand_message(pose, side, t_ns).model_copy(update={"angles": fingers})
            messages.append((f"rhot/hand/{side}", hand))
        messages.append(("rhot/object/cube", object_message(t_ns)))
    for number in range(round(len(POSES) * SECONDS_A_POSE * 100.0)):
        t_ns = BEGIN_NS + 3_000_000 + round(number * 1e7)
        messages += [(f"rhot/foot/{side}", foot_message(side, t_ns, T_RIG_STAGE)) for side in SIDES]
        messages.append(("rhot/head", head_message(t_ns, T_RIG_STAGE)))
        messages.append(("rhot/body", body_message(t_ns, T_RIG_STAGE)))
    file = tmp_path_factory.mktemp("poses") / "poses.jsonl"
    lines = (f'{{"key": "{key}", "value": {message.model_dump_json()}}}\n' for key, message in messages)
    file.write_text("".join(lines))
    return file
