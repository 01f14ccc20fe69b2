"""A camera's image from its running capture service."""

from __future__ import annotations

from typing import Literal

from rhot.bus import Bus


async def preview_of(
    bus: Bus, camera: str, image_format: Literal["jpeg", "png"], timeout_s: float
) -> tuple[bytes | None, str]:
    """Return a camera's newest image, encoded, or None and the reason why there is none."""
    replies = await bus.get(f"rhot/preview/{camera}?format={image_format}", timeout_s=timeout_s)
    reply = next((reply for reply in replies if not reply.error), None)
    if reply is not None:
        return reply.payload, ""
    return None, replies[0].error if replies else "no answer to the query for its image"
