"""USB and other Video4Linux cameras."""

from rhot_capture.sources.v4l2.source import V4l2Source

__all__ = ["V4l2Source"]
