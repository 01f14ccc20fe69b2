"""Reads an animated glTF scene as the specification has it, sharing nothing with our writer."""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from rhot.arrays import FloatArray

_TYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GltfScene:
    """Nodes by name, with where they are at any time of the only animation."""

    def __init__(self, file: Path) -> None:
        data = file.read_bytes()
        if data[:4] == b"glTF":
            _, version, length = struct.unpack_from("<4sII", data)
            assert (version, length) == (2, len(data))
            size, kind = struct.unpack_from("<I4s", data, 12)
            assert kind == b"JSON"
            self.json: dict[str, Any] = json.loads(data[20 : 20 + size])
            size_binary, kind = struct.unpack_from("<I4s", data, 20 + size)
            assert kind == b"BIN\0"
            self._buffer = data[28 + size : 28 + size + size_binary]
        else:
            self.json = json.loads(data)
            self._buffer = base64.b64decode(self.json["buffers"][0]["uri"].partition(",")[2])
        self.nodes = self.json["nodes"]
        self._parents = {child: at for at, node in enumerate(self.nodes) for child in node.get("children", [])}
        (animation,) = self.json["animations"]
        self._tracks: dict[tuple[int, str], tuple[FloatArray, FloatArray]] = {}
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            assert sampler["interpolation"] == "LINEAR"
            target = (channel["target"]["node"], channel["target"]["path"])
            self._tracks[target] = self.values(sampler["input"])[:, 0], self.values(sampler["output"])

    def values(self, accessor: int) -> FloatArray:
        """Return an accessor's content (N, C)."""
        stated = self.json["accessors"][accessor]
        view = self.json["bufferViews"][stated["bufferView"]]
        kind, width = _TYPES[stated["componentType"]], _WIDTHS[stated["type"]]
        found = np.frombuffer(self._buffer, kind, stated["count"] * width, view["byteOffset"])
        return found.reshape(-1, width).astype(np.float64)

    def matrix(self, node: int, t_s: float) -> FloatArray:
        """Return a node's pose (4, 4) in the scene."""
        T = np.eye(4)
        T[:3, :3] = self._rotation(node, t_s)
        T[:3, 3] = self._translation(node, t_s)
        parent = self._parents.get(node)
        return T if parent is None else self.matrix(parent, t_s) @ T

    def position(self, name: str, t_s: float) -> FloatArray:
        """Return where the node of a name is, (3,); of two, the one without a skin."""
        (node,) = [at for at, each in enumerate(self.nodes) if each["name"] == name and "skin" not in each]
        return self.matrix(node, t_s)[:3, 3]

    def _translation(self, node: int, t_s: float) -> FloatArray:
        track = self._tracks.get((node, "translation"))
        if track is None:
            return np.array(self.nodes[node].get("translation", (0.0, 0.0, 0.0)))
        return np.array([np.interp(t_s, track[0], column) for column in track[1].T])

    def _rotation(self, node: int, t_s: float) -> FloatArray:
        track = self._tracks.get((node, "rotation"))
        if track is None:
            return np.asarray(Rotation.from_quat(self.nodes[node].get("rotation", (0, 0, 0, 1))).as_matrix())
        times, xyzw = track
        return np.asarray(Slerp(times, Rotation.from_quat(xyzw))(np.clip(t_s, times[0], times[-1])).as_matrix())
