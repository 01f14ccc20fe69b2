"""Offline smoothing of a whole recording."""
