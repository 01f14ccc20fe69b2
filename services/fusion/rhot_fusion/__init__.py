"""From two-dimensional markers of several cameras to points in space."""
