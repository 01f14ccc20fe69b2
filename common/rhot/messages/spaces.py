"""Further frames with a known pose in the rig frame: the floor, a tracking system's space."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from rhot.messages.base import Label, Message

Row = tuple[float, float, float, float]
Matrix4 = tuple[Row, Row, Row, Row]


class Space(Message):
    """A further frame and its pose in the rig frame.

    Attributes:
        T_rig_space: rigid transform that maps coordinates of the space to the rig frame; 4x4 by rows, metres.
        source: method of its calibration, such as `steamvr registration` or `desk board`.
        residual_m: residual of the calibration, metres; absent if not known.
    """

    T_rig_space: Matrix4
    source: Label
    residual_m: Annotated[float, Field(ge=0.0, le=1e3)] | None = None

    @field_validator("T_rig_space")
    @classmethod
    def _rigid(cls, value: Matrix4) -> Matrix4:
        T = np.array(value)
        R = T[:3, :3]
        if (T[3] != (0.0, 0.0, 0.0, 1.0)).any():
            raise ValueError("the last row of T_rig_space must be 0 0 0 1")
        orthonormal = 1e-3
        if float(np.abs(R @ R.T - np.eye(3)).max()) > orthonormal or float(np.linalg.det(R)) < 0.0:
            raise ValueError("T_rig_space is no rigid transform: its rotation is not orthonormal and right-handed")
        if float(np.abs(T[:3, 3]).max()) > 1e3:
            raise ValueError("T_rig_space moves by more than 1000 m")
        return value
