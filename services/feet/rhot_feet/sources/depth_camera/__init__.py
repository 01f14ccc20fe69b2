"""Depth cameras behind one seam."""
