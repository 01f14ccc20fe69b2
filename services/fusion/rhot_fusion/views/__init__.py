"""Marker views, their geometry, and checks of the calibration."""
