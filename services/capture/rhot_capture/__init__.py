"""Capture: pictures in, two-dimensional markers out."""
