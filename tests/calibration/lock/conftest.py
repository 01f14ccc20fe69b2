"""The fixture that writes a rig."""

from painted_shapes import write_rig

__all__ = ["write_rig"]
