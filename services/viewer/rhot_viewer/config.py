"""What may change in the viewer while it runs."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from rhot.rig.file_model import FileModel


class ViewerConfig(FileModel):
    """What `rhot/config/viewer/<instance>` shows.

    Attributes:
        rate_hz: how often moving things are sent to the browsers, at most.
        picture_rate_hz: how often each camera is asked for its picture while somebody looks.
    """

    rate_hz: Annotated[float, Field(ge=1.0, le=120.0)] = 60.0
    picture_rate_hz: Annotated[float, Field(ge=0.2, le=30.0)] = 4.0
