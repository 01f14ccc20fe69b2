"""Recorded messages put back on the bus."""
