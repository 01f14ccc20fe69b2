"""From a frame to markers."""
