"""Write docs/images/bridge-poses.svg, the four known poses in each program's axes: `python docs/make_pose_drawing.py`.

The poses are those of the tests, and so are the hands: what `tests/bridge/test_known_poses.py` checks is what is drawn.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from bridged.poses import POSES, hand

from rhot.anatomy.skeleton import CHAINS, FINGERS, JOINTS

FloatArray = NDArray[np.float64]

DRAWING: Final = Path(__file__).with_name("images") / "bridge-poses.svg"
CELL: Final = (250.0, 170.0)
"""Width and height of one pose, units of the drawing."""
SCALE: Final = 620.0
"""Units per metre."""
COLORS: Final = {"left": "#2f7fd0", "right": "#d07f2f"}
AXES: Final = (
    ("stage: json, vmt, lsl", {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}),
    ("ros2", {"x": (0.0, 0.0, -1.0), "y": (-1.0, 0.0, 0.0), "z": (0.0, 1.0, 0.0)}),
    ("Unity: vmc, vrchat, json --axes unity", {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, -1.0)}),
)
"""Where each program's axes point, in stage axes."""


def seen(points: FloatArray) -> FloatArray:
    """Return points (..., 3), stage axes, as the person sees them from above, a little from the right, as (..., 2)."""
    tilt, turn = np.radians(40.0), np.radians(-20.0)
    right = np.cos(turn) * points[..., 0] + np.sin(turn) * points[..., 2]
    near = np.cos(turn) * points[..., 2] - np.sin(turn) * points[..., 0]
    return np.stack([right, np.sin(tilt) * near - np.cos(tilt) * points[..., 1]], axis=-1)


def one_pose(pose: str, left: float, top: float) -> list[str]:
    """Return a pose of both hands as SVG lines in a cell."""
    parts = [f'<text x="{left + CELL[0] / 2}" y="{top + 16}">{pose}</text>']
    for side in ("left", "right"):
        joints = hand(pose, side)  # type: ignore[arg-type]
        wrist = joints.positions[JOINTS.index("wrist")]
        offset = np.array([-0.1 if side == "left" else 0.1, 0.0, 0.0])
        flat = SCALE * seen(joints.positions - wrist + offset)
        flat += (left + CELL[0] / 2, top + CELL[1] - 30.0)
        for finger in FINGERS:
            rows = [JOINTS.index(joint) for joint in ("wrist", *CHAINS[finger])]
            way = " ".join(f"{x:.1f},{y:.1f}" for x, y in flat[rows].tolist())
            parts.append(f'<polyline points="{way}" stroke="{COLORS[side]}"/>')
        x, y = flat[JOINTS.index("wrist")].tolist()
        parts.append(f'<text x="{x:.1f}" y="{y + 18:.1f}" fill="{COLORS[side]}">{side}</text>')
    return parts


def axes(title: str, directions: dict[str, tuple[float, float, float]], left: float, top: float) -> list[str]:
    """Return three named arrows and their title."""
    parts = [f'<text x="{left}" y="{top + 62}">{title}</text>']
    for name, direction in directions.items():
        x, y = (42.0 * seen(np.array(direction))).tolist()
        parts.append(f'<line x1="{left}" y1="{top}" x2="{left + x:.1f}" y2="{top + y:.1f}" marker-end="url(#tip)"/>')
        parts.append(f'<text x="{left + 1.3 * x:.1f}" y="{top + 1.3 * y + 4:.1f}">{name}</text>')
    return parts


def drawing() -> str:
    """Return the drawing as SVG text."""
    width, height = len(POSES) * CELL[0], CELL[1] + 150.0
    parts = [part for number, pose in enumerate(POSES) for part in one_pose(pose, number * CELL[0], 0.0)]
    for number, (title, directions) in enumerate(AXES):
        parts += axes(title, directions, (1.0 + 2.0 * number) / 6.0 * width, CELL[1] + 70.0)
    style = (
        "text{font:13px sans-serif;text-anchor:middle;fill:#222}"
        "polyline{fill:none;stroke-width:4;stroke-linecap:round;stroke-linejoin:round}line{stroke:#666;stroke-width:2}"
    )
    tip = '<marker id="tip" viewBox="0 0 8 8" refX="6" refY="4" markerWidth="6" markerHeight="6" orient="auto">'
    tip += '<path d="M0 0L8 4L0 8z" fill="#666"/></marker>'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" width="{width:g}">\n'
        f'<rect width="100%" height="100%" fill="#fff"/><style>{style}</style><defs>{tip}</defs>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


if __name__ == "__main__":
    DRAWING.write_text(drawing(), encoding="utf-8")
