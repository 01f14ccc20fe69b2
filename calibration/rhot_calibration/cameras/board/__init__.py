"""Calibration boards: describing, printing and finding them."""
