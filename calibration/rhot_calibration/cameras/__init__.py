"""Calibration of the cameras: boards in pictures in, `cameras.json` out."""
