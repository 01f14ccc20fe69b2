"""Plain types that messages, files and numeric cores share: none of them needs pydantic."""

from __future__ import annotations

from typing import Literal

Side = Literal["left", "right"]
State = Literal["measured", "predicted"]
"""`measured`: based on an observation at this time; `predicted`: extrapolated by a model."""
PointState = Literal["measured", "one_view", "predicted"]
"""`measured`: seen by two or more cameras at this time; `one_view`: on one camera's ray; `predicted`: extrapolated."""
Vector3 = tuple[float, float, float]
"""Metres."""
Pixels = tuple[float, float]
"""u, v."""
