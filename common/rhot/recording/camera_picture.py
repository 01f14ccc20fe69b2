"""Pictures on the bus, from the camera nodes to who records them."""

from __future__ import annotations

from typing import Annotated, Final

from pydantic import ConfigDict, Field

from rhot.messages import Count, Message, Name

PICTURES_KEY: Final = "rhot/@pictures"
"""Cameras publish below this. Wildcards such as `rhot/**` do not take in a chunk that begins with @: whoever watches or
records everything gets no pictures, and nobody codes any, unless they are asked for by name."""


class CameraPicture(Message):
    """One frame of a camera that was looked at for markers.

    Attributes:
        t_ns: start of the first row's exposure, rig clock.
        camera: name of the camera as in `rig.toml`.
        frame: the source's frame counter.
        exposure_s: exposure time of each row.
        readout_s: time between the read-out of the first and of the last row.
        jpeg: the picture.
    """

    model_config = ConfigDict(ser_json_bytes="base64", val_json_bytes="base64")

    camera: Name
    frame: Count
    exposure_s: Annotated[float, Field(ge=0.0, le=10.0)]
    readout_s: Annotated[float, Field(ge=0.0, le=10.0)]
    jpeg: bytes
