"""Reads BVH, sharing nothing with our writer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rhot.geometry.rotations import rotation_x, rotation_y, rotation_z


@dataclass
class Node:
    name: str
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)
    children: list[Node] = field(default_factory=list)


def read_bvh_file(text: str) -> tuple[Node, float, NDArray[np.float64]]:
    """Return root, frame time and frames of a BVH file."""
    words = iter(text.split())
    assert next(words) == "HIERARCHY"
    assert next(words) == "ROOT"

    def node(name: str) -> Node:
        made = Node(name)
        assert next(words) == "{"
        while (word := next(words)) != "}":
            if word == "OFFSET":
                made.offset = np.array([float(next(words)) for _ in range(3)])
            elif word == "CHANNELS":
                made.channels = [next(words) for _ in range(int(next(words)))]
            elif word == "JOINT":
                made.children.append(node(next(words)))
            else:
                assert (word, next(words)) == ("End", "Site")
                made.children.append(node(f"{name} end"))
        return made

    root = node(next(words))
    assert (next(words), next(words)) == ("MOTION", "Frames:")
    count = int(next(words))
    assert (next(words), next(words)) == ("Frame", "Time:")
    frame_s = float(next(words))
    frames = np.array([float(word) for word in words]).reshape(count, -1)
    return root, frame_s, frames


def world_positions(root: Node, frame: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Forward kinematics of one frame: channels in the order of the file, each turning what came before."""
    values = iter(frame.tolist())
    turn = {"X": rotation_x, "Y": rotation_y, "Z": rotation_z}
    found: dict[str, NDArray[np.float64]] = {}

    def visit(node: Node, R: NDArray[np.float64], p: NDArray[np.float64]) -> None:
        p = p + R @ node.offset
        for channel in node.channels:
            value = next(values)
            if channel.endswith("position"):
                p = p + np.eye(3)["XYZ".index(channel[0])] * value
            else:
                R = R @ turn[channel[0]](np.radians(value))
        found[node.name] = p
        for child in node.children:
            visit(child, R, p)

    visit(root, np.eye(3), np.zeros(3))
    assert next(values, None) is None
    return found
