"""Shapes of objects as `rig.toml` states them: those of the messages, with unknown fields refused."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field

from rhot.messages import BoxShape, CylinderShape, SphereShape

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


ShapeConfig = Annotated[BoxConfig | CylinderConfig | SphereConfig, Field(discriminator="kind")]
