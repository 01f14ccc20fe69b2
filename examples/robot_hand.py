"""A robot's hand follows yours: `python robot_hand.py CONFIG URDFS [grasp.mcap] > joints.jsonl`.

CONFIG is a file of dex-retargeting, such as its `configs/teleop/allegro_hand_right.yml`, URDFS the folder of the robot
hands that it names. Without a recording, the hand of the running rig (`rhot sim`) drives the robot until Ctrl-C. A line
of output is the robot's joint angles at one moment, radians. At the end, standard error tells how long a pose took and
how far the robot's tips are from the human ones, in the size of the human hand. `--openxr` starts from the 26 joints of
XR_EXT_hand_tracking, as any OpenXR program has them. Needs `pip install 'rhot[record]' dex-retargeting torch six`.
"""

import argparse
import contextlib
import json
import sys
import time
from pathlib import Path

import numpy as np
from dex_retargeting.retargeting_config import RetargetingConfig

import rhot
from rhot.anatomy.skeleton import JOINTS
from rhot.geometry.rotations import rotation_from_quaternion
from rhot.take.tracks import LANDMARKS

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("config", type=Path)
parser.add_argument("urdfs", type=Path)
parser.add_argument("recording", type=Path, nargs="?")
parser.add_argument("--openxr", action="store_true")
asked = parser.parse_args()
side = "left" if "left" in asked.config.stem else "right"

RetargetingConfig.set_default_urdf_dir(asked.urdfs)
config = RetargetingConfig.load_from_file(asked.config, {"low_pass_alpha": 1.0})
if asked.openxr:
    rows = np.array([JOINTS.index(name) for name in LANDMARKS["mediapipe"]])
    config.target_link_human_indices = rows[config.target_link_human_indices]
robot = config.build()
origins, ends = config.target_link_human_indices


def from_openxr(positions, wrist):
    """Return the 26 joints in the wrist's frame with the axes of robot hands: x out of the palm, z to the fingers."""
    return (positions - positions[JOINTS.index("wrist")]) @ rotation_from_quaternion(wrist)[:, [1, 0, 2]] * -1.0


def recorded():
    """Yield the time and the points of each recorded pose."""
    hand = rhot.load(asked.recording).hands[side]
    points = hand.landmarks21(frame="wrist")
    for row, t_ns in enumerate(hand.t_ns):
        wrist = hand.orientations[row, JOINTS.index("wrist")]
        yield t_ns, from_openxr(hand.positions[row], wrist) if asked.openxr else points[row]


def live():
    """Yield the time and the points of each pose of the running rig."""
    with rhot.connect() as rig:
        for hand in rig.hands(side):
            wrist = hand.orientations[JOINTS.index("wrist")]
            yield hand.t_ns, from_openxr(hand.positions, wrist) if asked.openxr else hand.landmarks21(frame="wrist")


model, took_ms, off_mm = robot.optimizer.robot, [], []
links = list(zip(config.target_origin_link_names, config.target_task_link_names, strict=True))
with contextlib.suppress(KeyboardInterrupt):
    for t_ns, points in recorded() if asked.recording else live():
        begin = time.perf_counter()
        human = points[ends] - points[origins]
        angles = robot.retarget(human)
        took_ms.append(1e3 * (time.perf_counter() - begin))
        json.dump({"t_ns": int(t_ns), **dict(zip(robot.joint_names, angles.tolist(), strict=True))}, sys.stdout)
        sys.stdout.write("\n")
        # A robot waits for no full buffer.
        sys.stdout.flush()
        model.compute_forward_kinematics(angles)
        at = {name: model.get_link_pose(model.get_link_index(name))[:3, 3] for link in links for name in link}
        reached = np.array([at[end] - at[origin] for origin, end in links]) / config.scaling_factor
        off_mm.append(1e3 * np.linalg.norm(reached - human, axis=1))
sys.stderr.write(
    f"{len(took_ms)} poses, {np.median(took_ms):.1f} ms each (99 %: {np.percentile(took_ms, 99):.1f}), "
    f"tips {np.median(off_mm):.0f} mm from the human hand's (95 %: {np.percentile(off_mm, 95):.0f})\n"
)
