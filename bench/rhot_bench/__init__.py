"""Measurements of speed and accuracy beside re-implementations of what the 2018 thesis did."""
