"""Read an uncompressed scan-line OpenEXR file of several parts (openexr.com, "OpenEXR file layout")."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any, Final

import numpy as np

_MAGIC: Final = 20000630
_MULTI_PART: Final = 0x1000
_TYPES: Final = {0: "<u4", 1: "<f2", 2: "<f4"}


def read_layers(path: Path) -> dict[str, np.ndarray]:
    """Return each layer of a file as (H, W, channels) float32; RGBA in this order.

    Raises:
        ValueError: the file is no OpenEXR file, or compressed.
    """
    data = path.read_bytes()
    magic, version = struct.unpack_from("<ii", data)
    if magic != _MAGIC:
        raise ValueError(f"{path}: not an OpenEXR file")
    many = bool(version & _MULTI_PART)
    at, parts = 8, []
    while True:
        header, at = _header(data, at)
        if not header:
            break
        parts.append(header)
        if not many:
            break
    boxes = [struct.unpack("<4i", header["dataWindow"]) for header in parts]
    if any(header["compression"][0] for header in parts):
        raise ValueError(f"{path}: is compressed; write it with codec NONE")
    at += 8 * sum(y1 - y0 + 1 for _, y0, _, y1 in boxes)
    layers: dict[str, np.ndarray] = {}
    # Blender writes part after part, and within a part row after row.
    for header, (x0, y0, x1, y1) in zip(parts, boxes, strict=True):
        width, height = x1 - x0 + 1, y1 - y0 + 1
        fields = _channels(header["channels"], width)
        row = np.dtype([*([("part", "<i4")] if many else []), ("y", "<i4"), ("size", "<i4"), *fields])
        rows = np.frombuffer(data, row, height, at)
        at += row.itemsize * height
        grouped: dict[str, dict[str, np.ndarray]] = {}
        part = header["name"].decode().rstrip("\0") if "name" in header else ""
        for name, *_ in fields:
            layer, _, channel = name.rpartition(".")
            grouped.setdefault(layer or part, {})[channel] = rows[name].astype(np.float32)
        for layer, planes in grouped.items():
            order = sorted(planes, key="RGBA".find)
            layers[layer.rpartition(".")[2]] = np.stack([planes[channel] for channel in order], axis=-1)
    return layers


def _header(data: bytes, at: int) -> tuple[dict[str, bytes], int]:
    header = {}
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)
        size = struct.unpack_from("<i", data, at)[0]
        header[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    return header, at + 1


def _channels(body: bytes, width: int) -> list[Any]:
    fields: list[Any] = []
    place = 0
    while body[place]:
        name, place = _text(body, place)
        fields.append((name, _TYPES[struct.unpack_from("<i", body, place)[0]], (width,)))
        place += 16
    return fields


def _text(data: bytes, at: int) -> tuple[str, int]:
    end = data.index(0, at)
    return data[at:end].decode(), end + 1
