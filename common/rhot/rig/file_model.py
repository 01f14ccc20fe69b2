"""What every model of a rig's files is built from."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

_MOST = 1e6
"""No number of a rig file is larger: 1e300 would be accepted here and overflow in every sample."""
Coordinate = Annotated[float, Field(ge=-1e3, le=1e3)]
Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Positive = Annotated[float, Field(gt=0.0, le=_MOST)]
NotNegative = Annotated[float, Field(ge=0.0, le=_MOST)]
HoldS = Annotated[float, Field(ge=0.0, le=10.0)]
"""How long something is predicted after it was last seen, seconds; nothing moves predictably for longer."""


class FileModel(BaseModel):
    """Base of everything read from a rig folder: frozen, finite, unknown fields refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
