"""Where depth frames come from: every kind of camera behind one seam."""

from rhot_feet.sources.depth_camera.factory import open_depth_source

__all__ = ["open_depth_source"]
