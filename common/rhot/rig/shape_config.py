"""Shapes of objects as `rig.toml` states them: those of the messages, with unknown fields refused, or a file."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import ConfigDict, Field

from rhot.messages import BoxShape, CylinderShape, SphereShape
from rhot.rig.file_model import FileModel

_FILE = ConfigDict(frozen=True, extra="forbid", strict=False, allow_inf_nan=False)


class BoxConfig(BoxShape):
    """See `BoxShape`."""

    model_config = _FILE


class CylinderConfig(CylinderShape):
    """See `CylinderShape`."""

    model_config = _FILE


class SphereConfig(SphereShape):
    """See `SphereShape`."""

    model_config = _FILE


class MeshConfig(FileModel):
    """A surface in a file; `rhot.object_mesh` reads it.

    Attributes:
        kind: which shape.
        file: glTF in its binary form (`.glb`), relative to the rig folder.
        scale: metres per unit of the file. glTF's unit is the metre, but not every program keeps to that.
    """

    kind: Literal["mesh"] = "mesh"
    file: Annotated[str, Field(min_length=1, max_length=1024)]
    scale: Annotated[float, Field(gt=0.0, le=1000.0)] = 1.0


ShapeConfig = Annotated[BoxConfig | CylinderConfig | SphereConfig | MeshConfig, Field(discriminator="kind")]
