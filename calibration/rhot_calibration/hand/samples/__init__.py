"""What a calibration keeps of the points of a hand, and where these come from."""
