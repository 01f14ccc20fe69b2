"""Calibration of every part of a rig, as commands and as steps of the page."""
