"""Calibration of the hand: points of the markers in, `hand.json` out."""
