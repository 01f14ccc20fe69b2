"""A glTF 2.0 document in the making: one buffer, accessors into it, and the JSON around them.

Format: Khronos, "glTF 2.0 Specification" (2021), sections 3.6 (buffers) and 4.4 (GLB).
"""

from __future__ import annotations

import base64
import json
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_FLOAT: Final = 5126
_UNSIGNED_BYTE: Final = 5121
_UNSIGNED_SHORT: Final = 5123
_UNSIGNED_INT: Final = 5125
_COMPONENTS: Final = {"f4": _FLOAT, "u1": _UNSIGNED_BYTE, "u2": _UNSIGNED_SHORT, "u4": _UNSIGNED_INT}
_VERTICES: Final = 34962
_INDICES: Final = 34963
_GLB_MAGIC: Final = 0x46546C67
_JSON_CHUNK: Final = 0x4E4F534A
_BINARY_CHUNK: Final = 0x004E4942


class Document:
    """Collects nodes, meshes, skins and one animation.

    Attributes:
        content: the JSON, but for the buffer.
    """

    def __init__(self, generator: str) -> None:
        self.content: dict[str, Any] = {"asset": {"version": "2.0", "generator": generator}}
        self._buffer = bytearray()

    def add(self, kind: str, item: dict[str, Any]) -> int:
        """Append an item to a list of the document, such as `nodes`, and return its index."""
        items = self.content.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def accessor(self, values: NDArray[Any], shape: str, *, bounds: bool = False, target: int | None = None) -> int:
        """Append values (N,) or (N, C) to the buffer and return the index of their accessor.

        Args:
            values: float64 is stored as float32; other types must be float32 or unsigned of 8, 16 or 32 bits.
            shape: glTF's type, such as `VEC3`.
            bounds: state the least and the largest values.
            target: what a vertex buffer is for.
        """
        stored = np.ascontiguousarray(values, np.float32 if values.dtype.kind == "f" else None)
        stored = stored.astype(stored.dtype.newbyteorder("<"))
        self._buffer += bytes(-len(self._buffer) % 4)
        view = {"buffer": 0, "byteOffset": len(self._buffer), "byteLength": stored.nbytes}
        self._buffer += stored.tobytes()
        if target is not None:
            view["target"] = target
        accessor: dict[str, Any] = {
            "bufferView": self.add("bufferViews", view),
            "componentType": _COMPONENTS[stored.dtype.str[1:]],
            "count": len(stored),
            "type": shape,
        }
        if bounds:
            flat = stored.reshape(len(stored), -1).astype(np.float64)
            accessor |= {"min": flat.min(axis=0).tolist(), "max": flat.max(axis=0).tolist()}
        return self.add("accessors", accessor)

    def vertices(self, values: NDArray[Any], shape: str, *, bounds: bool = False) -> int:
        """Append what belongs to the vertices of a mesh; see `accessor`."""
        return self.accessor(values, shape, bounds=bounds, target=_VERTICES)

    def indices(self, values: NDArray[Any]) -> int:
        """Append the corners of triangles, (N,)."""
        return self.accessor(np.asarray(values, np.uint32).reshape(-1), "SCALAR", target=_INDICES)

    def text(self) -> str:
        """Return the document as one JSON file, the buffer inside it."""
        data = base64.b64encode(bytes(self._buffer)).decode()
        return json.dumps(self._whole(f"data:application/octet-stream;base64,{data}"), allow_nan=False) + "\n"

    def binary(self) -> bytes:
        """Return the document as a GLB file."""
        head = json.dumps(self._whole(None), allow_nan=False).encode()
        head += b" " * (-len(head) % 4)
        body = bytes(self._buffer) + bytes(-len(self._buffer) % 4)
        chunks = struct.pack("<II", len(head), _JSON_CHUNK) + head
        if body:
            chunks += struct.pack("<II", len(body), _BINARY_CHUNK) + body
        return struct.pack("<III", _GLB_MAGIC, 2, 12 + len(chunks)) + chunks

    def _whole(self, uri: str | None) -> dict[str, Any]:
        buffer: dict[str, Any] = {"byteLength": len(self._buffer)}
        if uri is not None:
            buffer["uri"] = uri
        return {**self.content, **({"buffers": [buffer]} if self._buffer else {})}
