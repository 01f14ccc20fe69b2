"""OpenEXR files as Blender writes them: several uncompressed parts."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from worlds.blender.exr import read_layers


def attribute(name: str, kind: str, value: bytes) -> bytes:
    return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value


def written(path: Path, layers: dict[str, np.ndarray], compression: int = 0) -> None:
    height, width, _ = next(iter(layers.values())).shape
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    head, body = struct.pack("<ii", 20000630, 2 | 0x1000), b""
    for part, (name, picture) in enumerate(layers.items()):
        channels = b"".join(f"{name}.{c}".encode() + b"\0" + struct.pack("<iiii", 2, 0, 1, 1) for c in "BGR") + b"\0"
        head += attribute("channels", "chlist", channels) + attribute(
            "compression", "compression", bytes([compression])
        )
        head += attribute("dataWindow", "box2i", window) + attribute("name", "string", name.encode()) + b"\0"
        for y in range(height):
            row = picture[y, :, ::-1].T.astype("<f4").tobytes()
            body += struct.pack("<iii", part, y, len(row)) + row
    path.write_bytes(head + b"\0" + bytes(8 * height * len(layers)) + body)


def test_layers_come_back_as_they_were_written(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    layers = {f"View.{name}": rng.random((4, 6, 3)).astype(np.float32) for name in ("Combined", "maskA")}
    written(tmp_path / "a.exr", layers)
    read = read_layers(tmp_path / "a.exr")
    assert set(read) == {"Combined", "maskA"}
    for name, picture in read.items():
        np.testing.assert_array_equal(picture, layers[f"View.{name}"])


def test_what_cannot_be_read_is_refused(tmp_path: Path) -> None:
    written(tmp_path / "a.exr", {"View.Combined": np.zeros((2, 2, 3), np.float32)}, compression=3)
    with pytest.raises(ValueError, match="codec NONE"):
        read_layers(tmp_path / "a.exr")
    (tmp_path / "b.exr").write_bytes(b"no picture at all")
    with pytest.raises(ValueError, match="not an OpenEXR file"):
        read_layers(tmp_path / "b.exr")
