"""Fixtures that draw painted shapes."""

from painted_shapes import markers, paints, scene, shape, six_shapes, table, write_rig

__all__ = ["markers", "paints", "scene", "shape", "six_shapes", "table", "write_rig"]
