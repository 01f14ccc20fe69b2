"""The web page: the rig as it runs, calibration by hand, recordings."""
