"""Fitting the score of detections."""
